"""A garment over another: outside it, in the order that is stated, and smoothly."""

import dataclasses

import fast_simplification
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from physxnet_jax.body import load_body
from physxnet_jax.dressing import Inference, clothe, clothe_step, init_stream, make_dresser
from physxnet_jax.dressing.postprocess import Outfit, prepare_layers
from physxnet_jax.dressing.postprocess._layers import (
    Layer,
    layer_height,
    layer_order,
    resolve_layer,
)
from physxnet_jax.garment import grid_faces, make_skinned, template
from physxnet_jax.geometry import closest_points, make_mesh, vertex_normals
from physxnet_jax.motion import load_motion

N = 9


def layers_of(body, rest, worn, garments):
    return prepare_layers(Outfit(body, rest, tuple(worn), tuple(garments)), Inference())


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


@pytest.mark.release
@pytest.mark.parametrize("height", [-0.02, 0.0, 0.003, 0.02])
def test_flat_sheet_is_lifted_to_the_minimum_clearance(height):
    layer, low, high = sheets(height)
    # Without a neighbourhood the lift is taken whole at once.
    seen = resolve_layer(layer, low, high)
    np.testing.assert_allclose(seen[:, 1], max(height, 0.005), atol=1e-6)
    np.testing.assert_allclose(seen[:, ::2], high[:, ::2], atol=1e-6)


@pytest.mark.release
def test_inner_vertices_are_pressed_below_outer_triangles():
    """Between its corners, which all keep their height above the nearest vertex beneath."""
    body = load_body()
    rest = body.rest_vertices(body.default_shape())
    g = template("top")
    over = dataclasses.replace(g, name="over")
    worn_garments = [make_skinned(x, rest) for x in (g, over)]
    lift, press = layers_of(body, rest, worn_garments, [g, over])
    assert (lift.still, lift.moved, press.still, press.moved) == (0, 1, 1, 0)
    outer = g.mesh.vertices
    inner = outer + 0.004 * vertex_normals(outer, g.mesh.faces)
    wrong = layer_height(press, outer, inner)[0]
    assert float(jnp.quantile(wrong, 0.9)) < -0.003
    seen = resolve_layer(press, outer, inner)
    assert float(jnp.quantile(layer_height(press, outer, seen)[0], 0.02)) > 0.0017
    # What is under already isn't touched.
    under = outer - 0.02 * vertex_normals(outer, g.mesh.faces)
    np.testing.assert_allclose(resolve_layer(press, outer, under), under, atol=1e-7)


@pytest.mark.release
def test_vertices_beside_or_far_behind_are_unchanged():
    layer, low, high = sheets(0.0)
    beside = high + jnp.array([[0.5, 0.0, 0.0]])
    np.testing.assert_array_equal(resolve_layer(layer, low, beside)[N:], beside[N:])
    behind = high - jnp.array([[0.0, 0.07, 0.0]])
    np.testing.assert_array_equal(resolve_layer(layer, low, behind), behind)


def test_layers_are_equivariant_to_rigid_motion():
    layer, low, high = sheets(-0.004, tilt=0.3)
    turn = jnp.asarray(np.linalg.qr(np.random.default_rng(0).normal(size=(3, 3)))[0], jnp.float32)
    turn = turn * jnp.sign(jnp.linalg.det(turn))
    want = resolve_layer(layer, low, high) @ turn.T + 2.0
    seen = resolve_layer(layer, low @ turn.T + 2.0, high @ turn.T + 2.0)
    np.testing.assert_allclose(seen, want, atol=2e-6)


@pytest.mark.release
@pytest.mark.parametrize("height", [-0.004, 0.0, 0.005])
def test_gradients_are_finite_at_zero_and_minimum_height(height):
    """Exactly on the other garment, and exactly at the least height."""
    layer, low, high = sheets(height)
    grads = jax.grad(lambda a, b: jnp.sum(resolve_layer(layer, a, b) ** 2), argnums=(0, 1))(
        low, high
    )
    assert all(bool(jnp.isfinite(g).all()) for g in grads)


