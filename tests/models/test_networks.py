"""Networks: the fast transposed convolution, shapes, features and their invariances."""

import dataclasses
import subprocess
import sys

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from flax import nnx
from scipy.spatial.transform import Rotation

from physxnet_jax.data import pose_windows
from physxnet_jax.garment import skin_garment, template
from physxnet_jax.models import (
    PAPER,
    Discriminator,
    FeatureConfig,
    Generator,
    ModelConfig,
    Normalisation,
    Predictor,
    apply_offsets,
    at_precision,
    bind_garment,
    clip_features,
    dress_frames,
    fold_batch_norm,
    make_generator,
    make_texel_points,
    normalise,
    pad_clip,
    upsample,
    upsampling_kernel,
    with_mirror_tta,
)
from physxnet_jax.motion import clip_transforms, load_motion
from physxnet_jax.uv import bind, cloth_offsets, dress_body, garment_map_rows, make_atlas

NHWC = ("NHWC", "HWIO", "NHWC")


@pytest.mark.release
def test_upsampling_equals_a_transposed_convolution_with_its_gradients():
    k = jax.random.normal(jax.random.key(0), (4, 4, 5, 7))
    x = jax.random.normal(jax.random.key(1), (2, 6, 8, 5))

    def fast(k, x):
        return upsample(x, upsampling_kernel(k))

    def textbook(k, x):
        # Stride 2, padding 1: each input pixel stamps the kernel; as a dilated convolution.
        return jax.lax.conv_general_dilated(
            x, k[::-1, ::-1], (1, 1), ((2, 2), (2, 2)), lhs_dilation=(2, 2), dimension_numbers=NHWC
        )

    np.testing.assert_allclose(np.asarray(fast(k, x)), np.asarray(textbook(k, x)), atol=2e-4)
    stamp = np.zeros((1, 6, 8, 5), np.float32)
    stamp[0, 2, 3, 1] = 1.0
    out = np.asarray(fast(k, jnp.asarray(stamp)))
    np.testing.assert_allclose(out[0, 3:7, 5:9], np.asarray(k[:, :, 1]), atol=1e-6)
    target = jax.random.normal(jax.random.key(2), (2, 12, 16, 7))
    grads = [
        jax.grad(lambda k, x, f=f: jnp.sum(f(k, x) * target), argnums=(0, 1))(k, x)
        for f in (fast, textbook)
    ]
    for a, b in zip(*grads):
        np.testing.assert_allclose(np.asarray(a), np.asarray(b), atol=2e-3)
    # Forward mode, in one argument alone and in both, and the second derivative between them.
    dk, dx = jnp.sin(k), jnp.cos(x)
    for change in ((dk, jnp.zeros_like(x)), (jnp.zeros_like(k), dx), (dk, dx)):
        a, b = (jax.jvp(f, (k, x), change)[1] for f in (fast, textbook))
        np.testing.assert_allclose(np.asarray(a), np.asarray(b), atol=2e-3)
    a, b = (jax.jvp(lambda x, f=f: f(k, x), (x,), (dx,))[1] for f in (fast, textbook))
    np.testing.assert_allclose(np.asarray(a), np.asarray(b), atol=2e-3)
    mixed = [
        jax.grad(lambda k, f=f: jnp.sum(jax.jvp(lambda x: f(k, x), (x,), (dx,))[1] * target))(k)
        for f in (fast, textbook)
    ]
    np.testing.assert_allclose(*map(np.asarray, mixed), atol=2e-3)


@pytest.mark.release
@pytest.mark.parametrize("size", [(32, 32), (16, 48)])
def test_generator_computes_only_the_requested_decoders(size):
    g = Generator(21, ("top", "bottom", "dress"), width=4, rngs=nnx.Rngs(0))
    g.eval()
    x = jnp.ones((2, *size, 21))
    every = g(x, ("top", "bottom", "dress"))
    one = g(x, ("dress",))
    assert set(every) == {"top", "bottom", "dress"} and set(one) == {"dress"}
    assert one["dress"].shape == (2, *size, 3)
    np.testing.assert_array_equal(np.asarray(one["dress"]), np.asarray(every["dress"]))
    graph, state = nnx.split(g)

    def flops(names):
        run = jax.jit(lambda s, x: nnx.merge(graph, s)(x, names))
        return run.lower(state, x).compile().cost_analysis()["flops"]

    assert flops(("dress",)) < 0.6 * flops(("top", "bottom", "dress"))


