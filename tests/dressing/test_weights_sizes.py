"""Every profile of the ladder, live and pushed out, where it is hard: value and derivatives."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from physxnet_jax.dressing import (
    Inference,
    clothe,
    clothe_step,
    init_stream,
    make_dresser,
    with_shape,
)
from physxnet_jax.evaluation import load_cost_table, parse_method


@pytest.fixture(scope="module")
def judge(dresser):
    """Whether all is finite: vertices, and how they change with pose, root and shape."""

    @jax.jit
    def look(rotations, root, shape):
        def total(q, p, s):
            cloth = clothe(with_shape(dresser, s), q, p, 30.0)
            return jnp.mean((cloth["bottom"] - p[:, None]) ** 2), cloth

        (value, cloth), slopes = jax.value_and_grad(total, argnums=(0, 1, 2), has_aux=True)(
            rotations, root, shape
        )
        ways = tuple(jnp.ones_like(x) for x in (rotations, root, shape))
        return (
            value,
            cloth,
            slopes,
            jax.jvp(lambda *x: total(*x)[0], (rotations, root, shape), ways),
        )

    return look


def still(q, p):
    return q[:1].repeat(len(q), axis=0), p[:1].repeat(len(p), axis=0)


def teleport(q, p):
    return q, p.at[3:, 0].add(10.0)


def fast(q, p):
    """Every second frame turned half round."""
    half = jnp.array([0.0, 0.0, 1.0, 0.0])
    return q.at[::2, 0].set(jnp.broadcast_to(half, q[::2, 0].shape)), 50.0 * p


@pytest.mark.release
@pytest.mark.parametrize("case", [still, teleport, fast])
@pytest.mark.parametrize(
    "values",
    [
        {},
        {"gender": 1.0, "height_up": 1.0, "weight_up": 1.0},
        {"height_down": 1.0, "weight_down": 1.0},
    ],
    ids=["usual", "huge", "tiny"],
)
def test_cloth_and_gradients_with_collisions_are_finite(dresser, judge, motion, case, values):
    value, cloth, slopes, tangents = judge(*case(*motion), dresser.body.shape(**values))
    assert cloth.ok.all() and np.isfinite(value)
    assert all(np.isfinite(x).all() for x in (*slopes, *tangents))
    assert any(np.abs(x).max() > 0 for x in slopes)


@pytest.mark.release
def test_stream_flags_a_non_finite_frame_and_recovers(dresser, motion):
    """Those whose window holds it, and then all is well again."""
    rotations, root = motion
    step = jax.jit(clothe_step, static_argnames="fps", donate_argnames="stream")
    inputs = dresser.predictor.config.inputs
    steps = inputs.stride * np.arange(inputs.frames)[:, None] + inputs.span * np.arange(3)
    count = inputs.window + 3
    clean = jax.jit(clothe, static_argnames="fps")(
        dresser, rotations[:1].repeat(count, 0), root[:1].repeat(count, 0), fps=30.0
    )
    stream = init_stream(dresser, rotations, root)
    flags = []
    for k in range(count):
        p = root[0] if k != 2 else root[0].at[1].set(jnp.nan)
        stream, cloth = step(dresser, stream, rotations[0], p, fps=30.0)
        flags.append(bool(cloth.ok))
    assert flags == [k - 2 not in steps for k in range(count)] and flags[-1]
    np.testing.assert_allclose(
        np.asarray(cloth["bottom"]), np.asarray(clean["bottom"][-1]), atol=1e-5
    )


@pytest.mark.nightly
def test_one_frame_clip_is_treated_as_static(dresser, motion):
    rotations, root = (jnp.repeat(x[:1], len(x), axis=0) for x in motion)
    run = jax.jit(lambda q, p: clothe(dresser, q, p, 30.0)["bottom"])
    np.testing.assert_allclose(
        np.asarray(run(rotations[:1], root[:1])[0]), np.asarray(run(rotations, root)[-1]), atol=1e-5
    )
    slope = jax.jit(jax.grad(lambda q: jnp.mean(run(q, root[:1]) ** 2)))(rotations[:1])
    assert np.isfinite(slope).all() and np.abs(slope).max() > 0


@pytest.mark.release
@pytest.mark.parametrize(
    "weights",
    [
        pytest.param("nano", marks=pytest.mark.nightly),
        pytest.param("small", marks=pytest.mark.nightly),
        pytest.param("base", marks=pytest.mark.release),
        pytest.param("base+mirror", marks=pytest.mark.nightly),
        "paper",
    ],
)
def test_gradients_match_finite_differences_for_every_method(dresser, motion, weights):
    """And by the weights, in float64: small steps stay clear of the network's kinks.

    The mean height of a leg that is bent, without push-out's corners.
    """
    person = make_dresser(
        ["bottom"], inference=dataclasses.replace(parse_method(weights), collisions=False)
    )
    knee = dresser.body.joint("LeftLeg")
    with jax.enable_x64(True):

        def wide(tree):
            return jax.tree.map(
                lambda x: x.astype("float64") if jnp.issubdtype(x.dtype, jnp.floating) else x, tree
            )

        person = wide(person)
        # In the middle of the punch: at its start random weights hardly move the leg of `paper`.
        rotations, root = (wide(x[3:5]) for x in motion)
        # A way that moves the leg at every profile by far more than differences are off.
        rng = np.random.default_rng(3)
        leaves, tree = jax.tree.flatten(person.predictor.state)
        noise = [jnp.asarray(rng.normal(0.0, 1.0, x.shape)) * jnp.std(x) for x in leaves]

        @jax.jit
        def height(bend, change):
            turn = jnp.stack([jnp.cos(0.5 * bend), jnp.sin(0.5 * bend), 0.0 * bend, 0.0 * bend])
            q = rotations.at[:, knee].set(turn)
            state = jax.tree.unflatten(
                tree, [x + change * n for x, n in zip(leaves, noise, strict=True)]
            )
            predictor = dataclasses.replace(person.predictor, state=state)
            mine = dataclasses.replace(person, predictor=predictor)
            return jnp.mean(clothe(mine, q, root, 30.0)["bottom"][..., 1])

        at = (jnp.float64(0.4), jnp.float64(0.0))
        slopes = jax.jit(jax.grad(height, argnums=(0, 1)))(*at)
        for k, step in enumerate((1e-6, 1e-7)):
            ends = []
            for s in (step, -step):
                there = list(at)
                there[k] = at[k] + s
                ends.append(float(height(*there)))
            difference = (ends[0] - ends[1]) / (2 * step)
            assert float(slopes[k]) == pytest.approx(difference, rel=1e-3)
            assert abs(difference) > 1e-3


@pytest.mark.release
def test_bfloat16_increases_the_error_by_less_than_two_percent(dresser, motion):
    """Errors that have nothing to do with each other add as squares: d < 0.2 e."""
    clothed = [
        np.asarray(jax.jit(clothe, static_argnames="fps")(d, *motion, fps=30.0)["bottom"])
        for d in (
            make_dresser(["bottom"], inference=Inference(collisions=False), precision=p)
            for p in ("float32", "bfloat16")
        )
    ]
    apart = np.sqrt(np.mean(np.sum((clothed[0] - clothed[1]) ** 2, axis=2)))
    (profile,) = [r for r in load_cost_table() if r.name == "base+relax+push"]
    assert 0 < apart < 0.2e-3 * profile.rmse_mm["bottom"]
