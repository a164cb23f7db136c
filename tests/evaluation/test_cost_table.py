"""The ladder: what is picked is within what was asked, and nothing is timed twice."""

import json
import pathlib
import tempfile
import types

import pytest
from hypothesis import given, settings, strategies as st

from physxnet_jax._environment import processor_name
from physxnet_jax.cli import main
from physxnet_jax.dressing import Simulation, dress
from physxnet_jax.errors import PhysXNetError
from physxnet_jax.evaluation import (
    MethodProfile,
    calibrate,
    choose_method,
    load_cost_table,
    select_method,
    worn_key,
)
from physxnet_jax.evaluation._cost_table import _Clock
from physxnet_jax.garment import TEMPLATES
from physxnet_jax.models import list_weights
from physxnet_jax.simulation import PRESETS


def profile(name, error, inside=0.0, ms=1.0):
    errors, within = (dict.fromkeys(TEMPLATES, x) for x in (error, inside))
    return MethodProfile(name, errors, within, dict.fromkeys(TEMPLATES, ms))


RUNGS = [
    profile("fast", 20.0),
    profile("dirty", 9.0, 0.05),
    profile("clean", 9.0),
    profile("exact", 1.0),
]
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
def test_select_method_picks_the_best_within_the_limit(asked, picked):
    choice = select_method(["top"], TIMES, RUNGS, **asked)
    assert choice.profile.name == picked and picked in choice.summary
    assert choice.ms_per_frame == TIMES[picked]["top"]


def test_combined_garments_use_their_own_time():
    for worn in (["top", "dress"], ["dress", "top"]):
        choice = select_method(worn, TIMES, RUNGS, budget_ms=3.0)
        assert (choice.profile.name, choice.ms_per_frame) == ("dirty", 3.0)


@settings(max_examples=50, deadline=None)
@given(
    st.lists(st.tuples(st.floats(0.1, 50), st.floats(0.1, 100)), min_size=1, max_size=6),
    st.lists(st.sampled_from(TEMPLATES), min_size=1, max_size=3),
    st.floats(0.05, 120),
)
def test_select_method_keeps_the_budget_for_any_cost_table(pairs, templates, budget):
    profiles = [profile(str(k), e) for k, (e, _) in enumerate(pairs)]
    times = {str(k): {worn_key(templates): ms} for k, (_, ms) in enumerate(pairs)}
    able = [e for e, ms in pairs if ms <= budget]
    if not able:
        with pytest.raises(PhysXNetError, match="nearest"):
            select_method(templates, times, profiles, budget_ms=budget)
        return
    choice = select_method(templates, times, profiles, budget_ms=budget)
    assert choice.ms_per_frame <= budget * (1 + 1e-9)
    assert choice.rmse_mm <= min(able) + 0.1


def test_unsatisfiable_requests_are_refused_with_the_nearest_method():
    with pytest.raises(PhysXNetError, match=r"nearest is fast: 0\.75 ms"):
        select_method(["top", "dress"], TIMES, RUNGS, budget_ms=0.7)
    with pytest.raises(PhysXNetError, match="a time and an error for bottom"):
        select_method(["bottom"], TIMES, RUNGS, budget_ms=5.0)
    with pytest.raises(PhysXNetError, match="nearest is exact"):
        select_method(["top"], TIMES, RUNGS, max_error_mm=0.5)
    with pytest.raises(PhysXNetError, match="either"):
        select_method(["top"], TIMES, RUNGS, max_error_mm=5.0, budget_ms=5.0)
    with pytest.raises(PhysXNetError, match="nothing is worn"):
        select_method([], TIMES, RUNGS, budget_ms=5.0)


@pytest.mark.release
def test_times_are_cached_for_each_machine(tmp_path):
    path = tmp_path / "deep" / "times.json"
    profiles, worn = [profile("lbs", 20.0)], [("bottom",), ("top", "bottom")]
    said = []
    times = calibrate(profiles, worn, path=path, frames=17, report=lambda *a: said.append(a))
    assert set(times["lbs"]) == {"bottom", "bottom+top"}
    assert all(ms > 0 for ms in times["lbs"].values())
    assert said[1] == ("timing lbs, top, bottom", 1, 2)
    known = json.loads(path.read_text())
    known["times"]["lbs"]["bottom"] = 123.0
    path.write_text(json.dumps(known))
    assert calibrate(profiles, worn[:1], path=path)["lbs"]["bottom"] == 123.0
    known["machine"]["device"] = "abacus"
    path.write_text(json.dumps(known))
    assert calibrate(profiles, worn[:1], path=path, frames=17)["lbs"]["bottom"] != 123.0
    here = json.loads(path.read_text())
    for broken in ("{", "[]", json.dumps({**here, "times": {"lbs": 1.0}})):
        path.write_text(broken)
        assert calibrate(profiles, worn[:1], path=path, frames=17)["lbs"]["bottom"] > 0


@pytest.mark.release
def test_times_of_another_process_are_kept(tmp_path):
    path = tmp_path / "times.json"
    one, other = (_Clock(path, 16) for _ in range(2))
    one.time_of(profile("lbs", 20.0), ("bottom",))
    other.time_of(profile("lbs", 20.0), ("top",))
    kept = json.loads(path.read_text())
    assert set(kept["times"]["lbs"]) == {"bottom", "top"}
    assert kept["machine"]["cpu"] == processor_name()


