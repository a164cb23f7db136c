"""The ladder: what is picked is within what was asked, and nothing is timed twice."""

import json

import pytest
from hypothesis import given, settings, strategies as st

from physxnet_jax._environment import processor_name
from physxnet_jax.cli import main
from physxnet_jax.dressing import Rung, calibrate, dress, load_ladder, pick_rung, worn_key
from physxnet_jax.dressing._ladder import _Clock
from physxnet_jax.errors import PhysXNetError
from physxnet_jax.garment import TEMPLATES
from physxnet_jax.io import list_weights
from physxnet_jax.simulation import ACCURACY


def rung(name, error, inside=0.0):
    return Rung(name, dict.fromkeys(TEMPLATES, error), dict.fromkeys(TEMPLATES, inside))


RUNGS = [rung("fast", 20.0), rung("dirty", 9.0, 0.05), rung("clean", 9.0), rung("exact", 1.0)]
TIMES = {
    n: {"top": ms, "dress+top": 1.5 * ms}
    for n, ms in (("fast", 0.5), ("dirty", 2.0), ("clean", 4.0), ("exact", 90.0))
}


@pytest.mark.parametrize(
    ("asked", "picked"),
    [
        ({"budget_ms": 1.0}, "fast"),
        ({"budget_ms": 3.0}, "dirty"),
        ({"budget_ms": 5.0}, "clean"),
        ({"budget_ms": 1000.0}, "exact"),
        ({"max_error_mm": 50.0}, "fast"),
        ({"max_error_mm": 10.0}, "dirty"),
        ({"max_error_mm": 2.0}, "exact"),
    ],
)
def test_the_best_within_what_was_asked(asked, picked):
    choice = pick_rung(["top"], TIMES, RUNGS, **asked)
    assert choice.rung.name == picked and picked in choice.told
    assert choice.ms_per_frame == TIMES[picked]["top"]


def test_the_time_of_garments_worn_together_is_their_own():
    for worn in (["top", "dress"], ["dress", "top"]):
        choice = pick_rung(worn, TIMES, RUNGS, budget_ms=3.0)
        assert (choice.rung.name, choice.ms_per_frame) == ("dirty", 3.0)


@settings(max_examples=50, deadline=None)
@given(
    st.lists(st.tuples(st.floats(0.1, 50), st.floats(0.1, 100)), min_size=1, max_size=6),
    st.lists(st.sampled_from(TEMPLATES), min_size=1, max_size=3),
    st.floats(0.05, 120),
)
def test_a_budget_is_kept_whatever_the_ladder(pairs, templates, budget):
    rungs = [rung(str(k), e) for k, (e, _) in enumerate(pairs)]
    times = {str(k): {worn_key(templates): ms} for k, (_, ms) in enumerate(pairs)}
    able = [e for e, ms in pairs if ms <= budget]
    if not able:
        with pytest.raises(PhysXNetError, match="nearest"):
            pick_rung(templates, times, rungs, budget_ms=budget)
        return
    choice = pick_rung(templates, times, rungs, budget_ms=budget)
    assert choice.ms_per_frame <= budget * (1 + 1e-9)
    assert choice.rmse_mm <= min(able) + 0.1


def test_what_cannot_be_had_is_said():
    with pytest.raises(PhysXNetError, match=r"nearest is fast: 0\.75 ms"):
        pick_rung(["top", "dress"], TIMES, RUNGS, budget_ms=0.7)
    with pytest.raises(PhysXNetError, match="a time and an error for bottom"):
        pick_rung(["bottom"], TIMES, RUNGS, budget_ms=5.0)
    with pytest.raises(PhysXNetError, match="nearest is exact"):
        pick_rung(["top"], TIMES, RUNGS, max_error_mm=0.5)
    with pytest.raises(PhysXNetError, match="either"):
        pick_rung(["top"], TIMES, RUNGS, max_error_mm=5.0, budget_ms=5.0)
    with pytest.raises(PhysXNetError, match="nothing is worn"):
        pick_rung([], TIMES, RUNGS, budget_ms=5.0)


