"""Cloth on cloth: itself, layers in a stated order, seams."""

import dataclasses

import jax.numpy as jnp
import numpy as np
import pytest

from physxnet_jax.errors import SimulationError
from physxnet_jax.garment import free_garment, square_sheet, tailor, template
from physxnet_jax.geometry import closest_points, make_mesh, mesh_edges, vertex_normals
from physxnet_jax.motion import load_motion
from physxnet_jax.simulation import (
    STANDARD,
    XPBD,
    Clock,
    Scene,
    Status,
    prepare_scene,
    settle_on_static_body,
    simulate,
    standard_effects,
)
from physxnet_jax.simulation._effect import Step
from physxnet_jax.simulation.effects import (
    Bend,
    Gravity,
    LayerContact,
    Pin,
    Seam,
    SelfContact,
    Stretch,
)
from physxnet_jax.simulation.effects._pairs import Pairs, separate_pairs, smooth_normals

STEPS = XPBD(32, 4)


def two_sheets(n=8, size=0.3):
    """One garment of two level sheets: the lower is held, the upper falls on it."""
    low, high = square_sheet(n, size), square_sheet(n, size / 2, corner=(0.08, 0.03, 1.58))
    v = np.concatenate([np.asarray(g.mesh.vertices) for g in (low, high)])
    f = np.concatenate([np.asarray(low.mesh.faces), np.asarray(high.mesh.faces) + n * n])
    return free_garment(v, f, pinned=np.arange(n * n)), n * n


@pytest.mark.release
def test_self_contact_stops_a_falling_sheet_on_another():
    g, first = two_sheets()
    effects = (Gravity(), Stretch(), SelfContact(gap=0.004), Pin())
    out = settle_on_static_body(prepare_scene(Scene((g,), effects)), 20, solver=STEPS)
    above = out.positions[0][:, first:, 1]
    assert above[-1].min() > 0.003
    assert above.min() > 0.0, "never below, on the way either"
    assert np.abs(np.diff(above[-3:], axis=0)).max() < 2e-3, "it lies still"
    # It stops where it lands; without self-contact it falls through.
    none = tuple(e for e in effects if not isinstance(e, SelfContact))
    free = settle_on_static_body(prepare_scene(Scene((g,), none)), 20, solver=STEPS)
    assert free.positions[0][-1, first:, 1].max() < -0.5


@pytest.mark.release
def test_grid_search_finds_the_nearest_vertex_on_each_side():
    """Against all pairs, for a crumpled cloud; a cell that is too small says so."""
    rng = np.random.default_rng(0)
    g = square_sheet(12, 0.5)
    e = prepare_scene(Scene((g,), (SelfContact(),))).effects[0]
    x = rng.uniform(0, 0.25, (144, 3)).astype(np.float32) - 0.1
    near, crowd = e.nearest(jnp.asarray(x))
    assert int(crowd) == 0
    gap = x[None] - x[:, None]
    distance = np.linalg.norm(gap, axis=2)
    rest = np.asarray(e.rest)
    # A level sheet: all of it is one piece and faces one way.
    distance[np.linalg.norm(rest[None] - rest[:, None], axis=2) <= e.apart] = np.inf
    normals = smooth_normals(jnp.asarray(x)[..., None], e.faces)[..., 0]
    front = np.einsum("abi,ai->ab", gap, np.asarray(normals)) >= 0
    for side, found in zip((front, ~front), np.asarray(near), strict=True):
        d = np.where(side, distance, np.inf)
        best, least = d.argmin(axis=1), d.min(axis=1)
        close = least < e.reach
        assert close.sum() > 30
        assert (found[close] == best[close]).all()
    tiny = dataclasses.replace(e, law=dataclasses.replace(e.law, room=1))
    assert int(tiny.nearest(jnp.asarray(x))[1]) > 0


@pytest.mark.release
def test_self_contact_without_contacts_is_bitwise_neutral():
    g = square_sheet(6)
    plain = (Gravity(), Stretch(), Pin())
    runs = [
        settle_on_static_body(prepare_scene(Scene((g,), e)), 5, solver=STEPS).positions[0]
        for e in (plain, (*plain[:2], SelfContact(), Pin()))
    ]
    np.testing.assert_array_equal(*runs)


