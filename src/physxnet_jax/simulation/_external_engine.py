"""Runs a scene in an external simulator process and reads back the cloth."""

import json
import pathlib
import re
import subprocess
import tempfile
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np
from jaxtyping import Float, Int
from scipy.spatial import KDTree

from ..body import NUM_BODY_VERTICES, triangulate
from ..errors import SimulationError
from ..geometry import vertex_normals
from ..motion import Motion, animate
from ._assembly import float32
from ._diagnostics import Rollout
from ._prepared_scene import PreparedScene
from ._rollout import warmup
from ._slip import slipped


def run_external_engine(
    name: str,
    command: Sequence[str],
    scene: PreparedScene,
    motion: Motion,
    settings: Mapping[str, Any],
    progress: Callable[[int, int], None] | None,
) -> Rollout:
    """Runs ``command FOLDER`` on ``scene.npz`` and ``settings.json``; reads ``cloth.npz``.

    Args:
        name: Name of the simulator in error messages.
        command: Must print ``frame N`` after each frame and exit with code 0.
        scene: Garments and body.
        motion: The body's motion; the warm-up of `simulate` is prepended.
        settings: Written as JSON.
        progress: Called with the number of frames done and the total.

    Raises:
        SimulationError: The simulator failed; the message ends with its last output.
    """
    assembly = scene.assembly
    body = assembly.body
    rest = float32(assembly.rest_body)
    lead = warmup(body, motion)
    first = lead.num_frames - 1
    full = Motion(
        np.concatenate([lead.rotations, motion.rotations[1:]]),  # pyright: ignore[reportArgumentType]
        np.concatenate([lead.root, motion.root[1:]]),  # pyright: ignore[reportArgumentType]
        motion.fps,
    )
    skin = animate(body, rest, rest[:NUM_BODY_VERTICES], body.weights[:NUM_BODY_VERTICES], full)
    cloth = animate(body, rest, float32(assembly.rest), float32(assembly.weights), full)
    arrays: dict[str, np.ndarray] = {
        "skin": np.asarray(skin, np.float32),
        "skin_faces": np.asarray(triangulate(body.quads)),
        "parts": np.asarray(assembly.parts),
        "cloth": np.asarray(cloth, np.float32),
        "cloth_rest": assembly.rest.astype(np.float32),
        "cloth_faces": assembly.faces,
        "pinned": assembly.pinned,
        "fps": np.asarray(motion.fps),
    }
    total = full.num_frames
    with tempfile.TemporaryDirectory(prefix="physxnet_") as directory:
        folder = pathlib.Path(directory)
        np.savez(folder / "scene.npz", allow_pickle=False, **arrays)
        (folder / "settings.json").write_text(json.dumps(dict(settings)))
        said: list[str] = []
        with subprocess.Popen(
            [*command, str(folder)], stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True
        ) as process:
            assert process.stdout is not None
            for line in process.stdout:
                said.append(line.rstrip())
                done = re.match(r"frame (\d+)", line)
                if done and progress is not None:
                    progress(int(done.group(1)), total)
        result = folder / "cloth.npz"
        if process.returncode != 0 or not result.is_file():
            raise SimulationError(
                f"{name} ended with code {process.returncode}: {' | '.join(said[-5:])}"
            )
        with np.load(result) as data:
            positions, milliseconds = data["positions"], data["milliseconds"]
    positions = positions[first:]
    speed = np.zeros(positions.shape[:2])
    speed[1:] = np.linalg.norm(np.diff(positions, axis=0), axis=2) * motion.fps
    diagnostics = {
        "finite": np.isfinite(positions).all(axis=(1, 2)),
        "speed_max": speed.max(axis=1),
        "worst_vertex": speed.argmax(axis=1),
        "residual_p99": np.zeros(len(positions)),
        "penetration_max": _max_depth(positions, arrays["skin"][first:], arrays["skin_faces"]),
        "milliseconds": milliseconds[first:],
        "slipped": slipped(assembly, motion, positions).max(axis=1, initial=0.0),
    }
    garments = tuple(positions[:, i:j] for i, j in zip(assembly.parts, assembly.parts[1:]))
    return Rollout(garments, motion.fps, diagnostics, motion.name)


def _max_depth(
    cloth: Float[np.ndarray, "frames vertices 3"],
    skin: Float[np.ndarray, "frames body 3"],
    faces: Int[np.ndarray, "faces 3"],
) -> Float[np.ndarray, " frames"]:
    """Largest distance of a vertex inside the body from its nearest skin vertex [m]."""
    out = np.zeros(len(cloth))
    for k, (x, s) in enumerate(zip(cloth, skin, strict=True)):
        if not np.isfinite(x).all():
            continue
        normal = vertex_normals(s, faces)
        far, near = map(np.asarray, KDTree(s).query(x))
        inside = np.einsum("vi,vi->v", x - s[near], normal[near]) < 0
        out[k] = np.max(far, where=inside, initial=0.0)
    return out
