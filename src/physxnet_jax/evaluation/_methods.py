"""Methods that compute cloth from motion, behind one interface: the network and baselines."""

import dataclasses
import functools
import time
from collections.abc import Callable
from typing import Any, Protocol, runtime_checkable

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ..body import load_body, skin_points
from ..data import Clothing, Worn, garment_of, shape_of
from ..dressing import (
    EXTERNAL_ENGINES,
    Dresser,
    Inference,
    Precision,
    Simulation,
    infer_block,
    infer_clip,
    make_dresser,
    pose_clip,
)
from ..geometry import polar_rotation
from ..models import Predictor, load_predictor
from ..motion import BLOCK, Motion, clip_transforms, padded_block
from ..simulation import (
    PRESETS,
    PreparedScene,
    Scene,
    prepare_scene,
    simulate_batch,
    standard_effects,
)
from ..simulation.effects import Guide

# Time constant of a guide that doesn't pull [s].
_NEVER = 1e6

# Perturbation of the body's root that shows how far simulations diverge [m].
PERTURBATION = 1e-6


@dataclasses.dataclass(frozen=True)
class Prediction:
    """The cloth that a method predicts, and its time.

    Attributes:
        positions: Cloth [m], shape [frames, vertices, 3].
        ms_per_frame: Median after the first block, from joint rotations to vertices [ms].
    """

    positions: Float[np.ndarray, "frames vertices 3"]
    ms_per_frame: float


@runtime_checkable
class Method(Protocol):
    """Computes a garment's cloth from a motion."""

    def __call__(self, motion: Motion, name: Clothing) -> Prediction:
        """The cloth in every frame."""
        ...


def _none(fps: float) -> int:
    return 0


@dataclasses.dataclass
class Blockwise:
    """A method that is a pure function of the joint transforms of a block of frames.

    Attributes:
        block: Maps a garment, world rotations and translations of joints (including
            ``history`` earlier frames) and the frame rate to cloth.
        wear: Maps a garment to the form that ``block`` takes.
        history: Number of earlier frames that ``block`` uses at a frame rate.
    """

    block: Callable[[Any, Array, Array, float], Array]
    wear: Callable[[Clothing], Any]
    history: Callable[[float], int] = _none

    def __call__(self, motion: Motion, name: Clothing) -> Prediction:
        """The cloth in every frame."""
        body, history = load_body(), self.history(motion.fps)
        rest = body.rest_vertices(shape_of(name))
        world, shift = clip_transforms(body, rest, motion)
        worn = self.wear(name)
        blocks, times = [], []
        # The first block runs twice, so that compilation is excluded from the time.
        for start in (0, *range(0, len(world), BLOCK)):
            began = time.perf_counter()
            r, t = (padded_block(x, start, history) for x in (world, shift))
            out = self.block(worn, jnp.asarray(r), jnp.asarray(t), motion.fps)
            blocks.append(np.asarray(out))
            times.append(1e3 * (time.perf_counter() - began) / BLOCK)
        cloth = np.concatenate(blocks[1:])[: len(world)]
        return Prediction(cloth, float(np.median(times[1:])))


def skinning() -> Blockwise:
    """Linear blend skinning: the baseline of the paper."""
    return Blockwise(_infer, _skinned)


@functools.cache
def _skinned(name: Clothing) -> Dresser:
    return make_dresser(
        [garment_of(name)],
        method="lbs",
        shape=shape_of(name),
        inference=Inference(collisions=False),
    )


def _infer(dresser: Dresser, r: Array, t: Array, fps: float) -> Array:
    return infer_block(dresser, r, t, fps)[1][0]


def rest_and_skin(name: Clothing) -> tuple[Array, Array]:
    """A garment's vertices at rest [m] and their skinning weights."""
    garment = garment_of(name)
    return garment.rest_vertices(load_body().rest_vertices(shape_of(name))), garment.skin


def place_local(
    worn: tuple[Array, Array],
    rotations: Float[Array, "frames joints 3 3"],
    translations: Float[Array, "frames joints 3"],
    offsets: Float[Array, "frames vertices 3"],
) -> Float[Array, "frames vertices 3"]:
    """Adds offsets [m] in vertex-local frames to the skinned vertices [m]."""

    def one(r: Array, t: Array, o: Array) -> Array:
        points, blend = skin_points(*worn, r, t)
        return points + jnp.einsum(
            "vab,vb->va", polar_rotation(blend), o, precision=jax.lax.Precision.HIGHEST
        )

    return jax.vmap(one)(rotations, translations, offsets)