@pytest.mark.release
@pytest.mark.parametrize("start", [0.03, -0.01], ids=["outside", "inside"])
def test_layers_keep_or_regain_their_order(start):
    """Upright sheets before the body; the outer one is thrown at the inner one, or
    begins behind it, and ends before it."""
    inner = square_sheet(10, 0.3, upright=True, pinned=np.arange(100))
    outer = square_sheet(7, 0.18, upright=True, corner=(0.06, -0.06, 1.5 + start))
    effects = (Stretch(), Bend(), LayerContact(), Pin())
    scene = prepare_scene(Scene((inner, outer), effects))
    v = np.zeros((149, 3))
    v[100:, 2] = -1.0 if start > 0 else 0.0
    out = settle_on_static_body(scene, 12, solver=STEPS, velocity=v)
    front = out.positions[1][-1][:, 2] - 1.5
    assert front.min() > 0.002
    assert (out.diagnostics["layers_crossed"][-1] == 0).all()
    if start > 0:
        free = prepare_scene(Scene((inner, outer), (Stretch(), Pin())))
        through = settle_on_static_body(free, 12, solver=STEPS, velocity=v)
        assert through.positions[1][-1][:, 2].max() < 1.4
    else:
        assert out.status[0] & Status.CROSSED, "said while it lasts"
        assert out.diagnostics["speed_max"].max() < 0.5, "no burst"


def beyond(inner, outer, faces):
    """Heights [m] of the vertices that came out through another garment, hem apart."""
    mesh = make_mesh(outer, faces)
    near = closest_points(mesh, jnp.asarray(inner))
    face = np.asarray(near.face)
    corner = outer[faces[face]]
    foot = (np.asarray(near.weights)[..., None] * corner).sum(axis=1)
    n = np.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0])
    n /= np.linalg.norm(n, axis=1, keepdims=True)
    height = ((inner - foot) * n).sum(axis=1)
    edges = mesh_edges(faces)
    rim = np.unique(edges.vertices[edges.count == 1])
    hem = np.isin(faces[face], rim).any(axis=1)
    return height[(height > 5e-4) & ~hem]


@pytest.mark.release
def test_top_stays_outside_the_trousers():
    motion = load_motion("walk", fps=30.0)
    motion = dataclasses.replace(motion, rotations=motion.rotations[:10], root=motion.root[:10])
    effects = (*STANDARD[:4], LayerContact(), *STANDARD[4:])
    out = simulate(Scene((template("bottom"), template("top")), effects), motion)
    faces = np.asarray(template("top").mesh.faces)
    for trousers, top in zip(*out.positions, strict=True):
        seen = beyond(trousers, top, faces)
        assert len(seen) <= 3, "of 2,726"
        assert seen.max(initial=0.0) < 0.004
    # Where the thigh folds into the belly both layers lie midway, through each other: 8
    # vertices and 20 mm on one machine, 10 and 30 on another, as rounding decides.
    assert out.diagnostics["layers_crossed"].max() <= 16
    assert out.diagnostics["layers_depth"].max() < 0.04
    assert out.diagnostics["penetration_max"].max() < 0.003
    # Trousers blown up by 2 cm do come out: the measure sees them.
    out_of = trousers + 0.02 * np.asarray(vertex_normals(trousers, template("bottom").mesh.faces))
    assert len(beyond(out_of, top, faces)) > 100


def test_seams_close_the_gap_between_panels():
    left = square_sheet(6, 0.2, upright=True, pinned=np.arange(0, 36, 6))
    right = square_sheet(6, 0.2, upright=True, corner=(0.24, 0.0, 1.5))
    edge = tuple((6 * i + 5, 36 + 6 * i) for i in range(6))
    scene = prepare_scene(Scene((left, right), (Stretch(), Seam(edge), Pin())))
    out = settle_on_static_body(scene, 45, solver=STEPS)
    a, b = (np.asarray(edge)[:, k] for k in range(2))
    gap = np.linalg.norm(out.positions[0][-1][a] - out.positions[1][-1][b - 36], axis=1)
    assert gap.max() < 2e-3
    with pytest.raises(SimulationError, match="names vertex 99"):
        prepare_scene(Scene((left, right), (Seam(((0, 99),)),)))


@pytest.mark.release
def test_cloth_contact_does_not_depend_on_absolute_time():
    """The gap a pair keeps doesn't depend on where in time the block lies."""
    g, _ = two_sheets()
    e = prepare_scene(Scene((g,), (SelfContact(),))).effects[0]
    x = e.rest[:, :, None]
    pairs = [
        e.begin(x, None, None, Clock(jnp.float32(t), 0.01), e.init_state(1)).pairs
        for t in (0.0, 5.0)
    ]
    np.testing.assert_array_equal(pairs[0].height, pairs[1].height)


