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

ROOT = pathlib.Path(__file__).parents[1]
CUDA = ROOT / "experiments/cuda"


def run(folder, *words):
    env = {"OUT": folder / "out", "WORK": folder / "work", "PACK": folder, "PYTHON": sys.executable}
    return subprocess.run(
        ["bash", str(CUDA / "run.sh"), "--toy", *words],
        env=os.environ | {k: str(v) for k, v in env.items()} | {"JAX_PLATFORMS": "cpu"},
        capture_output=True,
        text=True,
        timeout=560,
    )


@pytest.mark.nightly
@pytest.mark.skipif(shutil.which("bash") is None, reason="needs bash")
def test_every_part_measures_at_the_smallest_size(tmp_path):
    done = run(tmp_path)
    assert done.returncode == 0, done.stdout[-3000:] + done.stderr[-1000:]
    parts = json.loads((tmp_path / "out/results.json").read_text())
    assert set(parts) == {"tests", "simulator", "network", "dataset", "paper", "base"}
    fast = parts["tests"][1]
    assert fast["finished"] and fast["passed"] > 0 and not fast["failed"]
    for row in parts["simulator"][1:]:
        assert row["finite"] and 0.0 < row["floor_ms"] < row["ms_per_person_frame"]
        assert row["rms_from_reference_mm"] < 1.0
    precisions = [r["rms_mm"] for r in parts["network"][:2]]
    assert precisions[0] < 1e-3 < precisions[1] < 1.0
    totals = [r for r in parts["dataset"] if r["what"].startswith("all of")]
    assert len(totals) == 2 and not any(r["unusable"] for r in totals)
    for name in ("paper", "base"):
        assert any("validation_mm" in r for r in parts[name])
        assert (tmp_path / f"out/{name}-weights.tar.gz.0").stat().st_size < 16e6
    assert len([p for p in (tmp_path / "out").rglob("*") if p.is_file()]) <= 8
    assert "part " in done.stdout.splitlines()[-sum(len(rows) for rows in parts.values()) - 1]


@pytest.mark.release
def test_part_without_data_fails_and_others_keep_their_rows(tmp_path):
    done = run(tmp_path, "tests", "paper")
    assert done.returncode != 0 and "not finished: paper" in done.stdout
    assert set(json.loads((tmp_path / "out/results.json").read_text())) == {"tests"}


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


def test_motions_are_packed_byte_for_byte(tmp_path, data_dir, monkeypatch):
    monkeypatch.syspath_prepend(str(CUDA))
    pack = runpy.run_path(str(CUDA / "pack.py"))
    mocap = data_dir / "mocap"
    pack["pack_motions"](mocap, tmp_path / "a.npz")
    assert (tmp_path / "a.npz").stat().st_size < 16e6
    pack["unpack_motions"](tmp_path / "a.npz", tmp_path / "b")
    files = [p for p in (tmp_path / "b").rglob("*") if p.is_file()]
    assert len(files) > 20
    for path in files:
        assert path.read_bytes() == (mocap / path.relative_to(tmp_path / "b")).read_bytes()
    np.savez(tmp_path / "c.npz", **{"../d": np.zeros(3, np.uint8)})
    with pytest.raises(ValueError, match="out of the folder"):
        pack["unpack_motions"](tmp_path / "c.npz", tmp_path / "e")


def test_new_parts_replace_old_ones_only():
    report = runpy.run_path(str(CUDA / "report.py"))
    old = {"simulator": {"date": "a", "card": "x", "rows": []}, "network": {"rows": [1]}}
    new = report["merged"](old, {"tests": [{"card": "y"}], "simulator": [2]}, "b")
    assert new["network"] == {"rows": [1]}
    assert new["simulator"] == {"date": "b", "card": "y", "rows": [2]}