@pytest.mark.release
def test_map_sizes_not_divisible_by_16_are_refused():
    g = Generator(18, ("top",), width=2, rngs=nnx.Rngs(0))
    with pytest.raises(ValueError, match="multiples of 16"):
        g(jnp.zeros((1, 40, 32, 18)), ("top",))


@pytest.mark.release
def test_discriminator_output_is_a_patch_map():
    d = Discriminator(27, width=4, rngs=nnx.Rngs(0))
    out = d(jnp.zeros((2, 64, 64, 18)), jnp.zeros((2, 64, 64, 9)))
    assert out.shape == (2, 8, 8, 1)


@pytest.fixture(scope="module")
def worn(body, rest):
    from physxnet_jax.garment import template

    atlas = make_atlas(32)
    garments = [template(t) for t in ("top", "dress")]
    rows = [garment_map_rows(atlas, body, rest, g) for g in garments]
    valid = {g.template: r.valid for g, r in zip(garments, rows)}
    surface = make_texel_points(atlas, body, rest, valid)
    bound_garments = [
        bind_garment(body, rest, g, bind(g, atlas=atlas, body=body, rest=rest, valid=r.valid))
        for g, r in zip(garments, rows)
    ]
    return atlas, surface, bound_garments


LOCAL = FeatureConfig()
PAPER_FAR = FeatureConfig("paper", frames=3, stride=3)
PAPER_ONE = FeatureConfig("paper", frames=1)


def transforms(body, rest, turn=None):
    motion = load_motion("punch", fps=30.0)
    q, p = np.asarray(motion.rotations[:8]).copy(), np.asarray(motion.root[:8]).copy()
    if turn is not None:
        first = Rotation.from_quat(q[:, 0], scalar_first=True)
        q[:, 0] = (turn * first).as_quat(scalar_first=True)
        p = p @ turn.as_matrix().T.astype(np.float32)
    from physxnet_jax.motion import make_motion

    world, shift = clip_transforms(body, rest, make_motion(q, p, 30.0))
    return jnp.asarray(world), jnp.asarray(shift)


@pytest.mark.release
def test_only_local_features_are_invariant_to_heading(worn, body, rest):
    _, surface, _ = worn
    turn = Rotation.from_euler("Y", 1.1)
    out = {}
    for name, t in (("a", None), ("b", turn)):
        for inputs in (LOCAL, PAPER):
            r, s = (pad_clip(x, inputs) for x in transforms(body, rest, t))
            out[name, inputs.family] = np.asarray(
                clip_features(surface.rest, surface.weights, r, s, 30.0, inputs)
            )
    scale = np.abs(out["a", "local"]).max()
    assert np.abs(out["a", "local"] - out["b", "local"]).max() < 1e-3 * scale
    assert (
        np.abs(out["a", "paper"] - out["b", "paper"]).max() > 0.1 * np.abs(out["a", "paper"]).max()
    )
    tipped = Rotation.from_euler("X", 0.5)
    r, s = (pad_clip(x, LOCAL) for x in transforms(body, rest, tipped))
    tilted = np.asarray(clip_features(surface.rest, surface.weights, r, s, 30.0, LOCAL))
    # The velocities are the same, gravity isn't: the network can feel which way is down.
    assert np.abs(out["a", "local"][..., :9] - tilted[..., :9]).max() < 1e-3 * scale
    assert np.abs(out["a", "local"][..., 18:21] - tilted[..., 18:21]).max() > 0.2


