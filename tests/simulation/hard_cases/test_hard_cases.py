"""Every hard case of `physxnet stress`, one test each, and controls that bounds can fail."""

import dataclasses

import jax.numpy as jnp
import numpy as np
import pytest

from physxnet_jax.evaluation import CASES, PEER_CASES, Finding, run_case, surface_faults
from physxnet_jax.evaluation._stress_worn import run_own
from physxnet_jax.garment import Fabric, square_sheet, template
from physxnet_jax.geometry import vertex_normals
from physxnet_jax.motion import animate
from physxnet_jax.simulation import (
    STANDARD,
    Effect,
    Scene,
    Verlet,
    prepare_scene,
    settle_on_static_body,
    standard_effects,
)
from physxnet_jax.simulation.effects import (
    BodyContact,
    LayerContact,
    Pin,
    Stretch,
    _hinge,
    _membrane,
)

release = pytest.mark.release


# A minute and a half, and 4 GB.
_LARGE = "fifty_thousand_vertices"
# Others of a minute and more; each has a shorter relative in the release tier.
_LONG = (
    _LARGE,
    "a_top_over_trousers",
    "a_minute_of_turns",
    "a_squat_in_a_skirt",
    "edges_of_ten_centimetres",
    "an_effect_that_touches_nothing",
)


def tier(name: str) -> pytest.MarkDecorator:
    return pytest.mark.nightly if name in _LONG else release


@pytest.mark.sampled(9)
@pytest.mark.parametrize("name", [pytest.param(name, marks=tier(name)) for name in CASES])
def test_hard_case_findings_hold(name):
    for finding in run_case(name):
        assert finding.holds, finding


def without(kind: type[Effect], *worn: str) -> tuple[Effect, ...]:
    garments = [template(w) for w in worn or ("top",)]
    return tuple(e for e in standard_effects(garments) if not isinstance(e, kind))


def vertices_only() -> tuple[Effect, ...]:
    coarse = BodyContact(sample_spacing=10.0)
    return tuple(coarse if isinstance(e, BodyContact) else e for e in STANDARD)


UNGUARDED = (
    ("edges_of_ten_centimetres", vertices_only(), "visible skin"),
    (_LARGE, without(BodyContact), "skinned cloth"),
    ("a_lined_top", without(BodyContact), "skinned cloth"),
    ("a_cape_on_a_body_that_touches_itself", without(BodyContact), "vertices inside"),
    ("sleeves_on_crossed_arms", without(BodyContact), "skinned cloth"),
    ("a_top_over_trousers", without(LayerContact, "bottom", "top"), "visible inner"),
    ("a_squat_in_a_skirt", without(BodyContact), "slid along"),
    ("a_full_skirt_spun_and_stopped", without(BodyContact), "slid along"),
    ("a_strapless_dress_on_jumps", without(BodyContact), "slid along"),
    ("wide_sleeves_on_crossed_arms", without(BodyContact), "slid along"),
)


@pytest.mark.sampled(2)
@pytest.mark.parametrize(
    ("name", "effects", "quantity"), [pytest.param(*c, marks=tier(c[0])) for c in UNGUARDED]
)
def test_hard_clothes_break_their_bound_without_the_guard(name, effects, quantity):
    _, rows = run_own(name, effects)
    broken = [what for what, bound, measured in rows if not measured <= bound]
    assert any(quantity in what for what in broken), broken


@pytest.mark.release
def test_visible_skin_looks_through_a_lining():
    """The lined top sunk into the body: its lining faces the skin with its outer side."""
    case = PEER_CASES["a_lined_top"]
    garments, motion = case.garments(), case.motion()
    still = dataclasses.replace(motion, rotations=motion.rotations[:1], root=motion.root[:1])
    assembly = prepare_scene(Scene(garments, (Pin(),))).assembly
    rest, weights = (jnp.asarray(x, jnp.float32) for x in (assembly.rest, assembly.weights))
    body_rest = jnp.asarray(assembly.rest_body, jnp.float32)
    normals = vertex_normals(rest, jnp.asarray(assembly.faces))
    half = len(rest) // 2
    # Normals of the lining face the skin.
    outwards = jnp.concatenate([-normals[:half], normals[half:]])
    shares = []
    for depth in (0.0, 0.03):
        x = animate(assembly.body, body_rest, rest - depth * outwards, weights, still)
        shares.append(surface_faults(assembly, still, np.asarray(x)).visible_skin)
    assert shares[0] < 0.01 < 0.05 < shares[1], shares


def test_findings_fail_above_the_bound_and_for_nan():
    assert Finding("x", "y", 1.0, 1.0).holds
    assert not Finding("x", "y", 1.0, 1.1).holds
    assert not Finding("x", "y", 1.0, float("nan")).holds


@pytest.mark.release
def test_slivers_are_thrown_about_without_their_guard(monkeypatch):
    """The control for the degenerate mesh: every triangle counts as sound."""
    for module in (_membrane, _hinge):
        monkeypatch.setattr(module, "sound", lambda x, faces: np.ones(len(faces), bool))
    broken = {f.quantity for f in run_case("degenerate_mesh") if not f.holds}
    assert broken == {"greatest speed (m/s)"}


def test_explicit_solver_explodes_on_a_stiff_sheet():
    """The control for stiffness: Verlet beyond its limit, on the sheet of the case."""
    g = square_sheet(5, fabric=Fabric(stretch=1e6))
    scene = prepare_scene(Scene((g,), (Stretch(),)))
    start = np.asarray(g.mesh.vertices) * [1.01, 1.0, 1.0]
    out = settle_on_static_body(scene, 5, solver=Verlet(32, 1, "float32"), start=start)
    assert out.status.any()
