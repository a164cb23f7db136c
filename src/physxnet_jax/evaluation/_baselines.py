"""Learned baselines: the nearest training frame, and a perceptron of the pose."""

import dataclasses
import functools
from collections.abc import Callable, Sequence as Items
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import optax
from jaxtyping import Array, Float

from ..body import Body, load_body
from ..data import QUANTIZATION_STEP, Frames, Sequence, load_frames, make_wardrobe
from ..garment import Template
from ._methods import Blockwise, place_local, rest_and_skin

_HIDDEN = 512
_BATCH = 64


def pose_features(
    rotations: Float[Array, "frames joints 3 3"], parents: tuple[int, ...]
) -> Float[Array, "frames features"]:
    """Pose features that are invariant to the person's position and heading.

    They are the joint rotations relative to the parents, and the direction of gravity in
    the frame of the first joint.

    Args:
        rotations: World rotations.
        parents: Parent of each joint, -1 for the first.
    """
    parent_index = jnp.asarray([max(p, 0) for p in parents], dtype=jnp.int32)
    relative = jnp.einsum("fjba,fjbc->fjac", rotations[:, parent_index], rotations)
    inner = jnp.asarray([j for j, p in enumerate(parents) if p >= 0], dtype=jnp.int32)
    joints = relative[:, inner].reshape(len(rotations), -1)
    return jnp.concatenate([joints, -rotations[:, 0, 1, :]], axis=1)


@dataclasses.dataclass(frozen=True)
class _PoseData:
    """Pose features and vertex-local cloth offsets of a template in the training set."""

    features: np.ndarray
    offsets: np.ndarray


def _pose_data(frames: Frames, body: Body, name: Template) -> _PoseData:
    use = frames.usable[name]
    rotations = jnp.asarray(frames.rotations[use, -1])
    return _PoseData(np.asarray(pose_features(rotations, body.parents)), frames.targets[name][use])


def training_frames(sequences: Items[Sequence], names: Items[Template]) -> Frames:
    """Loads training frames with targets in vertex-local frames."""
    return load_frames(sequences, make_wardrobe([None], names), load_body(), window=1, local=True)


def nearest_frame(frames: Frames) -> Blockwise:
    """A method that returns the cloth of the training frame with the nearest pose."""
    body = load_body()

    def wear(name: Template) -> Any:
        known = _pose_data(frames, body, name)
        return (
            rest_and_skin(name),
            jnp.asarray(known.features),
            jnp.asarray(known.offsets),
        )

    return Blockwise(_nearest, functools.cache(wear))


@functools.partial(jax.jit, static_argnames=("fps",))
def _nearest(worn: Any, r: Array, t: Array, fps: float) -> Array:
    rest, features, offsets = worn
    query = pose_features(r, load_body().parents)
    distance = jnp.sum((query[:, None] - features[None]) ** 2, axis=2)
    found = offsets[jnp.argmin(distance, axis=1)].astype(jnp.float32) * QUANTIZATION_STEP
    return place_local(rest, r, t, found)


def pose_network(
    frames: Frames,
    *,
    steps: int = 2000,
    seed: int = 0,
    report: Callable[[str, int, int], None] | None = None,
) -> Blockwise:
    """A perceptron from the pose alone to every vertex's offset, one for each garment.

    Args:
        frames: Training frames.
        steps: Number of Adam steps.
        seed: Seed of the initial parameters and the batches.
        report: Called with a text, the steps done and the total.

    References:
        Patel, Liao and Pons-Moll, TailorNet (2020), section 5: its baseline.
    """
    body = load_body()

    def wear(name: Template) -> Any:
        known = _pose_data(frames, body, name)
        params, scale = _fit(known, steps, seed, name, report)
        return rest_and_skin(name), params, scale

    return Blockwise(_predict, functools.cache(wear))


def _perceptron(params: list[tuple[Array, Array]], x: Array) -> Array:
    for w, b in params[:-1]:
        x = jax.nn.relu(jnp.matmul(x, w) + b[None])
    w, b = params[-1]
    return jnp.matmul(x, w) + b[None]


@functools.partial(jax.jit, static_argnames=("fps",))
def _predict(worn: Any, r: Array, t: Array, fps: float) -> Array:
    rest, params, (mean, deviation) = worn
    x = (pose_features(r, load_body().parents) - mean[None]) / deviation[None]
    out = _perceptron(params, x).reshape(len(r), -1, 3)
    return place_local(rest, r, t, out)


def _fit(
    known: _PoseData,
    steps: int,
    seed: int,
    name: str,
    report: Callable[[str, int, int], None] | None,
) -> tuple[Any, tuple[Array, Array]]:
    mean = known.features.mean(axis=0)
    # The floor keeps joints that hardly rotated in training from dominating when they do.
    deviation = np.maximum(known.features.std(axis=0), 0.05)
    features = jnp.asarray((known.features - mean) / deviation)
    offsets = jnp.asarray(known.offsets)
    sizes = [features.shape[1], _HIDDEN, _HIDDEN, offsets.shape[1] * 3]
    keys = jax.random.split(jax.random.key(seed), len(sizes))
    params = [
        (jax.random.normal(k, (a, b)) * np.float32((2.0 / a) ** 0.5), jnp.zeros((b,)))
        for k, a, b in zip(keys, sizes[:-1], sizes[1:], strict=False)
    ]
    params[-1] = (params[-1][0] * 0.01, params[-1][1])
    tx = optax.adam(optax.cosine_decay_schedule(1e-3, steps))

    @jax.jit
    def step(params: Any, state: Any, key: Array) -> tuple[Any, Any]:
        batch = jax.random.randint(key, (_BATCH,), 0, len(features))

        def loss(p: Any) -> Array:
            target = offsets[batch].astype(jnp.float32).reshape(_BATCH, -1) * QUANTIZATION_STEP
            return jnp.mean(jnp.abs(_perceptron(p, features[batch]) - target))

        grads = jax.grad(loss)(params)
        with jax.numpy_dtype_promotion("standard"):
            updates, state = tx.update(grads, state, params)
        return optax.apply_updates(params, updates), state

    state = tx.init(params)
    for k in range(steps):
        params, state = step(params, state, jax.random.fold_in(keys[-1], k))
        if report is not None and k % 50 == 0:
            report(f"pose network, {name}", k, steps)
    return params, (jnp.asarray(mean), jnp.asarray(deviation))
