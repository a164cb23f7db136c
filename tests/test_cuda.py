"""The measurements for a CUDA machine run at the smallest size, and their results are read."""

import json
import os
import pathlib
import runpy
import shutil
import subprocess
import sys

import numpy as np
import pytest

from physxnet_jax.data import load_action, read_protocol

ROOT = pathlib.Path(__file__).parents[1]
CUDA = ROOT / "experiments/cuda"


def run(folder, *words, seconds=560):
    env = {"OUT": folder / "out", "WORK": folder / "work", "PACK": folder, "PYTHON": sys.executable}
    return subprocess.run(
        ["bash", str(CUDA / "run.sh"), *words, "--toy"],
        env=os.environ | {k: str(v) for k, v in env.items()} | {"JAX_PLATFORMS": "cpu"},
        capture_output=True,
        text=True,
        timeout=seconds,
    )


@pytest.mark.nightly
@pytest.mark.skipif(shutil.which("bash") is None, reason="needs bash")
def test_every_part_measures_at_the_smallest_size(tmp_path):
    done = run(tmp_path)
    assert done.returncode == 0, done.stdout[-3000:] + done.stderr[-1000:]
    parts = json.loads((tmp_path / "out/results.json").read_text())
    assert set(parts) == {"tests", "simulator", "network"}
    fast = parts["tests"][1]
    assert fast["finished"] and fast["passed"] > 0 and not fast["failed"]
    for row in parts["simulator"][1:]:
        assert row["finite"] and 0.0 < row["floor_ms"] < row["ms_per_person_frame"]
        assert row["rms_from_reference_mm"] < 1.0
    precisions = [r["rms_mm"] for r in parts["network"][:2]]
    assert precisions[0] < 1e-3 < precisions[1] < 1.0
    assert "part " in done.stdout.splitlines()[-sum(len(rows) for rows in parts.values()) - 1]


@pytest.mark.nightly
@pytest.mark.skipif(shutil.which("bash") is None, reason="needs bash")
def test_networks_are_learned_from_data_made_there(tmp_path):
    # Long enough for two cores; the smallest runs end when their steps are done.
    done = run(tmp_path, "learn", "--seconds", "1500", seconds=1560)
    assert done.returncode == 0, done.stdout[-3000:] + done.stderr[-1000:]
    rows = json.loads((tmp_path / "out/learned.json").read_text())
    assert rows["clothes-0"][0]["people"] == 12 and rows["clothes-0"][0]["came_off"] == 0
    assert any("validation_mm" in r for r in rows["paper"])
    for name in ("paper", "small", "nano"):
        assert rows[name][-1]["what"] == "run" and rows[name][-1]["steps"] > 0
        assert (tmp_path / f"out/{name}.tar.gz.0").stat().st_size < 16e6
    assert len([p for p in (tmp_path / "out").rglob("*") if p.is_file()]) <= 8


@pytest.mark.release
def test_part_that_fails_is_named_and_others_keep_their_rows(tmp_path, monkeypatch):
    monkeypatch.setenv("XLA_FLAGS", "--xla_no_such_flag")
    done = run(tmp_path, "simulator")
    assert done.returncode != 0 and "not finished: simulator" in done.stdout
    assert not (tmp_path / "out/results.json").is_file()


def test_work_counts_loops_and_products():
    import jax
    import jax.numpy as jnp

    floor = runpy.run_path(str(CUDA / "floor.py"))
    x = jnp.ones((8, 8))

    def looped(a):
        return jax.lax.fori_loop(0, 5, lambda _, b: b * a + a, a)

    assert floor["work_of"](looped, x).operations == pytest.approx(5 * 2 * 64, abs=20)
    assert floor["work_of"](lambda a: a @ a, x).operations == 2 * 8**3
    moved = floor["work_of"](lambda a: a[jnp.array([1, 2, 3])], x)
    assert moved.bytes >= 3 * 8 * 4
    ceilings = floor["Ceilings"](1e9, 1e9, 1e9)
    assert ceilings.seconds(floor["Work"](2e9, 1e9)) == pytest.approx(2.0)


@pytest.mark.nightly
def test_packed_motions_are_the_actions(tmp_path, data_dir, monkeypatch):
    monkeypatch.syspath_prepend(str(CUDA))
    pack = runpy.run_path(str(CUDA / "pack.py"))
    mocap = data_dir / "mocap"
    pack["pack_motions"](mocap, tmp_path / "a.npz")
    assert (tmp_path / "a.npz").stat().st_size < 16e6
    pack["unpack_motions"](tmp_path / "a.npz", tmp_path / "b")
    packed = read_protocol(tmp_path / "b/actions")
    wanted = [a for a in read_protocol(mocap) if a.split != "test"]
    assert [(a.name, a.split, a.frames) for a in packed] == [
        (a.name, a.split, a.frames) for a in wanted
    ]
    for a, b in list(zip(packed, wanted, strict=True))[::6]:
        got, motion = load_action(tmp_path / "b/actions", a), load_action(mocap, b)
        np.testing.assert_allclose(got.root, motion.root, atol=1e-5)
        np.testing.assert_allclose(np.abs(got.rotations), np.abs(motion.rotations), atol=1e-5)
    left = read_protocol(tmp_path / "b/left")
    assert {a.name for a in left} < {a.name for a in packed} and len(left) > 5
    np.savez(tmp_path / "c.npz", **{"../d": np.zeros(3, np.uint8)})
    with pytest.raises(ValueError, match="out of the folder"):
        pack["unpack_motions"](tmp_path / "c.npz", tmp_path / "e")


def test_new_parts_replace_old_ones_only():
    report = runpy.run_path(str(CUDA / "report.py"))
    old = {"simulator": {"date": "a", "card": "x", "rows": []}, "network": {"rows": [1]}}
    new = report["merged"](old, {"tests": [{"card": "y"}], "simulator": [2]}, "b")
    assert new["network"] == {"rows": [1]}
    assert new["simulator"] == {"date": "b", "card": "y", "rows": [2]}