@pytest.mark.parametrize("friction", [0.0, 0.3, 10.0])
def test_friction_limits_sliding_of_cloth_on_cloth(friction):
    """A vertex 3 mm too deep that slid by 10 mm over a held triangle."""
    one = lambda *x: jnp.asarray(x, jnp.float32)  # noqa: E731
    pairs = Pairs(
        jnp.zeros((1, 1), jnp.int32),
        jnp.asarray([[[1]], [[2]], [[3]]], jnp.int32),
        jnp.full((3, 1, 1), 1 / 3),
        one(0, 1, 0)[None, :, None],
        one(0.001)[None, None],
        jnp.ones((1, 1, 1)),
    )
    start = jnp.zeros((4, 3, 1))
    moved = start.at[0, :, 0].set(one(0.010, -0.002, 0.0))
    mass = one(1, 0, 0, 0)[:, None, None]
    law = SelfContact(gap=0.002, friction=friction, leave=1.0)
    clock = Clock(jnp.float32(0.0), 1.0)
    out = np.asarray(separate_pairs(moved, start, pairs, mass, law, clock, jnp.float32(1.0)))[
        ..., 0
    ]
    left = 0.010 - min(friction * 0.003, 0.010)
    np.testing.assert_allclose(out[0], [left, 0.001, 0.0], atol=1e-6)
    assert not out[1:].any()


@pytest.mark.release
def test_self_contact_is_within_each_garment_only():
    """A sheet a millimetre above another: as one garment they meet, as two they don't."""
    low, high = square_sheet(6, 0.2), square_sheet(6, 0.2, corner=(0.0, 0.001, 1.5))
    v = np.concatenate([np.asarray(g.mesh.vertices) for g in (low, high)])
    f = np.concatenate([np.asarray(low.mesh.faces), np.asarray(high.mesh.faces) + 36])
    for garments, meet in (((free_garment(v, f),), True), ((low, high), False)):
        (contact,) = prepare_scene(Scene(garments, (SelfContact(),))).effects
        near, _ = contact.nearest(jnp.asarray(v, jnp.float32))
        other = (np.asarray(near) >= 36) != (np.arange(72) >= 36)
        assert bool((other & (np.asarray(near) >= 0)).any()) == meet


@pytest.mark.release
@pytest.mark.parametrize(("held", "share"), [(True, 1.0), (False, 0.5)])
def test_layers_move_each_vertex_by_its_share(held, share):
    """Two like sheets, vertex over vertex, pressed together: to the gap, or half of the way each."""
    low = square_sheet(6, 0.2, upright=True, pinned=np.arange(36) if held else None)
    high = square_sheet(6, 0.2, upright=True, corner=(0.0, 0.0, 1.505))
    scene = prepare_scene(Scene((low, high), (LayerContact(gap=0.003, friction=0.0), Pin())))
    layers = scene.effects[0]
    x = jnp.asarray(scene.assembly.rest, jnp.float32)[:, :, None]
    x = x.at[36:].set(x[:36] + jnp.asarray([0.0, 0.0, 0.005])[None, :, None])
    context = layers.begin(x, None, None, Clock(jnp.float32(0.0), 1 / 30), layers.init_state(1))
    pressed = jnp.zeros_like(x).at[36:, 2].set(-0.004)
    step = Step(1 / 240, 1 / 8)
    moved = layers.project(pressed, pressed, context, jnp.float32(0.5), step)
    deep = np.asarray((moved - pressed)[:, 2, 0])
    # 1 mm apart, where 3 are wanted: without friction nothing moves along the sheets.
    np.testing.assert_allclose(deep[36:], share * 0.002, atol=1e-6)
    np.testing.assert_allclose(deep[:36], -(1.0 - share) * 0.002, atol=1e-6)
    assert float(jnp.abs((moved - pressed)[:, :2]).max()) < 1e-6
    free = layers.project(0 * pressed, 0 * pressed, context, jnp.float32(0.5), step)
    assert not np.asarray(free).any()


@pytest.mark.release
@pytest.mark.parametrize(("limbs", "meet"), [((1, 0), True), ((3, 0), True), ((3, 1), False)])
def test_layer_contact_is_active_only_between_adjacent_limbs(limbs, meet):
    """A sleeve by the hip is no layer over the trousers' leg."""
    low, high = square_sheet(6, 0.2), square_sheet(6, 0.2, corner=(0.0, 0.002, 1.5))
    scene = prepare_scene(Scene((low, high), (LayerContact(),)))
    (layers,) = scene.effects
    layers = dataclasses.replace(layers, label=jnp.repeat(jnp.asarray(limbs, jnp.int32), 36))
    x = jnp.asarray(scene.assembly.rest, jnp.float32)[:, :, None]
    clock = Clock(jnp.float32(0.0), 0.01)
    pairs = layers.begin(x, None, None, clock, layers.init_state(1)).pairs
    assert bool((pairs.active > 0).any()) == meet


