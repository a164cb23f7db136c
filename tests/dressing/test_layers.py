"""A garment over another: outside it, in the order that is stated, and smoothly."""

import dataclasses

import fast_simplification
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from physxnet_jax.body import load_body
from physxnet_jax.dressing import clothe, clothe_frame, make_dresser, start_clothing
from physxnet_jax.dressing._dress import unbound_wearable
from physxnet_jax.dressing._layers import Layer, inside_out, keep_apart, layer_height, make_layers
from physxnet_jax.garment import grid_faces, template
from physxnet_jax.geometry import closest_points, make_mesh, vertex_normals
from physxnet_jax.motion import load_motion

N = 9


def sheets(height, tilt=0.0):
    """Two squares of 40 cm, 5 cm meshes, the upper one ``height`` above the lower."""
    x, z = np.meshgrid(np.linspace(0, 0.4, N), np.linspace(0, 0.4, N), indexing="ij")
    low = np.stack([x, tilt * x, z], axis=-1).reshape(-1, 3).astype(np.float32)
    faces = np.asarray(grid_faces(N, N))
    up = np.cross(low[faces[0, 1]] - low[faces[0, 0]], low[faces[0, 2]] - low[faces[0, 0]])
    faces = faces if up[1] > 0 else faces[:, ::-1]
    rows = np.arange(N * N)
    layer = Layer(
        jnp.asarray(rows.astype(np.int32)),
        jnp.asarray(np.ascontiguousarray(faces).astype(np.int32)),
        jnp.asarray(np.tile(np.arange(len(faces)), (N * N, 1)).astype(np.int32)),
        jnp.full((N * N,), 0.005, jnp.float32),
        None,
        0,
        1,
    )
    return layer, jnp.asarray(low), jnp.asarray(low + np.float32([0.0, height, 0.0]))


@pytest.mark.parametrize("height", [-0.02, 0.0, 0.003, 0.02])
def test_a_flat_sheet_is_lifted_to_its_least_height(height):
    layer, low, high = sheets(height)
    # Without a neighbourhood the lift is taken whole at once.
    seen = keep_apart(layer, low, high)
    np.testing.assert_allclose(seen[:, 1], max(height, 0.005), atol=1e-6)
    np.testing.assert_allclose(seen[:, ::2], high[:, ::2], atol=1e-6)


def test_what_comes_through_a_triangle_is_pressed_under_it():
    """Between its corners, which all keep their height above the nearest vertex beneath."""
    body = load_body()
    rest = body.rest_vertices(body.default_shape())
    g = template("top")
    over = dataclasses.replace(g, name="over")
    wearables = [unbound_wearable(body, rest, x) for x in (g, over)]
    lift, press = make_layers(body, rest, wearables, [g, over])
    assert (lift.still, lift.moved, press.still, press.moved) == (0, 1, 1, 0)
    outer = g.mesh.vertices
    inner = outer + 0.004 * vertex_normals(outer, g.mesh.faces)
    wrong = layer_height(press, outer, inner)[0]
    assert float(jnp.quantile(wrong, 0.9)) < -0.003
    seen = keep_apart(press, outer, inner)
    assert float(jnp.quantile(layer_height(press, outer, seen)[0], 0.02)) > 0.0017
    # What is under already isn't touched.
    under = outer - 0.02 * vertex_normals(outer, g.mesh.faces)
    np.testing.assert_allclose(keep_apart(press, outer, under), under, atol=1e-7)


def test_what_lies_beside_or_far_behind_is_left_alone():
    layer, low, high = sheets(0.0)
    beside = high + jnp.array([[0.5, 0.0, 0.0]])
    np.testing.assert_array_equal(keep_apart(layer, low, beside)[N:], beside[N:])
    behind = high - jnp.array([[0.0, 0.07, 0.0]])
    np.testing.assert_array_equal(keep_apart(layer, low, behind), behind)


def test_turning_and_moving_both_changes_nothing():
    layer, low, high = sheets(-0.004, tilt=0.3)
    turn = jnp.asarray(np.linalg.qr(np.random.default_rng(0).normal(size=(3, 3)))[0], jnp.float32)
    turn = turn * jnp.sign(jnp.linalg.det(turn))
    want = keep_apart(layer, low, high) @ turn.T + 2.0
    seen = keep_apart(layer, low @ turn.T + 2.0, high @ turn.T + 2.0)
    np.testing.assert_allclose(seen, want, atol=2e-6)


