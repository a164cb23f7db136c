"""The paper's matrices and maps in one call."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import physxnet_jax as px
from physxnet_jax.body import NUM_BODY_VERTICES
from physxnet_jax.motion import body_animation
from physxnet_jax.uv import Transference, acceleration_maps, bind, velocity_maps


@pytest.fixture(scope="module")
def matrices():
    return px.transference("bottom", resolution=32)


@pytest.fixture(scope="module")
def vertices(body):
    return body_animation(body, px.load_motion("punch", fps=30))[:3]


def test_matrices_are_row_stochastic(matrices):
    for name in ("T_UB", "T_BC", "T_XB"):
        matrix = getattr(matrices, name)
        assert isinstance(matrix, Transference)
        sums = np.asarray(matrix.weights.sum(axis=1))
        np.testing.assert_allclose(sums[np.asarray(matrix.valid)], 1.0, atol=1e-5)
        assert int(matrix.vertices.max()) < matrix.shape[1]
    assert matrices.T_XB.shape == (matrices.garment.num_vertices, NUM_BODY_VERTICES)
    assert matrices.T_BC.shape == (matrices.T_UB.shape[0], matrices.garment.num_vertices)


def test_the_dense_matrix_gives_the_same_product(matrices, vertices):
    few = jax.tree.map(lambda x: x[:7], matrices.T_XB)
    assert few.todense().shape == (7, NUM_BODY_VERTICES)
    points = vertices[0, :NUM_BODY_VERTICES]
    dense = jnp.matmul(few.todense(), points, precision="highest")
    np.testing.assert_allclose(dense, few @ points, atol=1e-5)


def test_body_maps_are_differences_of_positions(matrices, vertices):
    maps = px.body_maps(matrices, vertices, fps=30.0)
    points = matrices.T_UB @ vertices[:, :NUM_BODY_VERTICES]
    from_map = matrices.atlas.from_map
    np.testing.assert_allclose(from_map(maps.position), points, atol=1e-6)
    np.testing.assert_allclose(from_map(maps.velocity), velocity_maps(points, 30.0), atol=1e-4)
    np.testing.assert_allclose(
        from_map(maps.acceleration), acceleration_maps(points, 30.0), atol=1e-3
    )
    assert float(jnp.abs(maps.position[:, ~np.asarray(matrices.atlas.mask)]).max()) == 0.0


def test_the_garment_map_is_zero_where_no_ray_hit(matrices, body, rest):
    cloth = matrices.garment.rest_vertices(rest)[None]
    offsets = px.garment_map(matrices, cloth, rest[None])
    at = matrices.atlas.from_map(offsets)[0]
    valid = np.asarray(matrices.T_BC.valid)
    assert 0.05 < valid.mean() < 0.95
    assert float(jnp.abs(at[~valid]).max()) == 0.0
    # Trousers lie within a few centimetres of the skin.
    length = np.linalg.norm(np.asarray(at)[valid], axis=1)
    assert 1e-3 < np.median(length) < 0.05


@pytest.mark.release
def test_a_binding_needs_no_mask(matrices, body, rest):
    again = bind(matrices.garment, atlas=matrices.atlas)
    np.testing.assert_array_equal(again.texel, matrices.binding.texel)
    everywhere = bind(
        matrices.garment, atlas=matrices.atlas, valid=jnp.ones(matrices.T_UB.shape[0], bool)
    )
    assert not np.array_equal(everywhere.texel, again.texel), "the mask decides where is sampled"
