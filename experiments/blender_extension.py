"""Uses the Blender extension in Blender without a window, as installed from its zip.

Command: python experiments/blender_extension.py --python PYTHON_WITH_BPY [PYTHON_WITH_BPY ...]
         [--pictures] [--mpfb ZIP]
         (the zip of MPFB, from extensions.blender.org; dressed too, if given)
         (`pip install bpy==4.2.0` in a Python 3.11, and bpy 5.0.1 in another)
Cost:    two minutes for each Blender on one core.
Result:  experiments/results/blender_extension.json and .md, the table of docs/blender.md.
"""

import argparse
import json
import os
import pathlib
import runpy
import subprocess
import sys
import tempfile

import numpy as np

import physxnet_jax as px
from physxnet_jax.files import atomic_write, write_json
from physxnet_jax.io import GltfFile, write_dressed_rig, write_obj
from physxnet_jax.motion import read_rig

ROOT = pathlib.Path(__file__).parents[1]
RESULT = ROOT / "experiments/results/blender_extension.json"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--python", nargs="+", required=True, help="Pythons that have bpy")
    parser.add_argument("--pictures", action="store_true", help="render those of docs/blender.md")
    parser.add_argument("--mpfb", type=pathlib.Path, help="zip of MPFB")
    words = parser.parse_args()
    rows = []
    for k, python in enumerate(words.python):
        rows += check(python, ROOT / "docs" if words.pictures and k == 0 else None, words.mpfb)
    write_json(RESULT, rows)
    with atomic_write(RESULT.with_suffix(".md")) as part:
        part.write_text(table(rows))
    sys.stdout.write(table(rows))


def check(
    python: str, pictures: pathlib.Path | None = None, mpfb: pathlib.Path | None = None
) -> list[dict[str, object]]:
    """The results of one Blender."""
    with tempfile.TemporaryDirectory() as folder:
        where = pathlib.Path(folder)
        archive = runpy.run_path(str(ROOT / "integrations/blender/build.py"))["build"](where)
        person, garment = make_inputs(where)
        command = where / "physxnet"
        command.write_text(
            f"#!{sys.executable}\nimport sys\nfrom physxnet_jax.cli import main\nsys.exit(main())\n"
        )
        command.chmod(0o755)
        own = os.environ | {
            "PHYSXNET_COMMAND": str(command),
            "PHYSXNET_PYTHONPATH": str(ROOT / "src"),
            # The extension is installed into a folder of its own.
            "BLENDER_USER_RESOURCES": str(where / "resources"),
        }
        own.pop("PYTHONPATH", None)
        script = ROOT / "integrations/blender/headless.py"
        words = [python, str(script), str(archive), str(person), str(garment), folder]
        words += [] if pictures is None else ["--pictures", str(pictures)]
        words += [] if mpfb is None else ["--mpfb", str(mpfb.resolve())]
        ended = subprocess.run(words, env=own, capture_output=True, text=True, timeout=1200)
    found = [
        json.loads(line.removeprefix("RESULT "))
        for line in ended.stdout.splitlines()
        if line.startswith("RESULT ")
    ]
    version = found[0]["note"] if found else "unknown"
    if ended.returncode or not found:
        lines = [f"code {ended.returncode}", *(ended.stdout + ended.stderr).splitlines()[-8:]]
        found.append({"check": "runs to its end", "passed": False, "note": " ".join(lines)[:300]})
    else:
        found.append({"check": "runs to its end", "passed": True, "note": ""})
    return [{"blender": version, **row} for row in found]


def make_inputs(folder: pathlib.Path) -> tuple[pathlib.Path, pathlib.Path]:
    """A rig that walks, and a shirt modelled on it."""
    body = px.load_body()
    samples = runpy.run_path(str(ROOT / "tests/samples.py"))
    rig = samples["rigged_person"](folder / "rig.glb", body)
    person = px.load_character(rig, motion="walk", frames=12).rig
    assert person is not None
    nodes = read_rig(GltfFile(rig)).nodes
    walking = folder / "walking.glb"
    write_dressed_rig(walking, rig, person.world, nodes, (), 30.0, unit=person.unit)
    shirt = px.load_garment("tee")[0].mesh
    garment = folder / "tee.obj"
    write_obj(garment, np.asarray(shirt.vertices), np.asarray(shirt.faces))
    return walking, garment


def table(rows: list[dict[str, object]]) -> str:
    """The checks, a column for each Blender."""
    versions = list(dict.fromkeys(str(r["blender"]) for r in rows))
    lines = [f"| check | {' | '.join(versions)} |", "|---|" + "---|" * len(versions)]
    for name in dict.fromkeys(str(r["check"]) for r in rows):
        cells = []
        for version in versions:
            row = next((r for r in rows if (r["blender"], r["check"]) == (version, name)), None)
            note = "" if row is None or row["note"] == version else str(row["note"])[:60]
            word = "-" if row is None else "passed" if row["passed"] else "failed"
            cells.append(f"{word} ({note})" if note else word)
        lines.append(f"| {name} | {' | '.join(cells)} |")
    return "\n".join(lines) + "\n"


if __name__ == "__main__":
    main()