@pytest.mark.parametrize("height", [-0.004, 0.0, 0.005])
def test_gradients_are_finite_where_heights_meet(height):
    """Exactly on the other garment, and exactly at the least height."""
    layer, low, high = sheets(height)
    grads = jax.grad(lambda a, b: jnp.sum(keep_apart(layer, a, b) ** 2), argnums=(0, 1))(low, high)
    assert all(bool(jnp.isfinite(g).all()) for g in grads)


def test_the_order_is_trousers_dresses_tops_and_else_as_named():
    body = load_body()
    rest = body.rest_vertices(body.default_shape())
    worn = [template(t) for t in ("top", "bottom", "top")]
    worn[2] = dataclasses.replace(worn[2], name="jacket")
    assert [g.name for g in inside_out(worn)] == ["bottom", "top", "jacket"]
    wearables = [unbound_wearable(body, rest, g) for g in worn]
    layers = make_layers(body, rest, wearables, worn)
    # Trousers are pressed beneath tops and need no layer.
    assert [(x.still, x.moved) for x in layers] == [(0, 2), (2, 0)]
    # A file whose faces are inside out is beneath from the same side.
    turned = worn[0].mesh.replace(faces=worn[0].mesh.faces[:, ::-1])
    other = [dataclasses.replace(worn[0], mesh=turned), *worn[1:]]
    again = make_layers(body, rest, wearables, other)
    np.testing.assert_array_equal(again[0].faces, layers[0].faces)
    turned = dataclasses.replace(worn[2], mesh=turned)
    again = make_layers(body, rest, wearables, [*worn[:2], turned])
    np.testing.assert_array_equal(again[1].faces, layers[1].faces)


def test_a_top_is_kept_off_trousers_that_lie_over_others():
    """The second trousers aren't tucked in: they are lifted off the first."""
    body = load_body()
    rest = body.rest_vertices(body.default_shape())
    worn = [template(t) for t in ("bottom", "bottom", "top")]
    wearables = [unbound_wearable(body, rest, g) for g in worn]
    layers = make_layers(body, rest, wearables, worn)
    assert [(x.still, x.moved) for x in layers] == [(0, 1), (1, 0), (1, 2), (2, 1)]


def test_coarse_triangles_are_as_near_as_fine_ones():
    """A dress of few triangles beneath a top: what is near its surface is in the layer."""
    body = load_body()
    rest = body.rest_vertices(body.default_shape())
    top, dress = template("top"), template("dress")
    fine = [unbound_wearable(body, rest, g) for g in (dress, top)]
    known = make_layers(body, rest, fine, [dress, top])[0]
    points, faces = fast_simplification.simplify(
        np.array(dress.mesh.vertices), np.array(dress.mesh.faces), target_count=150
    )
    mesh = make_mesh(np.float32(points), faces.astype(np.int32))
    coarse = dataclasses.replace(dress, mesh=mesh)
    worn = dataclasses.replace(fine[0], rest=mesh.vertices)
    layer = make_layers(body, rest, [worn, fine[1]], [coarse, top])[0]
    away = np.sqrt(closest_points(mesh, fine[1].rest).squared_distance)
    missed = np.setdiff1d(np.flatnonzero(away < 0.045), layer.rows)
    assert len(known.rows) > 1000 and len(missed) < 0.002 * len(layer.rows)


@pytest.mark.slow
def test_of_two_alike_the_second_stays_over_the_first_live_and_in_clips():
    """Two of the same trousers: by the network alone each vertex lies on its own twin."""
    motion = load_motion("punch", fps=30.0)
    q, p = motion.rotations[30:33], motion.root[30:33]
    over = dataclasses.replace(template("bottom"), name="over")
    dresser = make_dresser(["bottom", over], weights="nano")
    whole = jax.jit(clothe, static_argnames="fps")(dresser, q, p, fps=30.0)
    over_it, under_it = dresser.layers
    for inner, outer in zip(whole["bottom"], whole["over"]):
        assert np.abs(layer_height(over_it, inner, inner)[0]).max() < 1e-5
        for layer, still, moved in ((over_it, inner, outer), (under_it, outer, inner)):
            height, beside, _ = layer_height(layer, still, moved)
            on = np.asarray(beside) < 0.005
            assert on.mean() > 0.9 and np.quantile(height[on], 0.01) > 0.0
    stream = start_clothing(dresser, q, p)
    step = jax.jit(clothe_frame, static_argnames="fps")
    for k in range(3):
        stream, now = step(dresser, stream, q[k], p[k], fps=30.0)
        away = np.abs(np.asarray(now["over"] - whole["over"][k]))
        assert np.quantile(away, 0.999) < 2e-4
