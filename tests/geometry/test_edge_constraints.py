"""Lengths that cloth keeps: closed forms, folds, and that nothing can be thrown about."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings, strategies as st

from physxnet_jax.evaluation import fold_strength
from physxnet_jax.geometry import (
    _edge_constraints as module,
    limit_strain,
    make_edge_constraints,
    map_frames,
    matrix_from_quaternion,
    mesh_edges,
    quaternion_from_axis_angle,
)

TRIANGLE = np.array([[0, 1, 2]])
settled = jax.jit(limit_strain, static_argnames="steps")


def sheet(n=12, step=0.02):
    """A square of the templates' kind: four triangles a cell, round its middle."""
    x, z = np.meshgrid(np.arange(n) * step, np.arange(n) * step, indexing="ij")
    corners = np.stack([x.ravel(), np.zeros(n * n), z.ravel()], axis=1)
    at = np.arange(n * n).reshape(n, n)
    a, b, c, d = (q.ravel() for q in (at[:-1, :-1], at[1:, :-1], at[1:, 1:], at[:-1, 1:]))
    middles = (corners[a] + corners[c]) / 2
    m = n * n + np.arange(len(middles))
    faces = np.concatenate(
        [np.stack(f, axis=1) for f in ((a, b, m), (b, c, m), (c, d, m), (d, a, m))]
    )
    return np.concatenate([corners, middles]).astype(np.float32), faces.astype(np.int32)


def strain(vertices, faces, x):
    a, b = mesh_edges(faces).vertices.T
    length = np.linalg.norm(vertices[a] - vertices[b], axis=-1)
    return np.linalg.norm(x[..., a, :] - x[..., b, :], axis=-1) / length - 1.0


@pytest.fixture(scope="module")
def cloth():
    vertices, faces = sheet()
    return vertices, faces, make_edge_constraints(vertices, faces)


@pytest.mark.parametrize("size", [0.6, 1.0, 1.7])
def test_one_iteration_on_a_triangle_matches_the_closed_form(size):
    """Each corner is drawn by half the mean of two edges: three quarters of what is too much."""
    angles = 2.0 * np.pi * np.arange(3) / 3.0
    corners = np.stack([np.cos(angles), np.sin(angles), np.zeros(3)], axis=1).astype(np.float32)
    out = limit_strain(
        make_edge_constraints(corners, TRIANGLE), jnp.asarray(size * corners, jnp.float32), 1
    )
    np.testing.assert_allclose(np.asarray(out), (size - 0.75 * (size - 1.0)) * corners, atol=1e-6)


def test_cloth_at_rest_is_unchanged_and_zero_iterations_add_no_program(cloth):
    vertices, _, springs = cloth
    x = jnp.asarray(vertices)
    np.testing.assert_allclose(np.asarray(limit_strain(springs, x, 8)), vertices, atol=1e-6)
    assert limit_strain(springs, x, 0) is x
    assert not jax.make_jaxpr(lambda y: limit_strain(springs, y, 0))(x).eqns
    assert jax.make_jaxpr(lambda y: limit_strain(springs, y, 1))(x).eqns


@pytest.mark.parametrize("size", [1.3, 0.97])
def test_free_sheet_converges_to_its_rest_size(cloth, size):
    vertices, faces, springs = cloth
    errors = [
        np.abs(
            strain(vertices, faces, np.asarray(settled(springs, jnp.asarray(size * vertices), n)))
        ).max()
        for n in (8, 40, 400)
    ]
    assert errors[0] > errors[1] > errors[2] and errors[2] < 2e-3


def test_compressed_cloth_folds(cloth):
    """Flat cloth has no side to fold to; a thousandth of an edge decides which."""
    vertices, faces, springs = cloth
    noise = np.random.default_rng(0).normal(0.0, 2e-5, vertices.shape)
    pressed = (vertices * np.array([0.8, 1.0, 1.0]) + noise).astype(np.float32)
    held = np.asarray(limit_strain(springs, jnp.asarray(pressed), 30))
    shares = [np.abs(strain(vertices, faces, x)).mean() for x in (pressed, held)]
    assert shares[1] < 0.6 * shares[0]
    assert fold_strength(faces, held[None]) > 5.0 > fold_strength(faces, pressed[None])
    flat = (vertices * np.array([0.8, 1.0, 1.0])).astype(np.float32)
    assert np.abs(np.asarray(limit_strain(springs, jnp.asarray(flat), 30))[:, 1]).max() == 0.0


