"""Charts are smooth maps of the body's surface, and their halves meet at the seams."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from physxnet_jax.garment import clearance
from physxnet_jax.garment.tailoring import build_charts
from physxnet_jax.garment.tailoring._charts import (
    CHARTS,
    HEIGHT,
    carrier,
    charts_from_arrays,
    load_charts,
    place_table,
)
from physxnet_jax.garment.tailoring._curves import (
    centre_point,
    level_curve,
    rings,
    seam_points,
    seam_row,
)
from physxnet_jax.garment.tailoring._grid import SPACING, extension, spline


@pytest.fixture(scope="module")
def surface(body):
    charts = load_charts()
    rest = body.rest_vertices(body.default_shape())
    return charts, np.asarray(jax.jit(lambda r: carrier(r, charts))(rest))


def at(charts, surface, name, uv, right=False):
    chart = charts.chart(name)
    index, weight = spline(chart.origin, uv, chart.fields.shape[:2])
    return (surface[index + charts.start(name, right)] * weight[..., None]).sum(axis=1)


def test_spline_reproduces_linear_functions_and_its_weights_sum_to_one():
    rows, columns = 9, 11
    y, x = np.mgrid[:rows, :columns] * SPACING
    values = (2 * x - 3 * y + 1).ravel()
    uv = np.random.default_rng(0).uniform(2.5 * SPACING, 5.5 * SPACING, (40, 2))
    for places in (uv, jnp.asarray(uv, jnp.float32)):
        index, weight = spline(np.zeros(2, np.float32), places, (rows, columns))
        weight = np.asarray(weight, np.float64)
        assert weight.sum(axis=1) == pytest.approx(1.0, abs=1e-5)
        found = (values[np.asarray(index)] * weight).sum(axis=1)
        assert found == pytest.approx(2 * uv[:, 0] - 3 * uv[:, 1] + 1, abs=1e-5)


def test_a_grid_goes_on_linearly_beyond_what_is_known():
    inside = np.zeros((12, 14), bool)
    inside[4:8, 4:9] = True
    y, x = np.mgrid[:12, :14].astype(float)
    truth = (0.5 * x - 2 * y + 3).ravel()
    values = np.where(inside.ravel(), truth, np.nan)
    for target, near, far, share in extension(inside):
        beyond = np.where(share > 0, 2 * values[near] - values[far], 0.0)
        values[target] = (share * beyond).sum(axis=1)
    assert np.isfinite(values).sum() > 2 * inside.sum()
    known = np.isfinite(values)
    assert values[known] == pytest.approx(truth[known])


def test_front_and_back_meet_at_the_seams(surface):
    charts, nodes = surface
    for seam in (charts.side, charts.inseam, charts.over):
        inner = seam[3:-3]
        front, back = (
            at(charts, nodes, "front", inner[:, :2]),
            at(charts, nodes, "back", inner[:, 2:]),
        )
        gap = np.linalg.norm(front[:, :3] - back[:, :3], axis=1)
        assert np.median(gap) < 2e-3 and gap.max() < 7e-3


def test_carrier_lies_outside_the_skin_and_mirrors(body, surface):
    charts, nodes = surface
    skin = body.rest_mesh()
    for name in ("front", "back"):
        inner = charts.chart(name).inside.ravel()
        left = nodes[charts.start(name, False) :][: len(inner)][inner]
        right = nodes[charts.start(name, True) :][: len(inner)][inner]
        points = left[:, :3] + left[:, 6:] * left[:, 3:6]
        distance, away = clearance(skin, points)
        assert np.quantile(distance, 0.01) > 0.004 and np.median(distance) < 0.015
        assert (np.sum(away * left[:, 3:6], axis=1) > 0.5).mean() > 0.97
        np.testing.assert_allclose(right[:, :3], left[:, :3] * [-1, 1, 1], atol=1e-4)


def test_rings_lie_at_their_heights(surface):
    _, nodes = surface
    for part in ("torso", "leg", "skirt"):
        table = rings(part)
        p = (nodes[table.nodes][..., :3] * table.weights[..., None]).sum(axis=3)
        np.testing.assert_allclose(p[..., 1].mean(axis=(1, 2)), table.levels, atol=0.004)


def test_levels_are_found_along_seams_and_across_charts(surface):
    charts, _ = surface
    low = charts.side[: charts.armpit + 1]
    end = seam_points(low, np.array([seam_row(charts, low, HEIGHT, 0.1)]))[0]
    start = centre_point(charts, "front", 0.1)
    curve = level_curve(charts.front, HEIGHT, start, end[:2])
    # Ends lie on polylines, what is between is solved for.
    assert charts.front.field(curve[1:-1], HEIGHT) == pytest.approx(0.1, abs=2e-3)
    assert start[0] == pytest.approx(0.0, abs=1e-9)


def test_tapes_measure_a_body(body):
    charts = load_charts()
    slim = body.rest_vertices(body.shape(weight_down=1.0))
    usual = body.rest_vertices(body.default_shape())
    broad = body.rest_vertices(body.shape(weight_up=1.0))
    for name, tape in charts.tapes.items():
        lengths = [float(tape.length(r)) for r in (slim, usual, broad)]
        assert lengths == sorted(lengths) and lengths[0] < 0.99 * lengths[2], name
    assert 0.8 < float(charts.tapes["chest"].length(usual)) < 0.9
    # Twice as large a body has twice the girth.
    double = charts.tapes["hip"].length(2.0 * usual)
    assert float(double) == pytest.approx(2.0 * float(charts.tapes["hip"].length(usual)))


def test_attachment_weights_are_means(body):
    for name in CHARTS:
        for right in (False, True):
            refs, weights = place_table(name, right)
            assert weights.min() >= 0 and weights.sum(axis=1) == pytest.approx(1.0, abs=1e-5)
            assert refs.max() < len(body.bases[0])


@pytest.mark.nightly
def test_stored_charts_are_those_that_are_drawn(body):
    drawn = charts_from_arrays(build_charts(body))
    stored = load_charts()
    for name in CHARTS:
        a, b = drawn.chart(name), stored.chart(name)
        assert a.fields.shape == b.fields.shape
        np.testing.assert_allclose(a.fields[a.inside], b.fields[b.inside], atol=1e-4)
    np.testing.assert_allclose(drawn.side, stored.side, atol=1e-6)
