"""Garments have the measures that they are asked for, on clean meshes, as smooth functions."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import trimesh

from physxnet_jax.errors import PhysXNetError
from physxnet_jax.garment import KINDS, clearance, cut_vertices, tailor
from physxnet_jax.garment.tailoring import resolve_measures
from physxnet_jax.garment.tailoring._charts import load_charts
from physxnet_jax.geometry import (
    boundary_loops,
    manifold_report,
    mesh_edges,
    self_intersections,
    vertex_normals,
)

QUICK = ("shorts", "skirt")
OPENINGS = {"top": 4, "strapless": 2, "trousers": 3, "skirt": 2, "dress": 4, "strapless-dress": 2}


def edge_lengths(v, f):
    edges = mesh_edges(f).vertices
    return np.linalg.norm(v[edges[:, 0]] - v[edges[:, 1]], axis=1)


def smallest_angles(v, f):
    out = []
    for k in range(3):
        a, b, c = (v[f[:, (k + j) % 3]] for j in range(3))
        u, w = b - a, c - a
        cos = (u * w).sum(axis=1) / (np.linalg.norm(u, axis=1) * np.linalg.norm(w, axis=1))
        out.append(np.degrees(np.arccos(np.clip(cos, -1, 1))))
    return np.min(out, axis=0)


def around(v, f, height, left=False):
    """Length of the cut of a mesh by a level plane."""
    cut = trimesh.intersections.mesh_plane(
        trimesh.Trimesh(v, f, process=False), [0, 1, 0], [0, height, 0]
    )
    cut = cut[cut[:, :, 0].mean(axis=1) > 0] if left else cut
    return float(np.linalg.norm(cut[:, 0] - cut[:, 1], axis=1).sum())


def arrays(garment):
    return np.asarray(garment.mesh.vertices, np.float64), np.asarray(garment.mesh.faces)


def every_kind():
    return [k if k in QUICK else pytest.param(k, marks=pytest.mark.release) for k in KINDS]


@pytest.mark.sampled(5)
@pytest.mark.release
@pytest.mark.parametrize("name", every_kind())
def test_every_kind_is_a_clean_mesh_around_the_body(body, name):
    kind, g = KINDS[name], tailor(name)
    v, f = arrays(g)
    report = manifold_report(f)
    assert report["non_manifold_edges"] == report["duplicate_faces"] == 0
    assert report["inconsistent_edges"] == 0
    assert len(boundary_loops(f)) == OPENINGS[kind.style]
    assert 0.012 <= np.median(edge_lengths(v, f)) <= 0.016
    assert np.quantile(smallest_angles(v, f), 0.01) > 20.0
    distance, away = clearance(body.rest_mesh(), v)
    assert distance.min() > 0.0
    normals = np.asarray(vertex_normals(g.mesh.vertices, g.mesh.faces))
    near = distance < 0.025
    assert np.mean((normals * away).sum(axis=1)[near] > 0) > 0.75
    np.testing.assert_allclose(np.asarray(g.skin).sum(axis=1), 1.0, atol=1e-5)
    # Left and right are mirror images.
    mirrored = np.sort((v * [-1, 1, 1])[:, 0])
    np.testing.assert_allclose(mirrored, np.sort(v[:, 0]), atol=1e-4)


@pytest.mark.parametrize("name", every_kind())
def test_borders_are_straight(name):
    v, f = arrays(tailor(name))
    for loop in boundary_loops(f):
        p = v[loop]
        flat = np.linalg.svd(p - p.mean(axis=0))[1][-1] / np.sqrt(len(p))
        neckline = p[:, 1].mean() > 0.45
        assert flat < (0.03 if neckline else 5e-4)


@pytest.mark.parametrize("name", every_kind())
def test_pattern_is_in_metres_and_does_not_overlap(name):
    g = tailor(name)
    v, f = arrays(g)
    uv, uv_faces = np.asarray(g.mesh.uv, np.float64), np.asarray(g.mesh.uv_faces)
    a, b, c = (uv[uv_faces[:, k]] for k in range(3))
    area = 0.5 * ((b - a)[:, 0] * (c - a)[:, 1] - (b - a)[:, 1] * (c - a)[:, 0])
    solid = 0.5 * np.linalg.norm(np.cross(v[f[:, 1]] - v[f[:, 0]], v[f[:, 2]] - v[f[:, 0]]), axis=1)
    assert (area > 0).all()
    assert area.sum() == pytest.approx(solid.sum(), rel=0.01)
    assert np.quantile(np.abs(area / solid - 1), 0.95) < 0.12
    # No two triangles that share no corner cover each other: midpoints lie in one triangle only.
    middles = (a + b + c) / 3
    cells = np.floor(middles / 0.01).astype(int)
    order = np.lexsort(cells.T)
    same = (np.diff(cells[order], axis=0) == 0).all(axis=1)
    for k in np.flatnonzero(same)[:2000]:
        one, two = order[k], order[k + 1]
        sides = [
            (b[two] - a[two], middles[one] - a[two]),
            (c[two] - b[two], middles[one] - b[two]),
            (a[two] - c[two], middles[one] - c[two]),
        ]
        assert not all(s[0] * m[1] - s[1] * m[0] > 0 for s, m in sides)


@pytest.mark.release
@pytest.mark.parametrize("ease", [0.05, 0.12])
def test_ease_is_what_the_garment_is_wider_than_the_body(body, ease):
    charts = load_charts()
    rest = body.rest_vertices(body.default_shape())
    for name, tape, left in (("skirt", "hip", False), ("shorts", "thigh", True)):
        v, f = arrays(tailor(name, ease=ease))
        found = around(v, f, charts.tapes[tape].level, left) - float(
            charts.tapes[tape].length(rest)
        )
        assert found == pytest.approx(ease, abs=0.012), name


@pytest.mark.sampled(5)
@pytest.mark.release
@pytest.mark.parametrize("name", every_kind())
def test_no_garment_crosses_itself_at_rest(name):
    ranges = KINDS[name].ranges
    for ease in (ranges["ease"].low, ranges["ease"].default, ranges["ease"].high):
        for flare in (ranges["flare"].default, ranges["flare"].high):
            assert not len(self_intersections(*arrays(tailor(name, ease=ease, flare=flare))))


def test_a_crossing_at_rest_would_be_found():
    v, f = arrays(tailor("shorts"))
    # The left leg moved into the right one.
    v[v[:, 0] > 0.02, 0] -= 0.08
    assert len(self_intersections(v, f))


def test_length_runs_down_to_the_hem_and_flare_widens_it():
    for name, length in (("skirt", 0.5), ("skirt", 0.62), ("shorts", 0.4)):
        v, f = arrays(tailor(name, length=length))
        loops = sorted(boundary_loops(f), key=lambda x: v[x, 1].mean())
        assert np.ptp(v[[loops[0][0], loops[-1][0]], 1]) == pytest.approx(length, abs=0.003)

    def hem(flare):
        v, f = arrays(tailor("skirt", flare=flare))
        loop = min(boundary_loops(f), key=lambda x: v[x, 1].mean())
        return np.linalg.norm(v[loop] - v[np.roll(loop, 1)], axis=1).sum()

    assert hem(0.6) - hem(0.3) == pytest.approx(0.3, abs=0.02)


@pytest.mark.release
def test_sleeves_and_necklines_follow_their_measures():
    def loop(measures, which):
        v, f = arrays(tailor("tee", **measures))
        loops = boundary_loops(f)
        key = {"cuff": lambda x: v[x, 0].mean(), "neck": lambda x: v[x, 1].mean()}[which]
        return v[max(loops, key=key)]

    short, long = (loop({"sleeve": s}, "cuff").mean(axis=0) for s in (0.16, 0.26))
    assert np.linalg.norm(long - short) == pytest.approx(0.1, abs=0.015)
    high, deep = (loop({"neckline": s}, "neck")[:, 1].min() for s in (0.06, 0.14))
    assert high - deep == pytest.approx(0.08, abs=0.02)


@pytest.mark.release
@pytest.mark.parametrize(
    "name", ["skirt", *(pytest.param(k, marks=pytest.mark.release) for k in ("tee", "shorts"))]
)
def test_gradients_agree_with_finite_differences(name):
    ranges = KINDS[name].ranges
    point = {k: 0.7 * r.default + 0.3 * 0.5 * (r.low + r.high) for k, r in ranges.items()}
    like = {k: r.default for k, r in ranges.items()}

    def cut(measures):
        return cut_vertices(name, measures, like=like)

    floats = {k: jnp.asarray(v, jnp.float32) for k, v in point.items()}
    for key in ranges:
        unit = {k: jnp.asarray(float(k == key), jnp.float32) for k in ranges}
        _, slope = jax.jvp(cut, (floats,), (unit,))
        step = 2e-3
        ends = [cut(floats | {key: floats[key] + s}) for s in (-step, step)]
        rough = np.asarray(ends[1] - ends[0], np.float64) / (2 * step)
        gap = np.linalg.norm(np.asarray(slope) - rough, axis=1)
        size = np.linalg.norm(rough, axis=1).max()
        assert size > 0.1
        assert np.quantile(gap, 0.99) < 0.02 * size and gap.max() < 0.1 * size, key
    # Backwards through the same programs.
    direction = jax.random.normal(jax.random.key(0), cut(floats).shape)
    back = jax.grad(lambda m: jnp.sum(direction * cut(m)))(floats)["ease"]
    unit = {k: jnp.asarray(float(k == "ease"), jnp.float32) for k in ranges}
    forwards = jnp.sum(direction * jax.jvp(cut, (floats,), (unit,))[1])
    assert float(back) == pytest.approx(float(forwards), rel=1e-3, abs=1e-3)


def test_garments_are_cut_to_the_person(body):
    charts = load_charts()
    for values in ({"weight_up": 0.8}, {"height_up": 0.8}, {"gender": 1.0}):
        shape = body.shape(**values)
        rest = body.rest_vertices(shape)
        g = tailor("shorts", shape=shape)
        v, f = np.asarray(g.rest_vertices(rest), np.float64), np.asarray(g.mesh.faces)
        distance, _ = clearance(body.rest_mesh(shape), v)
        assert np.mean(distance < 0) < 0.002
        # The thigh's tape moves with the body; its height there is that of its points.
        tape = charts.tapes["thigh"]
        height = float(jnp.mean(jnp.sum(rest[tape.refs][..., 1] * tape.weights, axis=1)))
        ease = around(v, f, height, left=True) - float(tape.length(rest))
        assert ease == pytest.approx(KINDS["shorts"].ranges["ease"].default, abs=0.03)
        loops = sorted(boundary_loops(f), key=lambda x: v[x, 1].mean())
        length = v[loops[-1], 1].mean() - v[loops[0], 1].mean()
        assert length == pytest.approx(KINDS["shorts"].ranges["length"].default, abs=0.003)


@pytest.mark.release
def test_cutting_is_differentiable_by_shape(body):
    zeros = body.default_shape()

    def width(shape):
        return jnp.ptp(cut_vertices("skirt", {}, shape=shape)[:, 0])

    slope = np.asarray(jax.grad(width)(zeros))
    assert np.isfinite(slope).all() and slope[body.shape_names.index("weight_up")] > 0.01
    step = 0.02 * np.eye(len(zeros), dtype=np.float32)[1]
    rough = (float(width(zeros + step)) - float(width(zeros - step))) / 0.04
    assert float(slope[1]) == pytest.approx(rough, rel=0.05)


def test_held_curves_follow_the_skin():
    waist = tailor("skirt", hold=("waist",))
    v, _ = arrays(waist)
    held = np.asarray(waist.pinned)
    assert held.any() and np.ptp(v[held, 1]) < 1e-3
    usual = tailor("skirt")
    assert not np.asarray(usual.pinned).any()
    assert usual.elastic == ("waist",) and waist.elastic == ()
    both = np.asarray(tailor("shorts", hold=("waist", "hem")).pinned)
    assert np.ptp(arrays(tailor("shorts"))[0][both, 1]) > 0.3


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        ({"kind": "kilt"}, "makes no 'kilt'; there are tee"),
        ({"kind": "skirt", "sleeve": 0.2}, "skirt has no sleeve; it has ease, length, flare"),
        ({"kind": "tee", "ease": 2.0}, "ease=2: tee is cut with 0.04 to 0.3 m"),
        ({"kind": "shorts", "fabric": "tin"}, "No fabric 'tin'; there are cotton"),
        ({"kind": "shorts", "hold": ("neckline",)}, "shorts has no neckline to hold; it has"),
    ],
)
def test_wrong_orders_are_refused(arguments, words):
    with pytest.raises(PhysXNetError, match=words):
        tailor(**arguments)


def test_a_traced_length_needs_a_mesh():
    with pytest.raises(PhysXNetError, match="like"):
        jax.grad(lambda x: cut_vertices("skirt", {"length": x})[0, 0])(0.5)


@pytest.mark.release
def test_stored_patterns_are_those_that_are_drawn():
    from physxnet_jax.garment.tailoring import draw_usual_pattern
    from physxnet_jax.garment.tailoring._pattern import pattern_arrays, stored_pattern

    drawn = draw_usual_pattern("shorts")
    stored = pattern_arrays("shorts", stored_pattern("shorts"))
    assert drawn.keys() == stored.keys()
    for key, value in drawn.items():
        assert value.shape == stored[key].shape, key
        if value.dtype.kind == "f":
            np.testing.assert_allclose(value, stored[key], atol=1e-4, err_msg=key)


@pytest.mark.parametrize(
    "name",
    ["shorts", *(pytest.param(n, marks=pytest.mark.nightly) for n in KINDS if n != "shorts")],
)
def test_stored_cuts_are_those_that_are_cut(body, name):
    from physxnet_jax.garment.tailoring._cut import class_of, cut, pattern_of, stored_cut
    from physxnet_jax.garment.tailoring._measures import kind_of

    rest = body.rest_vertices(body.default_shape())
    measures = resolve_measures(name, {})
    vertices, places = stored_cut(name, measures, rest)
    made, on_chart = cut(name, pattern_of(name, class_of(kind_of(name), measures)), measures, rest)
    # Another processor may round otherwise.
    np.testing.assert_allclose(vertices, made, atol=2e-5)
    assert list(places) == list(on_chart)
    for key, place in places.items():
        np.testing.assert_allclose(place, on_chart[key], atol=1e-4)


def test_stored_cuts_are_for_their_own_measures_and_body(body):
    from physxnet_jax.garment.tailoring._cut import stored_cut

    rest = body.rest_vertices(body.default_shape())
    assert stored_cut("shorts", resolve_measures("shorts", {}), rest) is not None
    assert stored_cut("shorts", resolve_measures("shorts", {"ease": 0.12}), rest) is None
    taller = body.rest_vertices(body.default_shape().at[0].add(0.1))
    assert stored_cut("shorts", resolve_measures("shorts", {}), taller) is None
    assert stored_cut("shorts", resolve_measures("shorts", {}), rest[1:]) is None


@pytest.mark.release
@pytest.mark.parametrize(
    ("name", "measure"), [("tee", "length"), ("skirt", "length"), ("shorts", "ease")]
)
def test_ends_of_ranges_are_clean(body, name, measure):
    r = KINDS[name].ranges[measure]
    for value in (r.low, r.high):
        v, f = arrays(tailor(name, **{measure: value}))
        assert 0.010 <= np.median(edge_lengths(v, f)) <= 0.020
        assert np.quantile(smallest_angles(v, f), 0.01) > 15.0
        assert (clearance(body.rest_mesh(), v)[0] > 0).all()