@pytest.mark.release
@pytest.mark.parametrize(
    "inputs",
    [
        PAPER,
        FeatureConfig(),
        FeatureConfig(frames=2, stride=3, acceleration=False),
        FeatureConfig(frames=1, position=False),
    ],
    ids=["paper", "local", "far", "one"],
)
def test_features_of_a_window_equal_features_of_the_clip(worn, body, rest, inputs):
    _, surface, _ = worn
    world, shift = transforms(body, rest)
    clip = clip_features(
        surface.rest,
        surface.weights,
        pad_clip(world, inputs),
        pad_clip(shift, inputs),
        30.0,
        inputs,
    )
    assert clip.shape == (8, surface.rest.shape[0], inputs.channels)
    windows = [pose_windows(x, inputs.window) for x in (world, shift)]
    assert windows[0].shape[1] == inputs.window
    each = jnp.stack(
        [
            clip_features(surface.rest, surface.weights, r, s, 30.0, inputs)[0]
            for r, s in zip(*windows)
        ]
    )
    np.testing.assert_allclose(np.asarray(clip), np.asarray(each), atol=2e-2)


@pytest.mark.release
def test_stride_selects_whole_frames_of_the_history(worn, body, rest):
    """The oldest velocity of every third frame is that of six frames before."""
    _, surface, _ = worn
    world, shift = transforms(body, rest)
    far, near = FeatureConfig(frames=3, stride=3), FeatureConfig(frames=1)
    at = (surface.rest, surface.weights)
    old = clip_features(*at, pad_clip(world, far), pad_clip(shift, far), 30.0, PAPER_FAR)
    new = clip_features(*at, pad_clip(world, near), pad_clip(shift, near), 30.0, PAPER_ONE)
    np.testing.assert_allclose(np.asarray(old)[6:, :, :3], np.asarray(new)[:2, :, :3], atol=2e-2)
    assert np.abs(np.asarray(old)[6:, :, :3] - np.asarray(new)[6:, :, :3]).max() > 0.1


@pytest.mark.release
def test_position_channel_encodes_the_pose_at_rest(worn, body, rest):
    """A raised arm that is held still: velocities are silent, its place is not."""
    _, surface, _ = worn
    world, shift = transforms(body, rest)
    still = [jnp.repeat(x[:1], 5, axis=0) for x in (world, shift)]
    raised = [jnp.repeat(x[7:8], 5, axis=0) for x in (world, shift)]
    a, b = (
        np.asarray(clip_features(surface.rest, surface.weights, *p, 30.0, LOCAL))[0]
        for p in (still, raised)
    )
    assert np.abs(a[:, :18]).max() == 0 and np.abs(b[:, :18]).max() == 0
    assert np.abs(a[:, 21:] - b[:, 21:]).max() > 0.01
    with pytest.raises(ValueError, match="at least 1"):
        FeatureConfig(frames=0)


def test_velocity_is_in_metres_per_second_at_any_frame_rate(worn, body, rest):
    _, surface, _ = worn
    fast = load_motion("walk", fps=60.0)
    slow = load_motion("walk", fps=30.0)
    speeds = []
    for m, k in ((fast, 60), (slow, 30)):
        world, shift = clip_transforms(body, rest, m)
        f = clip_features(
            surface.rest,
            surface.weights,
            jnp.asarray(world[k + 1 - PAPER.at_rate(m.fps).window : k + 1]),
            jnp.asarray(shift[k + 1 - PAPER.at_rate(m.fps).window : k + 1]),
            m.fps,
            PAPER,
        )
        speeds.append(np.linalg.norm(np.asarray(f[0, :, 6:9]), axis=1).mean())
    assert speeds[0] == pytest.approx(speeds[1], rel=1e-3)


def predictor(worn, family, zero=False):
    atlas, surface, _ = worn
    config = ModelConfig(FeatureConfig(family), resolution=32, width=4, templates=("top", "dress"))
    network = make_generator(config)
    network.eval()
    graph, state = nnx.split(network)
    if zero:
        state = jax.tree.map(jnp.zeros_like, state)
    scales = {t: jnp.float32(0.1) for t in config.templates}
    return Predictor(
        atlas,
        surface,
        Normalisation(jnp.float32(3.0), jnp.float32(60.0), scales),
        state,
        graph,
        config,
    )