def test_strain_limiting_is_rigidly_equivariant_and_batches_match_a_loop(cloth):
    vertices, _, springs = cloth
    rng = np.random.default_rng(1)
    x = jnp.asarray((vertices + rng.normal(0, 3e-3, (3, *vertices.shape))).astype(np.float32))
    out = jnp.stack([limit_strain(springs, one, 8) for one in x])
    for batch in (
        jax.vmap(lambda y: limit_strain(springs, y, 8))(x),
        map_frames(lambda y: limit_strain(springs, y, 8), x),
    ):
        np.testing.assert_allclose(np.asarray(batch), np.asarray(out), atol=1e-6)
    turn = matrix_from_quaternion(quaternion_from_axis_angle(jnp.asarray([0.4, -1.1, 2.0])))
    shift = jnp.asarray([[3.0, -1.0, 2.0]])
    seen = limit_strain(springs, x[0] @ turn.T + shift, 8)
    np.testing.assert_allclose(np.asarray(seen), np.asarray(out[0] @ turn.T + shift), atol=5e-6)


@pytest.mark.release
def test_gradients_match_finite_differences(cloth):
    vertices, _, springs = cloth
    rng = np.random.default_rng(2)
    x = jnp.asarray((vertices + rng.normal(0, 3e-3, vertices.shape)).astype(np.float32))
    way = jnp.asarray(rng.normal(0, 1.0, vertices.shape).astype(np.float32))
    read = jnp.asarray(rng.normal(0, 1.0, vertices.shape).astype(np.float32))

    def objective(y):
        return jnp.sum(read * limit_strain(springs, y, 8))

    h = 1e-4
    difference = float(objective(x + h * way) - objective(x - h * way)) / (2 * h)
    assert float(jax.jvp(objective, (x,), (way,))[1]) == pytest.approx(difference, rel=2e-2)
    assert float(jnp.sum(jax.grad(objective)(x) * way)) == pytest.approx(difference, rel=2e-2)


def collapsed(v):
    return np.zeros_like(v)


def pinched(v):
    out = v.copy()
    out[:40] = out[0]
    return out


def torn(v):
    out = v.copy()
    out[::7] += 50.0
    return out


def far_away(v):
    return v + np.float32(1e4)


@pytest.mark.parametrize("case", [collapsed, pinched, torn, far_away])
def test_hard_cases_stay_finite_and_bounded(cloth, case):
    vertices, _, springs = cloth
    x = jnp.asarray(case(vertices).astype(np.float32))
    out, back = jax.vjp(lambda y: limit_strain(springs, y, 8), x)
    (slope,) = back(jnp.ones_like(out))
    assert np.isfinite(np.asarray(out)).all() and np.isfinite(np.asarray(slope)).all()
    # A corner that is drawn by all others alike is drawn less than they are apart.
    middle = np.asarray(x).mean(axis=0)
    reach = np.linalg.norm(np.asarray(x) - middle, axis=1).max() + 0.1
    assert np.linalg.norm(np.asarray(out) - middle, axis=1).max() < 1.1 * reach
    # Momentum makes of 1 + 2 * 0.625 a step at most this.
    assert float(jnp.abs(slope).max()) < 3.4**8


def thrown(springs, vertices, seed, size, move=settled):
    noise = np.random.default_rng(seed).normal(0.0, size, vertices.shape)
    x = jnp.asarray((vertices + noise).astype(np.float32))
    out = np.asarray(move(springs, x, 300))
    middle = np.asarray(x).mean(axis=0)
    return np.abs(out - middle).max(), np.abs(np.asarray(x) - middle).max()


@settings(max_examples=15, deadline=None)
@given(st.integers(0, 1000), st.sampled_from([1e-3, 0.02, 0.3, 10.0]))
def test_strain_limiting_does_not_oscillate(cloth, seed, size):
    vertices, _, springs = cloth
    after, before = thrown(springs, vertices, seed, size)
    assert after < before + 0.1


