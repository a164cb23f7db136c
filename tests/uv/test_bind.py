"""Binding: hit rates, sampling that stays on the body, known offsets recovered."""

import dataclasses

import jax.numpy as jnp
import numpy as np
import pytest

from physxnet_jax.garment import TEMPLATES, template
from physxnet_jax.uv import bind, dress_body, garment_map, garment_map_rows, make_atlas


@pytest.fixture(scope="module", params=TEMPLATES)
def bound(request, body, rest):
    atlas = make_atlas(64)
    g = template(request.param)
    rows = garment_map_rows(atlas, body, rest, g)
    return atlas, g, rows, bind(atlas, body, rest, g, rows.valid)


def test_most_vertices_are_hit_and_fallbacks_are_counted(bound):
    _, g, rows, binding = bound
    assert binding.hit_rate > 0.95
    assert binding.fallbacks == round((1 - binding.hit_rate) * g.num_vertices)
    assert 0.3 < float(jnp.mean(rows.valid)) < 0.95


def test_sampling_weights_sum_to_one_and_use_valid_texels_only(bound):
    _, _, rows, binding = bound
    weight = np.asarray(binding.weight)
    np.testing.assert_allclose(weight.sum(axis=1), 1.0, atol=1e-5)
    valid = np.asarray(rows.valid)[np.asarray(binding.texel)]
    assert (valid | (weight == 0)).all()


def test_nothing_bleeds_over_an_edge(bound, body):
    """A map that is 1 on the left half of the body stays 1 at every left vertex."""
    atlas, g, _, binding = bound
    side = (atlas.to_body @ body.rest_mesh().vertices)[:, :1]
    sampled = np.asarray(binding.sample(jnp.sign(side)))[:, 0]
    x = np.asarray(g.mesh.vertices)[:, 0]
    # A texel is 25 mm wide here; a skirt's texels lie on the legs, farther apart.
    clear = np.abs(x) > (0.05 if g.template != "dress" else 0.12)
    assert np.mean(np.sign(x[clear]) == np.sign(sampled[clear])) > 0.995


def test_a_map_of_the_garments_own_offsets_gives_the_garment_back(bound, body):
    """Round trip of the paper: texel -> cloth -> texel -> vertex, at rest."""
    atlas, g, rows, binding = bound
    vertices = body.rest_mesh().vertices
    if g.template == "dress":
        # Its map starts from the body with joined legs.
        joined = dress_body(body, np.asarray(body.rest_vertices(body.default_shape())))
        vertices = jnp.asarray(joined.astype(np.float32))
    offsets = garment_map(rows, g.mesh.vertices, atlas.to_body @ vertices)
    again = (binding.to_body @ vertices) + binding.sample(offsets)
    error = np.linalg.norm(np.asarray(again) - np.asarray(g.mesh.vertices), axis=1)
    assert np.median(error) < 0.005


def test_an_upside_down_garment_falls_back_but_stays_finite(body, rest):
    atlas = make_atlas(32)
    g = template("bottom")
    far = g.mesh.replace(vertices=g.mesh.vertices + jnp.array([[0.0, 0.0, 0.6]]))
    rows = garment_map_rows(atlas, body, rest, g)
    lost = bind(atlas, body, rest, dataclasses.replace(g, mesh=far), rows.valid)
    assert int(lost.fallbacks) > 0.5 * g.num_vertices
    assert np.isfinite(np.asarray(lost.weight)).all()
