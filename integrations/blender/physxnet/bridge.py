"""What the extension exchanges with the physxnet command; needs nothing of Blender."""

import json
import os
import pathlib
import shutil
import struct
import subprocess
import threading

import numpy as np

METHODS = ("guided", "network", "lbs", "simulate")
FABRICS = ("", "cotton", "denim", "silk", "wool", "jersey", "leather")
_PC2 = b"POINTCACHE2\0"


def find_command(preferred=""):
    """Path of the physxnet command: the preferred one, $PHYSXNET_COMMAND, or that on the PATH."""
    for word in (preferred, os.environ.get("PHYSXNET_COMMAND", "")):
        if word and (found := shutil.which(word)):
            return found
    return shutil.which("physxnet") or ""


def to_y_up(points, unit=1.0):
    """Blender's coordinates (Z up) as metres with Y up."""
    points = np.asarray(points, np.float64)
    return points[..., [0, 2, 1]] * [unit, unit, -unit]


def to_z_up(points, unit=1.0):
    """Metres with Y up as Blender's coordinates, the inverse of `to_y_up`."""
    points = np.asarray(points, np.float64)
    return points[..., [0, 2, 1]] * [1.0 / unit, -1.0 / unit, 1.0 / unit]


def write_obj(path, points, polygons):
    """Writes a mesh as OBJ; polygons are lists of vertex indices."""
    lines = [f"v {x:.7f} {y:.7f} {z:.7f}" for x, y, z in np.asarray(points)]
    lines += ["f " + " ".join(str(i + 1) for i in p) for p in polygons]
    pathlib.Path(path).write_text("\n".join(lines) + "\n")


def write_person(path, positions, faces, bind, fps):
    """Writes an animated person as physxnet reads it (`--animated-body`)."""
    arrays = {
        "body_positions": np.asarray(positions, np.float32),
        "body_faces": np.asarray(faces, np.int32),
        "fps": np.asarray(float(fps)),
    }
    if bind is not None:
        arrays["body_bind"] = np.asarray(bind, np.float32)
    np.savez(path, **arrays)


def write_pc2(path, positions):
    """Writes a point cache of [frames, vertices, 3] for Blender's Mesh Cache modifier."""
    positions = np.ascontiguousarray(positions, "<f4")
    frames, vertices, _ = positions.shape
    path = pathlib.Path(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    part = path.with_name(f".{path.name}.part")
    with part.open("wb") as file:
        file.write(struct.pack("<12siiffi", _PC2, 1, vertices, 0.0, 1.0, frames))
        file.write(positions.tobytes())
    os.replace(part, path)


def dress_command(command, folder, words, *, fps, method, fabric="", wind=(0, 0, 0), made_on=True):
    """The command line that dresses the person of a folder."""
    folder = pathlib.Path(folder)
    line = [command, "dress", str(folder / "person.npz"), "--animated-body", "--wear", *words]
    line += ["--method", method, "--fps", f"{fps:g}", "--no-body", "--progress", "--quiet"]
    if made_on:
        line += ["--made-on", str(folder / "rest.obj")]
    if fabric and method != "lbs":
        line += ["--fabric", fabric]
    if any(wind) and method in ("guided", "simulate"):
        # Blender's Z is up, physxnet's Y.
        line += ["--wind", *(f"{w:g}" for w in to_y_up(wind))]
    return [*line, "-o", str(folder / "cloth.npz")]


class Job:
    """A running command whose progress is read in a thread."""

    def __init__(self, line):
        self.stage, self.share, self.errors = "starting", 0.0, []
        # Blender's own Python must not leak into the command's.
        own = {k: v for k, v in os.environ.items() if k not in ("PYTHONHOME", "PYTHONPATH")}
        own |= (
            {"PYTHONPATH": os.environ["PHYSXNET_PYTHONPATH"]}
            if ("PHYSXNET_PYTHONPATH" in os.environ)
            else {}
        )
        self.process = subprocess.Popen(
            line,
            stdout=subprocess.DEVNULL,
            stderr=subprocess.PIPE,
            text=True,
            encoding="utf-8",
            errors="replace",
            env=own,
        )
        self._reader = threading.Thread(target=self._read, daemon=True)
        self._reader.start()

    def _read(self):
        with self.process.stderr as lines:
            for line in lines:
                found = parse_progress(line)
                if found is None:
                    self.errors = [*self.errors[-20:], line.rstrip()]
                else:
                    self.stage, self.share = found

    @property
    def code(self):
        """Exit code; None while it runs."""
        return self.process.poll()

    def message(self):
        """What went wrong, in a sentence."""
        self._reader.join(2.0)
        lines = [x for x in self.errors if x.strip()]
        named = [x for x in lines if x.startswith("physxnet: ")]
        return (named or lines or [f"physxnet ended with code {self.code}"])[-1]

    def cancel(self):
        """Stops the command."""
        if self.code is None:
            self.process.terminate()
            try:
                self.process.wait(5.0)
            except subprocess.TimeoutExpired:
                self.process.kill()


def parse_progress(line):
    """Stage and share done of a line of progress; None for any other line."""
    try:
        found = json.loads(line)
        return str(found["stage"]), found["done"] / max(found["total"], 1)
    except (ValueError, TypeError, KeyError):
        return None


def read_cloth(path):
    """Positions [frames, vertices, 3] and faces of every garment by name, Y up."""
    with np.load(path) as data:
        names = [k.removesuffix("_positions") for k in data if k.endswith("_positions")]
        return {n: (data[f"{n}_positions"], data[f"{n}_faces"]) for n in names}