def test_strain_limiting_oscillates_with_more_momentum(cloth, monkeypatch):
    """The bound above can fail: what it guards is the choice of weights and momentum."""
    vertices, _, springs = cloth
    monkeypatch.setattr(module, "_MOMENTUM", 1.1)
    # Traced anew, with the momentum of the moment.
    after, before = thrown(springs, vertices, 0, 0.3, lambda *args: limit_strain(*args))
    assert not after < before + 0.1


def test_vertex_fans_isolated_vertices_and_zero_length_edges_are_handled():
    """A corner of 200 edges takes 40 of them; what has no edge stays where it is."""
    around = np.linspace(0.0, 6.0, 200)
    rim = np.stack([np.cos(around), np.sin(around), np.zeros(200)], axis=1)
    vertices = np.concatenate([[[0.0, 0.0, 0.0]], rim, [[5.0, 0.0, 0.0]]])
    faces = np.stack([np.zeros(199, int), np.arange(1, 200), np.arange(2, 201)], axis=1)
    faces = np.concatenate([faces, [[1, 1, 2]]])
    springs = make_edge_constraints(vertices, faces)
    assert max(i.shape[0] for i in springs.index) == 40
    total = np.concatenate([np.asarray(w.sum(axis=0)) for w in springs.weight])[springs.back]
    assert total[0] == pytest.approx(0.5, abs=1e-5) and total[-1] == 0.0
    assert total.max() < 0.63
    x = jnp.asarray(1.2 * vertices, jnp.float32)
    out = np.asarray(limit_strain(springs, x, 30))
    np.testing.assert_array_equal(out[-1], np.asarray(x[-1]))
    radius = np.linalg.norm(out[1:-1] - out[0], axis=1)
    assert np.isfinite(out).all() and abs(radius.mean() - 1.0) < 0.1


def test_degenerate_triangles_change_nothing(cloth):
    vertices, faces, springs = cloth
    none = [[faces[0, 0], faces[0, 0], faces[0, 1]], [7, 7, 7]]
    again = make_edge_constraints(vertices, np.concatenate([faces, none]))
    for one, other in zip(jax.tree.leaves(springs), jax.tree.leaves(again), strict=True):
        np.testing.assert_array_equal(one, other)
    alone = make_edge_constraints(vertices, np.asarray(none[1:]))
    x = jnp.asarray(vertices)
    np.testing.assert_array_equal(limit_strain(alone, x, 3), x)
    double = make_edge_constraints(vertices[:3], np.array([[0, 1, 2], [0, 1, 2]]))
    assert np.isfinite(np.asarray(limit_strain(double, 1.1 * x[:3], 3))).all()


@pytest.mark.release
def test_at_rest_takes_rest_lengths_from_another_shape(cloth):
    vertices, _, springs = cloth
    wider = jnp.asarray(1.5 * vertices)
    np.testing.assert_allclose(
        np.asarray(jax.jit(lambda x: limit_strain(springs.at_rest(x), x, 8))(wider)),
        wider,
        atol=1e-6,
    )
    objective = jax.jit(lambda s: limit_strain(springs.at_rest(s * wider), wider, 4).sum())
    slope = jax.grad(objective)(jnp.ones(()))
    assert np.isfinite(float(slope))


def test_lengths_are_restored_far_from_the_origin(cloth):
    """A kilometre away neighbours differ by what float32 leaves of them, no more."""
    vertices, _, springs = cloth
    rng = np.random.default_rng(0)
    x = jnp.asarray(vertices + 0.004 * rng.normal(size=vertices.shape).astype(np.float32))
    away = jnp.float32([[1000.0, 0.0, 500.0]])
    far = x + away
    near = settled(springs, far - away, steps=8)
    np.testing.assert_allclose(settled(springs, far, steps=8) - away, near, atol=1e-4)


@pytest.mark.release
def test_second_derivatives_are_finite(cloth):
    """Newton's methods and penalties on gradients ask for them."""
    vertices, _, springs = cloth
    x = jnp.asarray(vertices * np.float32([1.05, 1.0, 0.95]))
    way = jax.random.normal(jax.random.key(0), x.shape)

    def total(y):
        return jnp.sum(limit_strain(springs, y, 3) ** 2)

    _, second = jax.jit(lambda y: jax.jvp(jax.grad(total), (y,), (way,)))(x)
    assert bool(jnp.isfinite(second).all()) and float(jnp.abs(second).max()) > 0.1