@pytest.mark.release
def test_zero_output_of_the_local_family_equals_skinning(worn, body, rest):
    _, _, bound_garments = worn
    r, s = transforms(body, rest)
    out = dress_frames(
        predictor(worn, "local", zero=True),
        bound_garments,
        pad_clip(r, LOCAL),
        pad_clip(s, LOCAL),
        30.0,
    )
    for w, x in zip(bound_garments, out):
        skinned = jax.vmap(lambda a, b, w=w: skin_garment(w, a, b))(r, s)
        np.testing.assert_array_equal(np.asarray(x), np.asarray(skinned))


@pytest.mark.release
def test_local_family_is_equivariant_to_heading(worn, body, rest):
    _, _, bound_garments = worn
    turn = Rotation.from_euler("Y", 0.8)
    p = predictor(worn, "local")
    runs = [
        dress_frames(
            p, bound_garments, *(pad_clip(x, LOCAL) for x in transforms(body, rest, t)), 30.0
        )
        for t in (None, turn)
    ]
    for a, b in zip(*runs):
        np.testing.assert_allclose(np.asarray(a) @ turn.as_matrix().T, np.asarray(b), atol=2e-4)


@pytest.mark.release
@pytest.mark.parametrize("family", ["local", "paper"])
def test_pose_gradients_match_finite_differences(worn, body, rest, family):
    _, _, bound_garments = worn
    p = predictor(worn, family)
    motion = load_motion("walk", fps=30.0)
    poses, root = motion.rotations[20:25], motion.root[20:25]
    bend = body.joint("LeftArm")

    @jax.jit
    def height(angle):
        half = 0.5 * angle
        turn = jnp.stack([jnp.cos(half), jnp.zeros(()), jnp.zeros(()), jnp.sin(half)])
        from physxnet_jax.geometry import quaternion_multiply

        last = poses[-1].at[bend].set(quaternion_multiply(turn, poses[-1, bend]))
        q = jnp.concatenate([poses[:-1], last[None]])
        world, shift = jax.vmap(lambda a, b: body.transforms(rest, a, b))(q, root)
        return sum(x[..., 1].mean() for x in dress_frames(p, bound_garments, world, shift, 30.0))

    slope = jax.grad(height)(jnp.float32(0.1))
    step = 2e-2
    difference = (height(jnp.float32(0.1 + step)) - height(jnp.float32(0.1 - step))) / (2 * step)
    assert float(slope) == pytest.approx(float(difference), rel=0.1, abs=2e-3)


def trained_like(surface, atlas, inputs, seed=0):
    """A predictor whose statistics and scales aren't those it starts with."""
    config = ModelConfig(inputs, resolution=32, width=4, templates=("top", "dress"))
    network = make_generator(config, seed=seed)
    rng = np.random.default_rng(seed)
    network.eval()
    graph, state = nnx.split(network)

    def spoil(path, x):
        low = 0.3 if "var" in jax.tree_util.keystr(path) else -0.5
        flat = x.ndim == 1
        return jnp.asarray(rng.uniform(low, 1.5, x.shape), jnp.float32) if flat else x

    state = jax.tree_util.tree_map_with_path(spoil, state)
    one = jnp.ones((), jnp.float32)
    scales = Normalisation(one, 10 * one, {"top": 0.1 * one, "dress": 0.1 * one})
    return Predictor(atlas, surface, scales, state, graph, config)


