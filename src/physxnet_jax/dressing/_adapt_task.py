"""The loss of fine-tuning to one garment: its potential, and where its patches should be."""

import dataclasses
import functools
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from flax import nnx
from jaxtyping import Array, Float, Int

from ..body import Body
from ..errors import check_counts, check_numbers
from ..garment import Garment
from ..geometry import pad_rows, patch_shares
from ..models import (
    BoundGarment,
    Predictor,
    apply_sampled_offsets,
    clip_features,
    normalise,
)
from ..motion import (
    BLOCK,
    Motion,
    clip_transforms,
    history_transforms,
    padded_block,
)
from ..simulation import (
    System,
    incremental_potential,
)
from ..typing import pytree
from ..uv import condition_maps
from ._dresser import bind_to_predictor
from .postprocess import BodyCollider, Outfit, apply_collisions, make_colliders

FPS = 30.0
# Distance between the middles of patches [m].
_PATCH = 0.08
# Errors and sinking are relative to this length, energies to lifting the garment by it [m].
_LENGTH = 0.01
# Stiffness of contact per mass [1/s^2].
_CONTACT = (2.0 * np.pi * 30.0) ** 2
# Weights of the potential, without and with simulations.
_WEIGHTS = (0.002, 0.0003)


@dataclasses.dataclass(frozen=True, kw_only=True)
class AdaptConfig:
    """Settings of `adapt`.

    Attributes:
        steps: Steps of Adam.
        windows: Windows of successive frames in a step.
        frames: Frames of a window, of which the first two have no past.
        learning_rate: Adam's learning rate; it decays to zero along a cosine.
        potential: Weight of the cloth's potential; by default 0.002, or 0.0003 with simulations,
            which are nearer the truth than what lowers the potential most.
        validate_every: Steps between validations on the clip that is held out.
        seed: Seed of the choice of windows.
    """

    steps: int = 1000
    windows: int = 2
    frames: int = 6
    learning_rate: float = 1e-3
    potential: float | None = None
    validate_every: int = 100
    seed: int = 0

    def __post_init__(self) -> None:
        check_counts(self, "steps", "windows", "frames", "validate_every")
        check_numbers(self, "learning_rate")
        check_numbers(self, "potential", zero=True)
        if self.frames < 3:
            raise ValueError(f"frames is {self.frames}; a window needs three for accelerations.")


@pytree
@dataclasses.dataclass(frozen=True, kw_only=True)
class Task:
    """What a step needs beside the parameters that learn.

    Attributes:
        predictor: The network as it was.
        others: Its parameters and statistics that stay.
        bound: The garment on the body.
        conditions: What the network sees of the garment; None if it sees nothing.
        system: The cloth's physics.
        collider: The skin near the garment.
        index: Vertices of each patch, shape [patches, k].
        share: Their shares in its mean, shape [patches, k].
        mass: Masses of vertices [kg], shape [vertices].
        config: Settings.
        simulated: Whether there are simulations to learn from.
    """

    predictor: Predictor
    others: Any
    bound: BoundGarment
    conditions: Float[Array, "height width channels"] | None
    system: System
    collider: BodyCollider
    index: Int[Array, "patches k"]
    share: Float[Array, "patches k"]
    mass: Float[Array, " vertices"]
    config: AdaptConfig = dataclasses.field(metadata={"static": True})
    simulated: bool = dataclasses.field(metadata={"static": True})


@pytree
@dataclasses.dataclass(frozen=True, kw_only=True)
class Frames:
    """Frames to learn from.

    Attributes:
        features: What the encoder makes of the motion, finest first; the frame is the first axis.
        rotations: World rotations of joints, shape [frames, joints, 3, 3].
        translations: World translations of joints [m], shape [frames, joints, 3].
        target: Where the cloth should be [m], shape [frames, vertices, 3].
    """

    features: list[Any]
    rotations: Any
    translations: Any
    target: Any

    def take(self, rows: slice | np.ndarray) -> "Frames":
        """Some of the frames."""
        return jax.tree.map(lambda x: x[rows], self)