# Names of simulators, which need no weights; what they take here is given below.
SLOW = [
    profile("lbs", 40.0, ms=0.2),
    profile("draft", 20.0, ms=10.0),
    profile("standard", 9.0, ms=40.0),
    profile("fine", 1.0, ms=400.0),
]


@pytest.mark.parametrize(
    ("asked", "here", "timed", "picked"),
    [
        # As fast as expected: the best that may fit is timed, and fits.
        ({"budget_ms": 45.0}, 1.0, ["standard"], "standard"),
        # Half as fast: it doesn't fit; the next is expected to, and does.
        ({"budget_ms": 45.0}, 2.0, ["standard", "draft"], "draft"),
        # As fast as expected, so nothing more accurate may fit; three times as fast, and one does.
        ({"budget_ms": 4.0}, 1.0, ["lbs"], "lbs"),
        ({"budget_ms": 4.0}, 0.3, ["lbs", "draft"], "draft"),
        ({"budget_ms": 0.3}, 1.0, ["lbs"], "lbs"),
        ({"max_error_mm": 25.0}, 3.0, ["draft"], "draft"),
        ({"max_error_mm": 2.0}, 1.0, ["fine"], "fine"),
        # Nothing does: the nearest is timed, and named.
        ({"budget_ms": 0.01}, 1.0, ["lbs"], None),
        ({"max_error_mm": 0.5}, 1.0, ["fine"], None),
    ],
)
def test_only_what_matters_for_a_limit_is_timed(tmp_path, monkeypatch, asked, here, timed, picked):
    seen = []

    def measure(_, r, worn):
        seen.append(r.name)
        return here * sum(r.usual_ms[t] for t in worn)

    monkeypatch.setattr(_Clock, "_measure", measure)

    def choose():
        return choose_method(["top"], SLOW, path=tmp_path / "times.json", **asked)

    if picked is None:
        with pytest.raises(PhysXNetError, match=f"nearest is {timed[0]}"):
            choose()
    else:
        assert choose().profile.name == picked
        choose()
    # The second time nothing is.
    assert seen == timed


@settings(max_examples=50, deadline=None)
@given(
    st.lists(
        st.tuples(st.floats(1, 50), st.floats(0.1, 100), st.floats(0.3, 3)), min_size=1, max_size=4
    ),
    st.floats(0.05, 300),
)
def test_what_is_chosen_keeps_the_budget_whatever_was_expected(profiles, budget):
    rungs = [
        profile(n, error, ms=ms)
        for n, (error, ms, _) in zip(("lbs", "draft", "standard", "fine"), profiles, strict=False)
    ]
    truth = {r.name: r.usual_ms["top"] * p[2] for r, p in zip(rungs, profiles, strict=True)}
    with tempfile.TemporaryDirectory() as folder, pytest.MonkeyPatch.context() as patch:
        patch.setattr(_Clock, "_measure", lambda _, r, worn: truth[r.name])
        path = pathlib.Path(folder) / "times.json"
        try:
            choice = choose_method(["top"], rungs, path=path, budget_ms=budget)
        except PhysXNetError:
            # Only if the cheapest by expectation doesn't fit.
            cheapest = min(rungs, key=lambda r: r.usual_ms["top"])
            assert truth[cheapest.name] > budget
        else:
            assert choice.ms_per_frame == truth[choice.profile.name] <= budget


@pytest.mark.nightly
def test_every_packaged_method_can_dress():
    ladder = load_cost_table()
    names = {r.name for r in ladder}
    assert {"lbs", "base+relax+push", "base+guided", "standard"} <= names
    # None that leaves cloth in the body, but skinning.
    assert all(n.endswith(("+push", "+guided")) for n in names - {"lbs", *PRESETS})
    for r in ladder:
        assert set(r.rmse_mm) == set(r.inside) == set(r.usual_ms) == set(TEMPLATES)
        assert r.name.partition("+")[0] in {"lbs", *list_weights(), *PRESETS}
        assert r.identity.startswith(r.name)
    plain = {r.name: r for r in ladder}
    for name, method in (("base+relax+push", "network"), ("base+guided", "guided")):
        clip = dress("walk", ["bottom"], frames=2, include_body=False, **plain[name].options)
        assert clip.method == method
    with pytest.raises(PhysXNetError, match="draft, standard, fine"):
        Simulation.__post_init__(
            types.SimpleNamespace(refine=None, substeps=None, accuracy="perfect")
        )


@pytest.mark.release
def test_dress_uses_the_selected_method(tmp_path, monkeypatch, capsys):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    monkeypatch.setattr(
        "physxnet_jax.cli._calibrate.load_cost_table",
        lambda: [profile("lbs", 20.0)],
    )
    words = ["dress", "walk", "--wear", "bottom", "--frames", "2"]
    assert main([*words, "--max-error-mm", "25"]) == 0
    assert "picked lbs" in capsys.readouterr().out
    assert main([*words, "--max-error-mm", "1"]) == 2
    assert "nearest is lbs" in capsys.readouterr().err
    assert main(["calibrate"]) == 0
    assert "20.0" in capsys.readouterr().out