def test_nothing_is_timed_twice_and_another_machine_is(tmp_path):
    path = tmp_path / "deep" / "times.json"
    rungs, worn = [rung("lbs", 20.0)], [("bottom",), ("top", "bottom")]
    said = []
    times = calibrate(rungs, worn, path=path, frames=17, report=lambda *a: said.append(a))
    assert set(times["lbs"]) == {"bottom", "bottom+top"}
    assert all(ms > 0 for ms in times["lbs"].values())
    assert said[1] == ("timing lbs, top, bottom", 1, 2)
    known = json.loads(path.read_text())
    known["times"]["lbs"]["bottom"] = 123.0
    path.write_text(json.dumps(known))
    assert calibrate(rungs, worn[:1], path=path)["lbs"]["bottom"] == 123.0
    known["machine"]["device"] = "abacus"
    path.write_text(json.dumps(known))
    assert calibrate(rungs, worn[:1], path=path, frames=17)["lbs"]["bottom"] != 123.0
    here = json.loads(path.read_text())
    for broken in ("{", "[]", json.dumps({**here, "times": {"lbs": 1.0}})):
        path.write_text(broken)
        assert calibrate(rungs, worn[:1], path=path, frames=17)["lbs"]["bottom"] > 0


def test_what_another_process_has_timed_is_kept(tmp_path):
    path = tmp_path / "times.json"
    one, other = (_Clock(path, 16) for _ in range(2))
    one.time_of(rung("lbs", 20.0), ("bottom",))
    other.time_of(rung("lbs", 20.0), ("top",))
    kept = json.loads(path.read_text())
    assert set(kept["times"]["lbs"]) == {"bottom", "top"}
    assert kept["machine"]["processor"] == processor_name()


@pytest.mark.slow
def test_what_follows_the_network_is_timed_once_for_all(tmp_path):
    rungs = [rung(n, 10.0) for n in ("nano", "nano+push", "nano+relax+push", "small+relax+push")]
    path = tmp_path / "times.json"
    times = calibrate(rungs, [("bottom",)], path=path, frames=16)
    kept = json.loads(path.read_text())["times"]
    plain = next(v for k, v in kept.items() if k.startswith("small "))["bottom"]
    push, relaxed = (kept[way]["bottom"] for way in ("+push", "+relax"))
    assert push > 0 and relaxed > 0
    assert times["nano+push"]["bottom"] == times["nano"]["bottom"] + push
    assert times["nano+relax+push"]["bottom"] == times["nano"]["bottom"] + relaxed + push
    assert times["small+relax+push"]["bottom"] == plain + relaxed + push


def test_every_rung_of_the_package_can_be_dressed():
    ladder = load_ladder()
    names = {r.name for r in ladder}
    ways = ("", "+push", "+mirror", "+mirror+push", "+relax+push", "+mirror+relax+push")
    assert {"lbs", *(f"local{way}" for way in ways)} <= names
    for r in ladder:
        assert set(r.rmse_mm) == set(r.inside) == set(TEMPLATES)
        assert r.name.partition("+")[0] in {"lbs", *list_weights(), *ACCURACY}
        assert r.identity.startswith(r.name)
    plain = {r.name: r for r in ladder}
    clip = dress("walk", ["bottom"], frames=2, include_body=False, **plain["local"].options)
    assert clip.method == "network"
    assert clip.inside["bottom"] == pytest.approx(clip.inside_raw["bottom"], rel=1e-4) != 0.0
    with pytest.raises(PhysXNetError, match="draft, standard, fine"):
        dress("walk", ["bottom"], method="simulate", accuracy="perfect")


def test_dress_takes_what_was_picked(tmp_path, monkeypatch, capsys):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    monkeypatch.setattr("physxnet_jax.cli._calibrate.load_ladder", lambda: [rung("lbs", 20.0)])
    words = ["dress", "walk", "--wear", "bottom", "--frames", "2"]
    assert main([*words, "--max-error-mm", "25"]) == 0
    assert "picked lbs" in capsys.readouterr().out
    assert main([*words, "--max-error-mm", "1"]) == 2
    assert "nearest is lbs" in capsys.readouterr().err
    assert main(["calibrate"]) == 0
    assert "20.0" in capsys.readouterr().out
