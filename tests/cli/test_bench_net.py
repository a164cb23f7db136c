"""The table of networks: whole rows, nothing measured twice, times that belong together."""

import dataclasses
import json
import platform
import types

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from flax import nnx

from physxnet_jax.body import load_body
from physxnet_jax.cli import main
from physxnet_jax.data import Sequence
from physxnet_jax.evaluation import (
    Cost,
    NetworkBench,
    cost_points,
    cost_rows_table,
    engine_times,
    machine,
    mean_errors,
    noise_floors,
    present_devices,
    read_rows,
    row_json,
    skinning,
)
from physxnet_jax.evaluation._cost import _first_of_each
from physxnet_jax.evaluation._network_bench import (
    _narrowed,
    _sort_key,
    _unmeasured,
    _with_errors,
    _with_evaluated,
)
from physxnet_jax.evaluation._saved_rows import weights_digest
from physxnet_jax.garment import TEMPLATES, template
from physxnet_jax.models import (
    ModelConfig,
    Normalisation,
    Predictor,
    make_generator,
    make_texel_points,
    save_predictor,
)
from physxnet_jax.motion import Motion, load_motion
from physxnet_jax.uv import garment_map_rows, make_atlas


@pytest.fixture(scope="module")
def tiny(tmp_path_factory):
    """A fresh network as small as they come, on disk."""
    body = load_body()
    rest = body.rest_vertices(body.default_shape())
    config = ModelConfig(resolution=32, width=4)
    atlas = make_atlas(32)
    valid = {t: garment_map_rows(atlas, body, rest, template(t)).valid for t in TEMPLATES}
    network = make_generator(config)
    network.eval()
    graph, state = nnx.split(network)
    one = jnp.ones(())
    scales = Normalisation(one, one, {t: 0.01 * one for t in TEMPLATES})
    surface = make_texel_points(atlas, body, rest, valid)
    folder = tmp_path_factory.mktemp("weights") / "tiny"
    save_predictor(folder, Predictor(atlas, surface, scales, state, graph, config), name="tiny")
    return folder


@pytest.fixture
def hasty(monkeypatch):
    monkeypatch.setattr("physxnet_jax.evaluation._cost._SECONDS", 0.05)
    monkeypatch.setattr("physxnet_jax.evaluation._cost._MIN_CALLS", 3)
    freed = []
    # Other tests go on with what is compiled.
    monkeypatch.setattr(jax, "clear_caches", lambda: freed.append(True))
    return freed


@pytest.mark.nightly
@pytest.mark.usefixtures("hasty")
def test_rows_are_complete_and_measured_once(tiny, tmp_path, capsys):
    out = tmp_path / "net.json"
    words = ["bench", "net", "--weights", str(tiny), "--batches", "1", "--garments", "1", "2"]
    assert main([*words[:-2], "2", "--out", str(out), "--quiet"]) == 0
    first = json.loads(out.read_text())["rows"]
    # What is asked for later comes in its place, and nothing else is measured again.
    assert main([*words, "--out", str(out)]) == 0
    assert "| network | tiny | 2 | 1 |" in capsys.readouterr().out
    rows = json.loads(out.read_text())["rows"]
    assert [r for r in rows if (r["size"], r["garments"]) != ("tiny", 1)] == first
    mine = [r for r in rows if r["size"] == "tiny"]
    assert [(r["method"], r["garments"], r["batch"]) for r in mine] == [
        (m, g, 1) for m in ("network", "network+push") for g in (1, 2)
    ]
    assert [r["garments"] for r in rows if r["method"] == "lbs"] == [1, 2, 3]
    for r in mine:
        assert r["rmse_mm"] is None, "no dataset, no error"
        assert 0 < r["ms_network"] and 0 < r["ms_per_frame"] < 1e3 * r["cold_s"]
        assert r["ms_backward"] is None, "not asked for"
        assert r["peak_mb"] > 1 and r["weights_mb"] < 0.2
        # Of a loop the compiler counts one turn: nothing is said then.
        assert (r["flops"] is None) == r["method"].endswith("+push")
    assert mine[0]["params"] == mine[-1]["params"] > 1000
    # A second garment has a decoder of its own to compute: counted, not timed.
    assert mine[1]["flops"] > 1.1 * mine[0]["flops"]
    assert mine[0]["flops"] > 1e6
    before = out.read_text()
    assert main([*words, "--out", str(out), "--quiet"]) == 0
    assert out.read_text() == before
    assert main([*words, "--out", str(out), "--times", "--quiet"]) == 0
    again = json.loads(out.read_text())["rows"]
    assert [(r["method"], r["garments"], r["batch"]) for r in again] == [
        (r["method"], r["garments"], r["batch"]) for r in rows
    ]
    assert [r["ms_per_frame"] for r in again] != [r["ms_per_frame"] for r in rows]
    assert (tmp_path / "net.md").is_file() and (tmp_path / "net.png").is_file()


