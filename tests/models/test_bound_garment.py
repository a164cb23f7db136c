"""Dressing through maps with a chart for skirts."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from flax import nnx

from physxnet_jax.garment import skin_garment, tailor
from physxnet_jax.models import (
    PAPER,
    ModelConfig,
    Normalisation,
    Predictor,
    bind_garment,
    dress_frames,
    make_generator,
    make_texel_points,
    pad_clip,
    with_mirror_tta,
)
from physxnet_jax.motion import clip_transforms, load_motion
from physxnet_jax.uv import bind, make_atlas


@pytest.fixture(scope="module")
def dressed(body):
    """An untrained network, a dress bound to its maps, and three frames of a walk."""
    config = ModelConfig(resolution=32, width=4, templates=("dress",), skirt_chart=True)
    rest = body.rest_vertices(body.default_shape())
    atlas = make_atlas(32, skirt=True)
    every = jnp.ones(atlas.num_texels, bool)
    points = make_texel_points(atlas, body, rest, {"dress": every})
    one = jnp.float32(1.0)
    graph, state = nnx.split(make_generator(config))
    scales = Normalisation(one, one, {"dress": jnp.float32(0.02)})
    predictor = Predictor(atlas, points, scales, state, graph, config)
    garment = tailor("aline")
    worn = bind_garment(body, rest, garment, bind(garment, atlas=atlas, valid=every), smooth=False)
    clip = clip_transforms(body, rest, load_motion("walk", fps=30.0))
    world, shift = (pad_clip(jnp.asarray(x[:3]), config.inputs) for x in clip)
    return predictor, worn, world, shift


def test_the_paper_has_no_chart_for_skirts():
    with pytest.raises(ValueError, match="skirt_chart"):
        ModelConfig(inputs=PAPER, skirt_chart=True)


@pytest.mark.nightly
def test_gradients_by_the_network_are_finite_and_zero_is_the_skinning(dressed):
    predictor, worn, world, shift = dressed

    def mean(state):
        changed = dataclasses.replace(predictor, state=state)
        (cloth,) = dress_frames(changed, [worn], world, shift, 30.0)
        return jnp.mean(cloth[:, :, 1]), cloth

    (_, cloth), slope = jax.value_and_grad(mean, has_aux=True)(predictor.state)
    assert bool(jnp.isfinite(cloth).all())
    assert all(bool(jnp.isfinite(g).all()) for g in jax.tree.leaves(slope))
    skinned = jax.vmap(lambda r, t: skin_garment(worn, r, t))(world[-3:], shift[-3:])
    assert float(jnp.abs(cloth - skinned).max()) > 1e-4, "the network counts"
    _, still = mean(jax.tree.map(jnp.zeros_like, predictor.state))
    np.testing.assert_allclose(still, skinned, atol=1e-6)


@pytest.mark.release
def test_test_time_augmentation_holds_for_the_chart_of_skirts(dressed):
    predictor, worn, world, shift = dressed
    both = with_mirror_tta(predictor)
    (plain,) = dress_frames(predictor, [worn], world, shift, 30.0)
    (twice,) = dress_frames(both, [worn], world, shift, 30.0)
    gap = np.abs(np.asarray(plain) - np.asarray(twice)).max(axis=(0, 2))
    assert gap[np.asarray(worn.rest)[:, 1] < 0.0].max() > 1e-5