@pytest.mark.release
def test_layer_order_is_trousers_dresses_tops_then_as_named():
    body = load_body()
    rest = body.rest_vertices(body.default_shape())
    worn = [template(t) for t in ("top", "bottom", "top")]
    worn[2] = dataclasses.replace(worn[2], name="jacket")
    assert [g.name for g in layer_order(worn)] == ["bottom", "top", "jacket"]
    worn_garments = [make_skinned(g, rest) for g in worn]
    layers = layers_of(body, rest, worn_garments, worn)
    # Trousers are pressed beneath tops and need no layer.
    assert [(x.still, x.moved) for x in layers] == [(0, 2), (2, 0)]
    # A file whose faces are inside out is beneath from the same side.
    turned = worn[0].mesh.replace(faces=worn[0].mesh.faces[:, ::-1])
    other = [dataclasses.replace(worn[0], mesh=turned), *worn[1:]]
    again = layers_of(body, rest, worn_garments, other)
    np.testing.assert_array_equal(again[0].faces, layers[0].faces)
    turned = dataclasses.replace(worn[2], mesh=turned)
    again = layers_of(body, rest, worn_garments, [*worn[:2], turned])
    np.testing.assert_array_equal(again[1].faces, layers[1].faces)


@pytest.mark.release
def test_top_is_layered_over_the_outer_of_two_trousers():
    """The second trousers aren't tucked in: they are lifted off the first."""
    body = load_body()
    rest = body.rest_vertices(body.default_shape())
    worn = [template(t) for t in ("bottom", "bottom", "top")]
    worn_garments = [make_skinned(g, rest) for g in worn]
    layers = layers_of(body, rest, worn_garments, worn)
    assert [(x.still, x.moved) for x in layers] == [(0, 1), (1, 0), (1, 2), (2, 1)]


@pytest.mark.release
def test_coarse_triangles_are_included_in_layers():
    """A dress of few triangles beneath a top: what is near its surface is in the layer."""
    body = load_body()
    rest = body.rest_vertices(body.default_shape())
    top, dress = template("top"), template("dress")
    fine = [make_skinned(g, rest) for g in (dress, top)]
    known = layers_of(body, rest, fine, [dress, top])[0]
    points, faces = fast_simplification.simplify(
        np.array(dress.mesh.vertices), np.array(dress.mesh.faces), target_count=150
    )
    mesh = make_mesh(np.float32(points), faces.astype(np.int32))
    coarse = dataclasses.replace(dress, mesh=mesh)
    worn = dataclasses.replace(fine[0], rest=mesh.vertices)
    layer = layers_of(body, rest, [worn, fine[1]], [coarse, top])[0]
    away = np.sqrt(closest_points(mesh, fine[1].rest).squared_distance)
    missed = np.setdiff1d(np.flatnonzero(away < 0.045), layer.rows)
    assert len(known.rows) > 1000 and len(missed) < 0.002 * len(layer.rows)


@pytest.mark.nightly
def test_second_of_two_equal_garments_stays_outer_in_stream_and_clip():
    """Two of the same trousers: by the network alone each vertex lies on its own twin."""
    motion = load_motion("punch", fps=30.0)
    q, p = motion.rotations[30:33], motion.root[30:33]
    over = dataclasses.replace(template("bottom"), name="over")
    dresser = make_dresser(
        ["bottom", over], inference=Inference(weights="nano", strain_iterations=0)
    )
    whole = jax.jit(clothe, static_argnames="fps")(dresser, q, p, fps=30.0)
    over_it, under_it = dresser.layers
    for inner, outer in zip(whole["bottom"], whole["over"]):
        # Three triangles are compared exactly; a long one's middle may not be among the nearest.
        own = np.abs(layer_height(over_it, inner, inner)[0])
        assert np.quantile(own, 0.99) < 1e-5 and own.max() < 5e-3
        for layer, still, moved in ((over_it, inner, outer), (under_it, outer, inner)):
            height, beside, _ = layer_height(layer, still, moved)
            on = np.asarray(beside) < 0.005
            assert on.mean() > 0.9 and np.quantile(height[on], 0.01) > 0.0
    stream = init_stream(dresser, q, p)
    step = jax.jit(clothe_step, static_argnames="fps")
    for k in range(3):
        stream, now = step(dresser, stream, q[k], p[k], fps=30.0)
        away = np.abs(np.asarray(now["over"] - whole["over"][k]))
        assert np.quantile(away, 0.999) < 2e-4