def test_separation_conserves_momentum_where_pairs_share_vertices():
    """Three vertices of different masses that press on one triangle."""
    rng = np.random.default_rng(0)
    vertex = jnp.asarray([[0], [1], [2]], jnp.int32)
    corners = jnp.repeat(jnp.asarray([3, 4, 5], jnp.int32)[:, None, None], 3, axis=1)
    weights = jnp.asarray(rng.dirichlet([1, 1, 1], 3).T[..., None], jnp.float32)
    normal = jnp.tile(jnp.asarray([0.0, 1.0, 0.0])[None, :, None], (3, 1, 1))
    height = jnp.asarray([[[0.001]], [[-0.004]], [[0.0]]])
    pairs = Pairs(vertex, corners, weights, normal, height, jnp.ones((3, 1, 1)))
    start = jnp.asarray(1e-3 * rng.normal(size=(6, 3, 1)), jnp.float32)
    moved = start + jnp.asarray(1e-3 * rng.normal(size=(6, 3, 1)), jnp.float32)
    inverse = jnp.asarray(rng.uniform(0.5, 2.0, (6, 1, 1)), jnp.float32)
    law = SelfContact(gap=0.003, friction=0.4, leave=1.0)
    clock, done = Clock(jnp.float32(0.0), 1.0), jnp.float32(1.0)
    step = separate_pairs(moved, start, pairs, inverse, law, clock, done) - moved
    assert float(jnp.abs(step).max()) > 1e-4
    np.testing.assert_allclose(jnp.sum(step / inverse, axis=0), 0.0, atol=1e-8)


def folded_sheet(n=9, size=0.16, angle=120.0):
    """Vertices and faces of an upright sheet, its halves turned back about its vertical middle."""
    g = square_sheet(n, size, upright=True)
    v = np.array(g.mesh.vertices)
    x = v[:, 0] - v[:, 0].mean()
    turn = np.radians(angle / 2)
    v[:, 0], v[:, 2] = x * np.cos(turn), v[:, 2] - np.abs(x) * np.sin(turn)
    return v, np.asarray(g.mesh.faces)


@pytest.mark.release
@pytest.mark.parametrize("before", [True, False])
def test_side_of_a_layer_is_right_beside_a_sharp_fold(before):
    """Points before a ridge are outside, whichever of its triangles is the closest."""
    v, f = folded_sheet()
    ridge = v[np.abs(v[:, 0]) < 1e-6]
    step, aside = (0.006, 0.004) if before else (-0.006, 0.001)
    points = np.concatenate([ridge + [dx, 0.0, step] for dx in (-aside, 0.0, aside)])
    # Each point is a small triangle of the outer garment.
    corner = np.array([[0, 0, 0], [1e-3, 0, 0], [0, 1e-3, 0]])
    small = (points[:, None] + corner).reshape(-1, 3)
    outer = free_garment(small, np.arange(len(small)).reshape(-1, 3))
    scene = prepare_scene(Scene((free_garment(v, f), outer), (LayerContact(),)))
    (layers,) = scene.effects
    x = jnp.asarray(scene.assembly.rest, jnp.float32)[:, :, None]
    pairs = layers.begin(x, None, None, Clock(jnp.float32(0.0), 0.01), layers.init_state(1)).pairs
    height = np.asarray(pairs.height)[np.asarray(layers.rows) >= len(v)]
    assert ((height > 0) == before).all()


@pytest.mark.release
def test_layers_of_folds_that_face_each_other_stay_apart():
    """An outer sheet turned over and laid behind the inner one isn't drawn through it."""
    inner = square_sheet(8, 0.2, upright=True)
    v = np.array(square_sheet(6, 0.1, upright=True, corner=(0.05, 0.0, 1.495)).mesh.vertices)
    scene = prepare_scene(
        Scene(
            (inner, square_sheet(6, 0.1, upright=True, corner=(0.05, 0.0, 1.51))), (LayerContact(),)
        )
    )
    (layers,) = scene.effects
    x = np.array(scene.assembly.rest)
    for turned in (False, True):
        x[64:] = v
        if turned:
            x[64:, 0] = 2 * v[:, 0].mean() - v[:, 0]
        clock = Clock(jnp.float32(0.0), 0.01)
        pairs = layers.begin(
            jnp.asarray(x, jnp.float32)[:, :, None], None, None, clock, layers.init_state(1)
        ).pairs
        behind = np.asarray(pairs.height)[np.asarray(layers.rows) >= 64]
        assert ((behind > 0) == turned).all()


@pytest.mark.nightly
def test_a_loose_top_over_a_shirt_keeps_its_order():
    motion = load_motion("punch", fps=30.0)
    motion = dataclasses.replace(motion, rotations=motion.rotations[:20], root=motion.root[:20])
    garments = (tailor("shirt"), tailor("loose"))
    out = simulate(Scene(garments, standard_effects(garments)), motion)
    # Of 9,049 vertices that have another layer beside them.
    assert out.diagnostics["layers_crossed"].max() < 200
    assert out.diagnostics["slipped"].max() < 0.05
    hems = [
        p[-1][np.unique(np.asarray(g.loops["hem"])), 1] for p, g in zip(out.positions, garments)
    ]
    assert all(h.std() < 0.05 for h in hems)