def test_only_features_beyond_the_limit_are_clipped(worn):
    inputs = FeatureConfig(frames=1, gravity=False)
    two = jnp.full((), 2.0)
    scales = Normalisation(two, two, {"top": two})
    unit = np.array([[0.6, 0.0, 0.8]], np.float32)
    lengths = (0.0, 1.0, 5.9, 6.1, 1e6, 1e30)
    for length, wanted in zip(lengths, (0.0, 0.5, 2.95, 3.0, 3.0, 3.0)):
        x = jnp.asarray(np.concatenate([length * unit, 0.1 * unit, 0.2 * unit], axis=1))
        out = np.asarray(normalise(x, scales, inputs))
        np.testing.assert_allclose(out[:, :3], wanted * unit, rtol=1e-5)
        np.testing.assert_allclose(out[:, 3:6], 0.05 * unit, rtol=1e-6)
        np.testing.assert_allclose(out[:, 6:], 0.2 * unit, rtol=1e-6)
        grad = jax.grad(lambda v: jnp.sum(normalise(v, scales, inputs)))(x)
        assert np.isfinite(grad).all()
    assert np.isnan(np.asarray(normalise(x.at[0, 1].set(jnp.nan), scales, inputs))).any()


@pytest.mark.release
def test_folded_batch_norm_keeps_the_predictions(worn):
    atlas, surface, _ = worn
    predictor = trained_like(surface, atlas, LOCAL)
    folded = fold_batch_norm(predictor)
    x = jax.random.normal(jax.random.key(3), (3, surface.rest.shape[0], LOCAL.channels))
    templates = ("top", "dress")
    a, b = predictor.from_features(x, templates), folded.from_features(x, templates)
    for t in templates:
        assert float(jnp.abs(a[t]).max()) > 0.01
        np.testing.assert_allclose(np.asarray(b[t]), np.asarray(a[t]), atol=2e-5)
    names = [jax.tree_util.keystr(p) for p, _ in jax.tree_util.tree_leaves_with_path(folded.state)]
    assert names and not any("mean" in n or "norm" in n for n in names)
    again = fold_batch_norm(folded)
    for one, two in zip(jax.tree.leaves(folded.state), jax.tree.leaves(again.state), strict=True):
        np.testing.assert_array_equal(np.asarray(one), np.asarray(two))


@pytest.mark.release
def test_bfloat16_and_float64_predictions_are_close_to_float32(worn):
    """bfloat16 has 8 bits: half a per cent a number, averaged over the taps of a kernel."""
    atlas, surface, _ = worn
    predictor = trained_like(surface, atlas, LOCAL)
    x = jax.random.normal(jax.random.key(3), (2, surface.rest.shape[0], LOCAL.channels))
    want = predictor.from_features(x, ("top",))["top"]
    scale = float(jnp.sqrt(jnp.mean(want * want)))
    low = at_precision(predictor, "bfloat16").from_features(x, ("top",))["top"]
    assert low.dtype == jnp.float32
    off = float(jnp.sqrt(jnp.mean((low - want) ** 2)))
    assert 1e-4 * scale < off < 0.02 * scale
    with jax.enable_x64(True):
        high = at_precision(predictor, "float64").from_features(x, ("top",))["top"]
        # Were it float32 in disguise, both would agree to the last bit.
        gap = np.abs(np.asarray(high) - np.asarray(want)).max()
    assert 0.0 < gap < 2e-5 * scale