@pytest.mark.nightly
@pytest.mark.usefixtures("hasty")
def test_evaluated_errors_are_copied_to_the_rows(tiny, tmp_path):
    error_rows = [
        {"engine": engine, "method": m, "template": t, "rmse_vertices_mm": mm + k}
        for engine, mm in (("physxnet", 10.0), ("blender", 90.0))
        for m, more in (("lbs", 0.0), (str(tiny), 1.0), (f"{tiny}+push", 2.0))
        for t in TEMPLATES
        for k in (more, more + 2.0)
    ]
    rows, out = tmp_path / "rows.json", tmp_path / "net.json"
    rows.write_text(json.dumps(error_rows))
    words = ["bench", "net", "--weights", str(tiny), "--batches", "1", "--garments", "1", "--quiet"]
    assert main([*words, "--errors", str(rows), "--out", str(out)]) == 0
    found = {
        (r["method"], r["garments"]): r["rmse_mm"] for r in json.loads(out.read_text())["rows"]
    }
    assert found["lbs", 3] == 11.0 and found["network", 1] == 12.0
    assert found["network+push", 1] == 13.0
    rows.write_text('[{"engine": "physxnet"}]')
    assert main([*words, "--errors", str(rows)]) == 2


@pytest.mark.nightly
def test_gradients_are_measured_on_request(tiny, tmp_path, hasty):
    out = tmp_path / "net.json"
    words = ["--weights", str(tiny), "--batches", "3", "--garments", "1", "--backward", "--quiet"]
    assert main(["bench", "net", *words, "--out", str(out)]) == 0
    rows = [r for r in json.loads(out.read_text())["rows"] if r["size"] == "tiny"]
    assert len(rows) == 2
    assert len(hasty) == 2, "a dozen networks' programs are more maps than a process may have"
    for r in rows:
        assert r["ms_backward"] > 0 and r["backward_mb"] > 1


@pytest.mark.parametrize(
    ("words", "says"),
    [
        (["--garments", "4"], "from 1 to 3"),
        (["--weights", "nano", "runs/nano"], "have the same name"),
        (["--times"], "there are none"),
    ],
)
def test_options_for_misleading_tables_are_refused(words, says, capsys):
    assert main(["bench", "net", "--weights", "nano", *words]) == 2
    assert says in " ".join(capsys.readouterr().err.split())


def test_times_option_measures_only_existing_rows():
    nan = float("nan")
    known = [
        Cost("network", "nano", "cpu", batch, g, nan, 1.0, 0.5, 1.0, 9, nan, 0.1, nan, slope)
        for batch, g, slope in ((1, 2, nan), (32, 2, 4.0), (1, 3, nan))
    ]
    again = _narrowed(NetworkBench(garments=(1,), batches=(8,)), known)
    assert (again.garments, again.batches, again.backward) == ((2, 3), (1, 32), True)
    assert not _narrowed(NetworkBench(), known[:1]).backward


def test_rows_without_requested_gradients_are_measured_again():
    nan = float("nan")
    known = [
        Cost("network", "nano", "cpu", batch, 1, nan, 1.0, 0.5, 1.0, 9, nan, 0.1, nan, gradient)
        for batch, gradient in ((1, nan), (32, 4.0))
    ]
    plan = NetworkBench(garments=(1,))
    assert list(_unmeasured(plan, known)) == []
    (again,) = _unmeasured(dataclasses.replace(plan, backward=True), known)
    assert again.batches == (1,)


def test_mean_errors_average_the_finite_actions():
    walk = load_motion("walk", fps=30.0)
    motion = Motion(walk.rotations[:3], walk.root[:3], 30.0)
    shift = np.zeros((3, 2726, 3), np.float32)
    good = {"finite": True, "worst": {"penetration_max": 0.0}}
    off = [
        Sequence(str(mm), "test", motion, {"bottom": shift + mm * 1e-3 / 3**0.5}, {"bottom": good})
        for mm in (3.0, 5.0)
    ]
    spoiled = Sequence(
        "x", "test", motion, {"bottom": shift + 9.0}, {"bottom": {**good, "finite": False}}
    )
    found = mean_errors(skinning(), [*off, spoiled], TEMPLATES)
    assert list(found) == ["bottom"]
    assert found["bottom"] == pytest.approx(4.0, rel=1e-3)