def network(inference: Inference, precision: Precision = "float32") -> Blockwise:
    """A network with its post-processing, one garment at a time.

    Args:
        inference: Weights and post-processing.
        precision: Precision of the network's arithmetic.
    """
    weights = inference.weights
    predictor = weights if isinstance(weights, Predictor) else load_predictor(weights)
    loaded = dataclasses.replace(inference, weights=predictor)

    @functools.cache
    def wear(name: Clothing) -> Dresser:
        return make_dresser(
            [garment_of(name)], shape=shape_of(name), inference=loaded, precision=precision
        )

    inputs = predictor.config.inputs
    return Blockwise(_infer, wear, lambda fps: inputs.at_rate(fps).window - 1)


class Guided:
    """Guided simulation, one garment at a time.

    Args:
        inference: Weights of the network that guides.
        substeps: Substeps a frame at 30 frames per second; the default if None.
        free: Not drawn to the network, which only starts the cloth: what the guide is worth.
    """

    def __init__(
        self, inference: Inference, substeps: int | None = None, *, free: bool = False
    ) -> None:
        self._inference, self._substeps, self._free = inference, substeps, free
        self._dressers: dict[Clothing, Dresser] = {}

    def __call__(self, motion: Motion, name: Clothing) -> Prediction:
        """The cloth in every frame."""
        if name not in self._dressers:
            garment = garment_of(name)
            effects = (*standard_effects((garment,)), Guide(time_constant=_NEVER))
            self._dressers[name] = make_dresser(
                [garment],
                method="guided",
                shape=shape_of(name),
                inference=self._inference,
                simulation=Simulation(
                    substeps=self._substeps, effects=effects if self._free else None
                ),
            )
        dresser = self._dressers[name]
        clip = pose_clip(dresser.body, dresser.rest, motion)
        blocks = list(infer_clip(dresser, clip))
        cloth = np.concatenate([b.positions[dresser.worn[0].name] for b in blocks])
        times = [b.milliseconds / BLOCK for b in blocks]
        return Prediction(cloth, float(np.median(times[1:] if len(times) > 1 else times)))


def scene_of(name: Clothing) -> Scene:
    """A garment alone, with the effects that a dataset simulates it with."""
    garment = garment_of(name)
    if not isinstance(name, Worn):
        return Scene((garment,))
    return Scene((garment,), standard_effects((garment,)), None, shape_of(name))


class Simulator:
    """The package's simulator at a preset accuracy, optionally with a perturbed root.

    Args:
        accuracy: ``draft``, ``standard``, ``fine`` or ``reference``.
        moved: Standard deviation of normal noise added to the root [m]. The divergence
            from the unperturbed run is the smallest meaningful error.
    """

    def __init__(self, accuracy: str, moved: float = 0.0) -> None:
        self._solver, self._moved = PRESETS[accuracy], moved
        self._scenes: dict[Clothing, PreparedScene] = {}

    def __call__(self, motion: Motion, name: Clothing) -> Prediction:
        """The cloth in every frame."""
        if name not in self._scenes:
            self._scenes[name] = prepare_scene(scene_of(name))
        noise = np.random.default_rng(0).normal(0.0, self._moved, motion.root.shape)
        moved = dataclasses.replace(motion, root=motion.root + jnp.asarray(noise, jnp.float32))
        ticks = [time.perf_counter()]
        done = [0]

        def tick(frames: int, _: int) -> None:
            ticks.append(time.perf_counter())
            done.append(frames)

        solver = self._solver.at_rate(motion.fps)
        rollout = simulate_batch(self._scenes[name], [moved], solver=solver, progress=tick)[0]
        laps = 1e3 * np.diff(ticks) / np.maximum(np.diff(done), 1)
        return Prediction(
            rollout.positions[0], float(np.median(laps[1:] if len(laps) > 1 else laps))
        )


def external_engine(name: str) -> Method:
    """An external simulator as a method: ``blender`` or ``newton``.

    It models cloth differently, so its distance to the package's simulator isn't an error.
    """
    run = EXTERNAL_ENGINES[name]

    def method(motion: Motion, name: Clothing) -> Prediction:
        rollout = run(scene_of(name), motion)
        # The first frame includes loading and settling.
        laps = rollout.diagnostics["milliseconds"]
        return Prediction(
            rollout.positions[0], float(np.median(laps[1:] if len(laps) > 1 else laps))
        )

    return method