@pytest.mark.release
@pytest.mark.parametrize("inputs", [LOCAL, PAPER_FAR], ids=["local", "far"])
def test_test_time_augmentation_makes_predictions_mirror_symmetric(worn, inputs):
    atlas, surface, _ = worn
    plain = trained_like(surface, atlas, inputs)
    both = with_mirror_tta(plain)

    def mirror(texels):
        signs = np.where(np.arange(texels.shape[-1]) % 3, 1.0, -1.0).astype(np.float32)
        return atlas.from_map(atlas.to_map(texels)[:, :, ::-1]) * signs[None, None]

    x = jax.random.normal(jax.random.key(4), (2, surface.rest.shape[0], inputs.channels))
    for t in ("top", "dress"):
        one, two = (mirror(plain.from_features(y, (t,))[t]) for y in (mirror(x), x))
        seen, twin = (both.from_features(y, (t,))[t] for y in (x, mirror(x)))
        valid = np.asarray(surface.valid[t])
        twins = np.asarray(mirror(surface.valid[t][None, :, None].astype(jnp.float32)))[0, :, 0]
        shared = valid & (twins != 0)
        assert shared.sum() > 0.9 * valid.sum() > 0
        np.testing.assert_allclose(seen[:, shared], mirror(twin)[:, shared], atol=2e-6)
        mean = 0.5 * (plain.from_features(x, (t,))[t] + one)
        np.testing.assert_allclose(seen[:, shared], mean[:, shared], atol=2e-6)
        # Where the mirror image isn't covered there is one answer alone.
        alone = valid & ~shared
        want = plain.from_features(x, (t,))[t]
        np.testing.assert_allclose(seen[:, alone], want[:, alone], atol=2e-6)
        assert float(jnp.abs(two - plain.from_features(mirror(x), (t,))[t]).max()) > 0.01
    moved = dataclasses.replace(surface, rest=surface.rest + jnp.array([[0.05, 0.0, 0.0]]))
    with pytest.raises(ValueError, match="mirror images"):
        with_mirror_tta(dataclasses.replace(plain, texel_points=moved))


def test_paper_family_dress_offsets_round_trip_on_the_dress_body(body, rest):
    """Its map at rest, from the hull of both legs, gives the dress back."""
    atlas, g = make_atlas(64), template("dress")
    rows = garment_map_rows(atlas, body, rest, g)
    surface = make_texel_points(atlas, body, rest, {"dress": rows.valid})
    worn = bind_garment(body, rest, g, bind(g, atlas=atlas, body=body, rest=rest, valid=rows.valid))
    joined = jnp.asarray(dress_body(body, np.asarray(rest)).astype(np.float32))
    np.testing.assert_allclose(surface.rest_dress, atlas.to_body @ joined, atol=1e-6)
    np.testing.assert_allclose(worn.anchor, worn.binding.to_body @ joined, atol=1e-6)
    offsets = cloth_offsets(rows, g.mesh.vertices, surface.rest_dress)
    turns, shifts = (
        jnp.tile(jnp.eye(3), (len(body.parents), 1, 1)),
        jnp.zeros((len(body.parents), 3)),
    )
    again = np.asarray(apply_offsets(worn, turns, shifts, offsets, "paper"))
    gap = np.linalg.norm(again - np.asarray(g.mesh.vertices), axis=1)
    skirt = np.asarray(g.mesh.vertices)[:, 1] < -0.15
    assert np.median(gap[skirt]) < 0.025


UNOPTIMISED = """
import os
os.environ["XLA_FLAGS"] = "--xla_backend_optimization_level=0"
import jax
import jax.numpy as jnp
import numpy as np
from physxnet_jax.body import load_body
from physxnet_jax.models import load_predictor
from physxnet_jax.models import clip_features, normalise
from physxnet_jax.motion import load_motion

body, walk = load_body(), load_motion("walk", fps=30.0)
rest = body.rest_vertices(body.default_shape())
network = load_predictor("nano")
inputs = network.config.inputs
turn, shift = (
    jnp.repeat(x[None], inputs.window, axis=0)
    for x in body.transforms(rest, walk.rotations[0], walk.root[0])
)

@jax.jit
@jax.grad
def slope(turn):
    seen = clip_features(
        network.texel_points.rest, network.texel_points.weights, turn, shift, 30.0, inputs
    )
    return jnp.sum(normalise(seen, network.normalisation, inputs) ** 2)

found = slope(turn)
print("finite" if bool(jnp.isfinite(found).all()) else "spoiled", float(jnp.abs(found).max()))
"""


@pytest.mark.nightly
def test_gradients_are_finite_in_unoptimised_programs():
    """Unoptimised programs compute values anew, and the maximum among them is none of them."""
    done = subprocess.run(
        [sys.executable, "-c", UNOPTIMISED], capture_output=True, text=True, timeout=300
    )
    word, most = done.stdout.split()
    assert word == "finite" and float(most) > 0, done.stdout + done.stderr[-2000:]
