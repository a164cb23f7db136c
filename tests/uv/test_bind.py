"""Binding: hit rates, sampling that stays on the body, known offsets recovered."""

import dataclasses

import jax.numpy as jnp
import numpy as np
import pytest

from physxnet_jax.garment import TEMPLATES, template
from physxnet_jax.geometry import closest_points
from physxnet_jax.uv import bind, cloth_offsets, dress_body, garment_map_rows, make_atlas
from physxnet_jax.uv._bind import chart_mesh


@pytest.fixture(scope="module", params=TEMPLATES)
def bound(request, body, rest):
    atlas = make_atlas(64)
    g = template(request.param)
    rows = garment_map_rows(atlas, body, rest, g)
    return atlas, g, rows, bind(g, atlas=atlas, body=body, rest=rest, valid=rows.valid)


@pytest.mark.release
def test_most_rays_hit_and_fallbacks_are_counted(bound):
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


def test_sampling_does_not_bleed_across_chart_borders(bound, body):
    """A map that is 1 on the left half of the body stays 1 at every left vertex."""
    atlas, g, _, binding = bound
    side = (atlas.to_body @ body.rest_mesh().vertices)[:, :1]
    sampled = np.asarray(binding.sample(jnp.sign(side)))[:, 0]
    x = np.asarray(g.mesh.vertices)[:, 0]
    # A texel is 25 mm wide here; a skirt's texels lie on the legs, farther apart.
    clear = np.abs(x) > (0.05 if g.template != "dress" else 0.12)
    assert np.mean(np.sign(x[clear]) == np.sign(sampled[clear])) > 0.995


def test_offset_map_of_a_garment_reproduces_the_garment(bound, body):
    """Round trip of the paper: texel -> cloth -> texel -> vertex, at rest."""
    atlas, g, rows, binding = bound
    vertices = body.rest_mesh().vertices
    if g.template == "dress":
        # Its map starts from the body with joined legs.
        joined = dress_body(body, np.asarray(body.rest_vertices(body.default_shape())))
        vertices = jnp.asarray(joined.astype(np.float32))
    offsets = cloth_offsets(rows, g.mesh.vertices, atlas.to_body @ vertices)
    again = (binding.to_body @ vertices) + binding.sample(offsets)
    error = np.linalg.norm(np.asarray(again) - np.asarray(g.mesh.vertices), axis=1)
    assert np.median(error) < 0.005


@pytest.mark.release
def test_smaller_garment_reuses_programs_and_binds_alike(bound, body, rest):
    atlas, g, rows, binding = bound
    before = closest_points._cache_size()
    # A face's last vertex goes; the others stay where they are.
    faces = np.asarray(g.mesh.faces)
    kept = faces[(faces < g.num_vertices - 1).all(axis=1)]
    mesh = g.mesh.replace(vertices=g.mesh.vertices[:-1], faces=jnp.asarray(kept))
    less = bind(
        dataclasses.replace(g, mesh=mesh), atlas=atlas, body=body, rest=rest, valid=rows.valid
    )
    assert closest_points._cache_size() == before
    assert len(less.texel) == g.num_vertices - 1
    # Normals, and so rays, differ beside what is gone alone.
    same = (np.asarray(less.texel) == np.asarray(binding.texel)[:-1]).all(axis=1)
    assert same.mean() > 0.99


def test_displaced_garment_falls_back_and_stays_finite(body, rest):
    atlas = make_atlas(32)
    g = template("bottom")
    far = g.mesh.replace(vertices=g.mesh.vertices + jnp.array([[0.0, 0.0, 0.6]]))
    rows = garment_map_rows(atlas, body, rest, g)
    lost = bind(
        dataclasses.replace(g, mesh=far), atlas=atlas, body=body, rest=rest, valid=rows.valid
    )
    assert int(lost.fallbacks) > 0.5 * g.num_vertices
    assert np.isfinite(np.asarray(lost.weight)).all()


def test_position_map_is_sampled_without_offset(bound, body, rest):
    """The place of every texel, read at the vertices: no half texel (12 mm here) beside."""
    atlas, g, _, _ = bound
    whole = bind(g, atlas=atlas, body=body, rest=rest, valid=jnp.ones(atlas.num_texels, bool))
    skin = body.rest_mesh().vertices
    gap = np.asarray(whole.sample(atlas.to_body @ skin) - whole.to_body @ skin)
    assert np.median(np.linalg.norm(gap, axis=1)) < 2e-3
    assert np.abs(gap.mean(axis=0)).max() < 1e-3


def test_ray_hits_far_beyond_the_nearest_skin_are_rejected(bound, body, rest):
    atlas, g, _, binding = bound
    mesh = chart_mesh(atlas, body, rest, g.template)
    x = g.mesh.vertices
    near = np.sqrt(np.asarray(closest_points(mesh, x).squared_distance))
    bound_at = np.linalg.norm(np.asarray(binding.to_body @ mesh.vertices - x), axis=1)
    assert (bound_at <= 2.0 * near + 0.0101).all()


def test_texels_without_a_ray_hit_are_zero(bound, body):
    atlas, g, rows, _ = bound
    points = atlas.to_body @ body.rest_mesh().vertices
    offsets = np.asarray(cloth_offsets(rows, g.mesh.vertices, points))
    valid = np.asarray(rows.valid)
    assert not offsets[~valid].any() and (np.abs(offsets[valid]).max(axis=1) > 0).all()


def test_cloth_far_from_the_legs_is_on_the_map(bound, body, rest):
    """A hem stands a hand's breadth off the hull of both legs."""
    atlas, g, rows, _ = bound
    points = atlas.to_body @ chart_mesh(atlas, body, rest, g.template).vertices
    away = np.linalg.norm(np.asarray(rows @ g.mesh.vertices - points), axis=1)
    far = away[np.asarray(rows.valid)]
    assert (far.max() > 0.1) == (g.template == "dress") and far.max() < 0.31
