"""Work against precision: the rows of one small scene, and what is read off them."""

import dataclasses
import json

import numpy as np
import pytest

from physxnet_jax.cli import main
from physxnet_jax.evaluation import (
    JITTER,
    bench_scenes,
    bench_simulation,
    solvers,
    time_to_error,
)
from physxnet_jax.garment import square_sheet
from physxnet_jax.simulation import XPBD, Scene
from physxnet_jax.simulation.effects import Gravity, Pin, Stretch


@pytest.fixture(scope="module")
def rows():
    sheet = bench_scenes()[0]
    g = square_sheet(4, pinned=np.arange(4))
    small = dataclasses.replace(
        sheet,
        scene=Scene((g,), (Gravity(), Stretch(compression=1.0), Pin())),
        frames=3,
        reference=XPBD(512, 1, "float64"),
        check=XPBD(256, 1, "float64"),
    )
    methods = [("xpbd", str(n), XPBD(n, 1)) for n in (8, 32, 128)]
    return list(bench_simulation([small], methods=methods))


@pytest.mark.nightly
def test_baseline_is_worst_and_more_substeps_reduce_the_error(rows):
    by = {(r.solver, r.setting): r for r in rows}
    assert not any(r.failed for r in rows)
    worst = max(rows, key=lambda r: r.rms_mm)
    assert worst.solver == "nothing"
    errors = [by["xpbd", str(n)].rms_mm for n in (8, 32, 128)]
    assert errors == sorted(errors, reverse=True)
    assert by["xpbd", JITTER].rms_mm < 0.3 * by["xpbd", "128"].rms_mm
    assert all(r.ms_per_frame > 0 for r in rows if r.solver != "nothing")
    good = time_to_error(rows, 1.05 * errors[0])
    assert good is not None and good.rms_mm <= 1.05 * errors[0]
    assert time_to_error(rows, 0.0) is None


@pytest.mark.release
def test_existing_rows_are_not_measured_again(rows):
    sheet = dataclasses.replace(bench_scenes()[0], frames=3)
    methods = [("xpbd", "8", XPBD(8, 1))]
    assert list(bench_simulation([sheet], methods=methods, done=rows)) == []


@pytest.mark.release
def test_bench_sim_command_writes_table_and_plot(tmp_path, rows, capsys):
    out = tmp_path / "bench.json"
    # Every row the command would measure is there already.
    there = [dataclasses.replace(rows[0], solver=n, setting=k) for n, k, _ in solvers(False)]
    there += [
        r for r in rows if (r.solver, r.setting) not in {(n, k) for n, k, _ in solvers(False)}
    ]
    out.write_text(json.dumps({"rows": [dataclasses.asdict(r) for r in there]}))
    assert main(["bench", "sim", "--scenes", "sheet", "--out", str(out)]) == 0
    assert "backward euler" in out.with_suffix(".md").read_text()
    assert out.with_suffix(".png").read_bytes()[:4] == b"\x89PNG"
    assert main(["bench", "sim", "--out", "a.txt"]) == 2
    assert "json" in capsys.readouterr().err