def make_task(
    predictor: Predictor,
    body: Body,
    rest: Float[Array, "all 3"],
    worn: Garment,
    system: System,
    config: AdaptConfig,
    simulated: bool,
) -> tuple[Task, Any]:
    """The task, and the parameters that learn as they are at first."""
    bound = bind_to_predictor(predictor, body, rest, worn)
    (collider,) = make_colliders(Outfit(body, rest, (bound,), (worn,)))
    conditions = None
    if predictor.config.conditions:
        base = body.rest_vertices(body.default_shape())
        conditions = condition_maps(
            predictor.atlas, body, base, worn, bound.binding, predictor.config.fabrics
        )
    vertices, faces = np.asarray(worn.mesh.vertices), np.asarray(worn.mesh.faces)
    index, share = pad_rows(patch_shares(vertices, faces, _PATCH).T.tocsr())
    learns, others = nnx.split_state(predictor.state, _decoder_of(worn.template), ...)
    inverse = system.inverse_mass[:, 0, 0]
    task = Task(
        predictor=predictor,
        others=others,
        bound=bound,
        conditions=conditions,
        system=system,
        collider=collider,
        index=jax.device_put(index),
        share=jax.device_put(share / share.sum(axis=1, keepdims=True)),
        mass=jnp.where(inverse > 0, 1.0 / jnp.where(inverse > 0, inverse, 1.0), 0.0),
        config=config,
        simulated=simulated,
    )
    return task, learns


def _decoder_of(template: str) -> Callable[[tuple, Any], bool]:
    """Selects the parameters of one decoder."""

    def chosen(path: tuple, value: Any) -> bool:
        return tuple(path[:2]) == ("decoders", template) and isinstance(value, nnx.Param)

    return chosen


def _network(task: Task, params: Any) -> Any:
    network = nnx.merge(task.predictor.graph, nnx.merge_state(params, task.others))
    network.eval()
    return network


def predict_maps(task: Task, params: Any, frames: Frames) -> Float[Array, "frames height width 3"]:
    """Maps of offsets, relative to their scale, as a network of these parameters predicts them."""
    bound, network = task.bound, _network(task, params)
    known = None
    if task.conditions is not None:
        known = network.modulation(bound.template, task.conditions[None])
    features = [f.astype(jnp.float32) for f in frames.features]
    return network.decode(bound.template, features, known)


def place_maps(
    task: Task, maps: Float[Array, "frames height width 3"], frames: Frames
) -> Float[Array, "frames vertices 3"]:
    """The garment that follows from maps of offsets [m]."""
    predictor, bound = task.predictor, task.bound
    scale, valid = (
        x[bound.template] for x in (predictor.normalisation.offset, predictor.texel_points.valid)
    )
    offsets = jnp.where(valid[None, :, None], scale * predictor.atlas.from_map(maps), 0.0)
    place = functools.partial(apply_sampled_offsets, bound, family=predictor.config.family)
    return jax.vmap(place)(frames.rotations, frames.translations, bound.sample(offsets))


def mean_errors(
    task: Task, away: Float[Array, "frames vertices 3"]
) -> tuple[Float[Array, ""], Float[Array, ""]]:
    """Mean absolute error at vertices and at means over patches, relative to 1 cm."""
    means = jnp.einsum("pk,fpkc->fpc", task.share, away[:, task.index])
    return jnp.mean(jnp.abs(away)) / _LENGTH, jnp.mean(jnp.abs(means)) / _LENGTH


def task_loss(
    task: Task, params: Any, frames: Frames
) -> tuple[Float[Array, ""], dict[str, Float[Array, ""]]]:
    """The loss of some windows, and what it consists of."""
    config = task.config
    x = place_maps(task, predict_maps(task, params, frames), frames)
    away = x - frames.target
    everywhere, error = mean_errors(task, away)
    if task.simulated:
        error = 0.5 * error + 0.5 * everywhere
    potential = mean_potential(task, x, frames)
    weight = _WEIGHTS[task.simulated] if config.potential is None else config.potential
    total = error + weight * potential / lift_energy(task)
    squared = jnp.mean(jnp.sum(away**2, axis=2))
    return total, {"loss": total, "potential": potential, "squared": squared}


