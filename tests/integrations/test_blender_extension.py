"""The Blender extension: what it exchanges with the command, its zip, and its use in Blender."""

import importlib.util
import json
import os
import pathlib
import runpy
import subprocess
import sys
import tomllib
import zipfile

import numpy as np
import pytest

from physxnet_jax.cli import parse
from physxnet_jax.dressing import read_character
from physxnet_jax.garment import FABRICS
from physxnet_jax.io import read_pc2

ROOT = pathlib.Path(__file__).parents[2]
SOURCE = ROOT / "integrations/blender/physxnet"
_spec = importlib.util.spec_from_file_location("bridge", SOURCE / "bridge.py")
bridge = importlib.util.module_from_spec(_spec)
_spec.loader.exec_module(bridge)


def test_axes_and_units_come_back():
    x = np.random.default_rng(0).normal(size=(3, 7, 3))
    np.testing.assert_allclose(bridge.to_z_up(bridge.to_y_up(x, 0.01), 0.01), x, atol=1e-12)
    # A rotation, not a mirror image: left stays left.
    axes = bridge.to_y_up(np.eye(3))
    assert np.linalg.det(axes) == pytest.approx(1.0)
    np.testing.assert_allclose(bridge.to_y_up([[0.0, 0.0, 1.7]], 1.0), [[0.0, 1.7, 0.0]])


def test_persons_and_caches_are_what_the_package_reads(tmp_path):
    rng = np.random.default_rng(1)
    x = rng.normal(0.0, 0.02, (4, 30, 3))
    x[..., 1] += np.linspace(0.0, 1.7, 30)
    faces = np.arange(30).reshape(-1, 3)
    bridge.write_person(tmp_path / "person.npz", x, faces, x[0] + 0.01, 24.0)
    read = read_character(tmp_path / "person.npz", fps=24.0)
    np.testing.assert_allclose(read.mesh.positions, x, atol=1e-6)
    np.testing.assert_allclose(read.bind, x[0] + 0.01, atol=1e-6)
    bridge.write_pc2(tmp_path / "caches" / "a.pc2", x)
    np.testing.assert_allclose(read_pc2(tmp_path / "caches" / "a.pc2"), x, atol=1e-6)
    assert [p.name for p in (tmp_path / "caches").iterdir()] == ["a.pc2"]


@pytest.mark.parametrize("method", bridge.METHODS)
@pytest.mark.parametrize("fabric", ["", "silk"])
def test_every_choice_is_a_valid_command(tmp_path, method, fabric):
    line = bridge.dress_command(
        "physxnet",
        tmp_path,
        ["a.obj", "shirt"],
        fps=24.0,
        method=method,
        fabric=fabric,
        wind=(1.0, 2.0, 3.0),
    )
    command = parse(line[1:])
    assert command.method == method and command.terminal.progress
    assert command.outfit.wear == ("a.obj", "shirt") and command.person.animated_body
    assert command.outfit.fabric == (fabric if fabric and method != "lbs" else None)
    acts = method in ("guided", "simulate")
    assert command.simulation.wind == ((1.0, 3.0, -2.0) if acts else None)


def test_choices_are_those_of_the_package():
    assert set(bridge.FABRICS) == {"", *FABRICS}


def test_a_job_reads_progress_and_errors(tmp_path):
    script = tmp_path / "command.py"
    script.write_text(
        "import sys, json\n"
        'print(json.dumps({"stage": "binding", "done": 3, "total": 4}), file=sys.stderr)\n'
        'print("a warning", file=sys.stderr)\n'
        'print("physxnet: coat.obj: no such file.", file=sys.stderr)\n'
        "sys.exit(2)\n"
    )
    job = bridge.Job([sys.executable, str(script)])
    assert job.process.wait(30) == 2
    assert job.message() == "physxnet: coat.obj: no such file."
    assert (job.stage, job.share) == ("binding", 0.75)
    assert bridge.parse_progress("no json") is None and bridge.parse_progress("[1]") is None
    endless = bridge.Job([sys.executable, "-c", "import time; time.sleep(600)"])
    assert endless.code is None
    endless.cancel()
    assert endless.process.wait(10) != 0


def test_the_command_is_found_where_it_is_named(tmp_path, monkeypatch):
    own = tmp_path / "physxnet"
    own.write_text("#!/bin/sh\n")
    own.chmod(0o755)
    monkeypatch.delenv("PHYSXNET_COMMAND", raising=False)
    assert bridge.find_command(str(own)) == str(own)
    monkeypatch.setenv("PHYSXNET_COMMAND", str(own))
    assert bridge.find_command("") == str(own)
    monkeypatch.setenv("PHYSXNET_COMMAND", "")
    monkeypatch.setenv("PATH", str(tmp_path / "empty"))
    assert bridge.find_command("") == ""


def test_the_zip_is_an_extension(tmp_path):
    build = runpy.run_path(str(ROOT / "integrations/blender/build.py"))["build"]
    path = build(tmp_path)
    with zipfile.ZipFile(path) as archive:
        names = set(archive.namelist())
        manifest = tomllib.loads(archive.read("blender_manifest.toml").decode())
    assert names == {"__init__.py", "bridge.py", "scene.py", "blender_manifest.toml"}
    assert manifest["schema_version"] == "1.0.0" and manifest["type"] == "add-on"
    assert manifest["blender_version_min"] == "4.2.0" and not manifest["tagline"].endswith(".")
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    assert manifest["version"] == project.get("version", manifest["version"])
    assert path.read_bytes() == build(tmp_path).read_bytes(), "the same bytes again"


def test_the_page_holds_the_results():
    rows = json.loads((ROOT / "experiments/results/blender_extension.json").read_text())
    assert len({r["blender"] for r in rows}) == 2 and all(r["passed"] for r in rows)
    made = runpy.run_path(str(ROOT / "experiments/blender_extension.py"))["table"](rows)
    assert made == (ROOT / "experiments/results/blender_extension.md").read_text()
    assert made in (ROOT / "docs/blender.md").read_text()


@pytest.mark.nightly
def test_the_extension_works_in_blender():
    """PHYSXNET_BPY names Pythons with bpy, separated by spaces."""
    pythons = os.environ.get("PHYSXNET_BPY", "").split()
    if not pythons:
        pytest.skip("PHYSXNET_BPY names no Python with bpy (pip install bpy==4.2.0)")
    check = runpy.run_path(str(ROOT / "experiments/blender_extension.py"))["check"]
    for python in pythons:
        assert subprocess.run([python, "-c", "import bpy"], check=False).returncode == 0
        rows = check(python)
        assert all(r["passed"] for r in rows), [r for r in rows if not r["passed"]]