def test_plots_have_a_panel_per_garment_count_and_a_line_over_sizes():
    nan = float("nan")

    def row(method, size, batch, garments, error):
        return Cost(method, size, "cpu", batch, garments, error, 1.0, 0.5, 1.0, 9, nan, 0.1, nan)

    rows = [row("lbs", "-", 16, k, 20.0) for k in (1, 2, 3)]
    rows += [row("network", s, b, 3, 10.0) for s in ("small", "large") for b in (1, 32)]
    rows += [row("network", "unknown", 1, 3, nan)]
    found = cost_points(rows)
    assert {p[0] for p in found} == {"3 garments"}, "nothing to compare with one or two"
    assert [p[1] for p in found].count("network, live") == 2
    assert {p[1] for p in found} == {"lbs", "network, live", "network, 32 frames"}
    beside = [*rows, row("network", "paper", 1, 3, 30.0)]
    assert [p[1] for p in cost_points(beside)].count("network, live") == 2, (
        "no line to another family"
    )
    low = [dataclasses.replace(r, precision="bfloat16") for r in rows]
    assert cost_points(low)[-1][1] == "network bfloat16, 32 frames"
    assert len(cost_points(rows[:3])) == 3, "without networks every number is shown"
    noisy = [*rows, *(row("simulator", s, 1, 3, 6.0) for s in ("draft", "perturbed"))]
    assert [p[1] for p in cost_points(noisy)].count("simulator") == 1, "noise is a floor, no point"
    assert noise_floors(noisy) == {"3 garments": 6.0} and noise_floors(rows) == {}


def test_rows_of_another_machine_or_other_weights_are_not_resumed(tmp_path, capsys):
    nan = float("nan")
    row = Cost("network", "nano", "cpu", 1, 1, nan, 1.0, 0.5, 1.0, 9, nan, 0.1, nan)
    digest = weights_digest("nano")
    assert len(digest) == 16 and weights_digest("none") == ""
    words = ["bench", "net", "--weights", "nano", "--times", "--quiet", "--out"]
    for where, weights, says in (
        (machine() | {"cores": 96}, digest, "another machine"),
        (machine(), 16 * "0", "other weights of that name"),
    ):
        out = tmp_path / "net.json"
        rows = [row_json(dataclasses.replace(row, weights=weights))]
        out.write_text(json.dumps({"machine": where, "rows": rows}))
        assert main([*words, str(out)]) == 2
        assert says in " ".join(capsys.readouterr().err.split())
    # What wasn't noted in former versions isn't compared.
    vague = machine() | {"cpu": platform.machine()}
    for there in (
        {"machine": machine(), "rows": rows},
        {"machine": vague, "rows": rows},
        {"rows": rows},
    ):
        out.write_text(json.dumps(there))
        assert [r.weights for r in read_rows(out, Cost)] == [16 * "0"]


@pytest.mark.parametrize(
    "words",
    [
        ["bench", "net", "--out", "/proc/a.json"],
        ["bench", "sim", "--out", "/proc/a.json"],
        ["evaluate", "lbs", "--data", "none", "--out", "/proc/a.json"],
        ["stress", "--out", "/proc/a.json"],
        ["effects", "walk", "--out", "/proc/a.json"],
        ["dataset", "check", "none", "--contact-sheet", "/proc/a.png"],
    ],
    ids=lambda words: "-".join(words[:2]),
)
def test_unwritable_outputs_are_refused_before_the_measurement(words, capsys):
    assert main(words) == 2
    assert "nothing can be written there" in " ".join(capsys.readouterr().err.split())


def test_missing_actions_and_weights_are_reported(tmp_path, capsys):
    assert main(["bench", "net", "--data", str(tmp_path)]) == 2
    assert "no 'test' actions" in capsys.readouterr().err
    assert main(["bench", "net", "--weights", "none", "--out", str(tmp_path / "a.json")]) == 2
    assert "none" in capsys.readouterr().err