def lift_energy(task: Task) -> Float[Array, ""]:
    """What it takes to lift the garment by 1 cm [J]."""
    return 9.81 * _LENGTH * jnp.sum(task.mass)


def mean_potential(
    task: Task, x: Float[Array, "frames vertices 3"], frames: Frames
) -> Float[Array, ""]:
    """The potential of the cloth in windows of successive frames, and of contact [J]."""
    config = task.config
    (pushed,) = apply_collisions(
        (task.collider,), (jax.lax.stop_gradient(x),), frames.rotations, frames.translations
    )
    sunk = jnp.sum((x - jax.lax.stop_gradient(pushed)) ** 2, axis=2)
    contact = 0.5 * _CONTACT * jnp.mean(jnp.sum(task.mass[None] * sunk, axis=1))
    # Frames of a window become the batch: a frame moves on from the two before it, as they are.
    window = x.reshape(-1, config.frames, *x.shape[1:])
    older, before = (
        jax.lax.stop_gradient(_as_batch(window[:, k : config.frames - 2 + k])) for k in range(2)
    )
    energy = incremental_potential(
        task.system, _as_batch(window[:, 2:]), before, FPS * (before - older), length=1.0 / FPS
    )
    return jnp.mean(energy) + contact


def _as_batch(
    window: Float[Array, "windows frames vertices 3"],
) -> Float[Array, "vertices 3 batch"]:
    return jnp.moveaxis(window.reshape(-1, *window.shape[2:]), 0, -1)


@jax.jit
def _measure(task: Task, params: Any, frames: Frames) -> dict[str, Array]:
    return task_loss(task, params, frames)[1]


def judge(task: Task, params: Any, clip: Frames) -> dict[str, float]:
    """Loss, potential [J] and RMSE [mm] on a clip, window by window."""
    size = task.config.frames
    starts = range(0, len(clip.target) - size + 1, size)
    found = [_measure(task, params, clip.take(slice(s, s + size))) for s in starts]
    mean = {k: float(np.mean([float(f[k]) for f in found])) for k in found[0]}
    return {**mean, "rmse_mm": 1e3 * mean["squared"] ** 0.5}


def encode(
    task: Task, params: Any, clip: Motion, body: Body, rest: Float[Array, "all 3"]
) -> Frames:
    """A clip as frames to learn from, whose cloth should stay where it is predicted."""
    history = task.predictor.config.inputs.at_rate(FPS).window - 1
    r, t = clip_transforms(body, rest, clip)
    before = history_transforms(body, rest, clip, history)
    r, t = (np.concatenate(pair) for pair in zip(before, (r, t), strict=True))
    count, parts = clip.num_frames, []
    for start in range(0, count, BLOCK):
        padded = (jax.device_put(padded_block(x, start + history, history)) for x in (r, t))
        made = _encode_block(task, params, *padded)
        parts.append(jax.tree.map(np.asarray, made))
    return jax.tree.map(lambda *x: np.concatenate(x)[:count], *parts)


@jax.jit
def _encode_block(task: Task, params: Any, rotations: Array, translations: Array) -> Frames:
    predictor, inputs = task.predictor, task.predictor.config.inputs
    points = predictor.texel_points
    features = clip_features(points.rest, points.weights, rotations, translations, FPS, inputs)
    maps = predictor.motion_atlas.to_map(normalise(features, predictor.normalisation, inputs))
    first = inputs.at_rate(FPS).window - 1
    # Half precision: the features of a thousand frames are in memory.
    features = [f.astype(jnp.float16) for f in _network(task, params).encode(maps)]
    frames = Frames(
        features=features,
        rotations=rotations[first:],
        translations=translations[first:],
        target=None,
    )
    cloth = place_maps(task, predict_maps(task, params, frames), frames)
    return dataclasses.replace(frames, target=cloth)
