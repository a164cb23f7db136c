"""Sweeps over colours: every element once, none beside another of its vertices."""

import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings, strategies as st

from physxnet_jax.garment import square_sheet
from physxnet_jax.geometry import greedy_coloring, mesh_edges
from physxnet_jax.simulation.effects._colored import bundled, color_groups, sweep


def elements(seed, count, vertices, corners):
    rng = np.random.default_rng(seed)
    return np.stack([rng.permutation(vertices)[:corners] for _ in range(count)])


@settings(max_examples=40, deadline=None)
@given(st.integers(0, 10**6), st.integers(1, 60), st.integers(5, 30), st.integers(2, 4))
def test_color_groups_cover_all_elements_without_shared_vertices(seed, count, vertices, corners):
    e = elements(seed, count, vertices, corners)
    order, parts = color_groups(e, vertices)
    assert sorted(order) == list(range(count))
    written = []
    for s in parts:
        targets = np.stack([np.asarray(t) for t in s.target], axis=-1)
        for member, target in zip(np.asarray(s.member), targets, strict=True):
            assert len(np.unique(target)) == target.size, "even what is dropped"
            real = (target < vertices).all(axis=1)
            assert (target[~real] >= vertices).all()
            np.testing.assert_array_equal(target[real], e[order[member[real]]])
            written += list(member[real])
    assert written == list(range(count)), "in the order of the colours"


@pytest.mark.parametrize("batch", [1, 3])
def test_sweep_matches_sequential_updates(batch):
    sheet = square_sheet(7, 0.3)
    ends = mesh_edges(np.asarray(sheet.mesh.faces)).vertices
    n = len(sheet.mesh.vertices)
    order, parts = color_groups(ends, n)
    assert 1 < len(parts) < len(greedy_coloring(ends, n)), "fewer loops than colours"
    rng = np.random.default_rng(0)
    d = rng.normal(size=(n, 3, batch)).astype(np.float32)
    pull = rng.uniform(0.1, 0.9, (len(ends), 1, 1)).astype(np.float32)

    def move(rows, known):
        a, b = rows
        return [a + known * (b - a), b - known * (b - a)]

    index = tuple(jnp.asarray(ends[order, k].astype(np.int32)) for k in range(2))
    got = sweep(jnp.asarray(d), bundled(parts, index, jnp.asarray(pull[order])), move)
    expected = d.astype(np.float64)
    for e in order:
        a, b = ends[e]
        gap = expected[b] - expected[a]
        expected[a], expected[b] = expected[a] + pull[e] * gap, expected[b] - pull[e] * gap
    np.testing.assert_allclose(np.asarray(got), expected, atol=2e-6)


def test_empty_color_groups_change_nothing():
    order, parts = color_groups(np.zeros((0, 2), np.int64), 4)
    assert len(order) == 0 and parts == ()
    d = jnp.ones((4, 3, 1))
    assert (sweep(d, bundled(parts, (), ()), lambda rows, _: rows) == d).all()