def test_engines_are_timed_and_plotted_without_an_error():
    nan = float("nan")

    def row(method, size, garments, error, **more):
        more = {"ms_per_frame": 1.0, "batch": 1} | more
        return Cost(
            method=method,
            size=size,
            device="cpu",
            garments=garments,
            rmse_mm=error,
            **{"ms_network": 0.5, "cold_s": 1.0, "params": 9, "flops": nan} | more,
            weights_mb=0.1,
            peak_mb=nan,
        )

    rows = [row("network", "small", 3, 9.0)]
    rows += [row("engine", "blender", k, nan, ms_per_frame=600.0 * k) for k in (1, 2, 3)]
    assert engine_times(rows) == {"3 garments": {"blender (another cloth)": 1800.0}}
    assert [p[1] for p in cost_points(rows)] == ["network, live"]
    # Whichever was measured first, the table has one order.
    rows += [row("network", "local", 1, 9.0, params=99), row("lbs", "-", 1, 20.0)]
    placed = [r.size for r in sorted(rows, key=_sort_key)]
    assert placed == ["-", "blender", "blender", "blender", "small", "local"]
    solved = [row("simulator", a, 1, 9.0) for a in ("standard", "fine", "perturbed", "draft")]
    assert [r.size for r in sorted(solved, key=_sort_key)] == [
        "perturbed",
        "draft",
        "standard",
        "fine",
    ]


def test_rows_of_several_devices_share_one_table():
    nan = float("nan")
    rows = [
        Cost("network", "small", d, b, 1, 9.0, ms, 0.5, 1.0, 9, nan, 0.1, nan)
        for d, ms in (("H100", 0.1), ("cpu", 3.0))
        for b in (1, 32)
    ]
    table = cost_rows_table(rows).splitlines()
    assert table[0].startswith("| method | size | device | garments |")
    assert table[2].startswith("| network | small | H100 | 1 | 1 |")
    assert len({line.count("|") for line in table}) == 1
    # A line of the picture for each; with one device none is named.
    assert [p[1] for p in cost_points(rows)] == [
        f"network, {way}, {d}" for d in ("H100", "cpu") for way in ("live", "32 frames")
    ]
    assert (
        "device" not in cost_rows_table(rows[:2]) and cost_points(rows[:2])[0][1] == "network, live"
    )


def test_each_device_kind_is_measured_once():
    cpu, card, second = (types.SimpleNamespace(device_kind=k) for k in ("cpu", "H100", "H100"))
    assert _first_of_each([card, second, cpu]) == [card, cpu]
    assert _first_of_each([cpu, cpu]) == [cpu]
    assert jax.devices("cpu")[0] in present_devices()


def test_rows_take_errors_that_were_evaluated_later(tmp_path):
    nan = float("nan")

    def row(method, size, garments, **more):
        common = ("cpu", 1, garments, 1.0, 1.0, 0.5, 1.0, 9, nan, 0.1, nan)
        return Cost(method, size, *common, **more)

    found = {
        name: dict(zip(TEMPLATES, values, strict=True))
        for name, values in {
            "lbs": (3.0, 4.0, 5.0),
            "small+push": (6.0, 7.0, 8.0),
            "draft": (1.0, 2.0, 6.0),
        }.items()
    }
    assert _with_evaluated(row("lbs", "-", 3), found).rmse_mm == 4.0
    assert _with_evaluated(row("network+push", "small", 2), found).rmse_each == {
        "top": 6,
        "bottom": 7,
    }
    assert _with_evaluated(row("simulator", "draft", 3), found).rmse_mm == 3.0
    # What wasn't evaluated stays as it was measured.
    for other in (
        row("network", "small", 1),
        row("network+push", "small", 1, precision="bfloat16"),
    ):
        assert _with_evaluated(other, found) == other


def test_retimed_rows_keep_the_errors_of_their_garments():
    nan = float("nan")

    def row(method, garments, error, each):
        common = ("cpu", 1, garments, error, 1.0, 0.5, 1.0, 9, nan, 0.1, nan)
        return Cost(method, "small", *common, rmse_each=each)

    each = {"top": 2.0, "bottom": 3.0, "dress": 7.0}
    known = [row("network", 3, 4.0, each), row("network+push", 3, 9.0, {})]
    two = _with_errors(row("network", 2, nan, {}), known)
    assert two.rmse_mm == 2.5 and two.rmse_each == {"top": 2.0, "bottom": 3.0}
    assert _with_errors(row("network", 3, nan, {}), known).rmse_mm == 4.0
    # Nothing is made up where a garment's error isn't known.
    assert np.isnan(_with_errors(row("network+push", 2, nan, {}), known).rmse_mm)
    assert _with_errors(row("network+push", 3, nan, {}), known).rmse_mm == 9.0
