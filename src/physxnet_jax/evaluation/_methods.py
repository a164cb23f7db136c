"""Ways to get cloth from motion, all asked in one way: the network and what it must beat."""

import dataclasses
import functools
import time
from collections.abc import Callable
from typing import Any, Protocol, runtime_checkable

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ..body import load_body
from ..garment import Template, template
from ..geometry import polar_rotation
from ..models import (
    Predictor,
    Wearable,
    dress_frames,
    fold_batch_norm,
    make_wearable,
    skin_points,
)
from ..motion import BLOCK, Motion, clip_transforms, padded_block
from ..simulation import (
    ACCURACY,
    PreparedScene,
    Rollout,
    Scene,
    prepare_scene,
    simulate_batch,
)
from ..simulation.blender import simulate_blender
from ..simulation.newton import simulate_newton
from ..uv import bind

# Cloth of other makers, out of process.
ENGINES: dict[str, Callable[..., Rollout]] = {
    "blender": simulate_blender,
    "newton": simulate_newton,
}
# Displacement of the body's root that shows how far simulations part [m].
NOISE = 1e-6


@dataclasses.dataclass(frozen=True)
class Answer:
    """What a method says, and what it took.

    Attributes:
        positions: Cloth [m], shape [frames, vertices, 3].
        ms_per_frame: Median after the first block, from joint rotations to vertices.
    """

    positions: Float[np.ndarray, "frames vertices 3"]
    ms_per_frame: float


@runtime_checkable
class Method(Protocol):
    """A way to get a template's cloth from a motion."""

    def __call__(self, motion: Motion, name: Template) -> Answer:
        """The template's cloth in every frame."""
        ...


@dataclasses.dataclass
class Blockwise:
    """A method that is a pure function of the joints of some frames.

    Attributes:
        block: From a garment, world rotations and translations of joints with ``lead``
            frames before the first wanted, and frames a second, to cloth.
        wear: The garment as ``block`` takes it, by the name of its template.
        lead: Frames before the first that are seen.
    """

    block: Callable[[Any, Array, Array, float], Array]
    wear: Callable[[Template], Any]
    lead: int = 0

    def __call__(self, motion: Motion, name: Template) -> Answer:
        """The template's cloth in every frame."""
        body = load_body()
        rest = body.rest_vertices(body.default_shape())
        world, shift = clip_transforms(body, rest, motion)
        worn = self.wear(name)
        blocks, times = [], []
        # The first block is asked twice: compilation is no part of the time.
        for start in (0, *range(0, len(world), BLOCK)):
            began = time.perf_counter()
            r, t = (padded_block(x, start, self.lead) for x in (world, shift))
            out = self.block(worn, jnp.asarray(r), jnp.asarray(t), motion.fps)
            blocks.append(np.asarray(out))
            times.append(1e3 * (time.perf_counter() - began) / BLOCK)
        cloth = np.concatenate(blocks[1:])[: len(world)]
        return Answer(cloth, float(np.median(times[1:])))


def skinning() -> Blockwise:
    """Linear blend skinning: the baseline of the paper."""
    return Blockwise(_skin, rest_and_skin)


def rest_and_skin(name: Template) -> tuple[Array, Array]:
    """A template's vertices at rest [m] and their skinning weights."""
    body = load_body()
    garment = template(name)
    return garment.rest_vertices(body.rest_vertices(body.default_shape())), garment.skin


@functools.partial(jax.jit, static_argnames=("fps",))
def _skin(worn: tuple[Array, Array], r: Array, t: Array, fps: float) -> Array:
    return jax.vmap(lambda a, b: skin_points(*worn, a, b)[0])(r, t)


def place_local(
    worn: tuple[Array, Array],
    rotations: Float[Array, "frames joints 3 3"],
    translations: Float[Array, "frames joints 3"],
    offsets: Float[Array, "frames vertices 3"],
) -> Float[Array, "frames vertices 3"]:
    """Skinned vertices [m] with offsets [m] added, each in its vertex's own frame."""

    def one(r: Array, t: Array, o: Array) -> Array:
        points, blend = skin_points(*worn, r, t)
        return points + jnp.einsum(
            "vab,vb->va", polar_rotation(blend), o, precision=jax.lax.Precision.HIGHEST
        )

    return jax.vmap(one)(rotations, translations, offsets)


def network(predictor: Predictor) -> Blockwise:
    """A trained network, without push-out."""
    body = load_body()
    rest = body.rest_vertices(body.default_shape())
    predictor = fold_batch_norm(predictor)

    @functools.cache
    def wear(name: Template) -> Wearable:
        garment = template(name)
        binding = bind(predictor.atlas, body, rest, garment, predictor.surface.valid[name])
        return make_wearable(body, rest, garment, binding)

    lead = predictor.config.inputs.window - 1
    return Blockwise(_network, lambda name: (predictor, wear(name)), lead)


@functools.partial(jax.jit, static_argnames=("fps",))
def _network(worn: tuple[Predictor, Wearable], r: Array, t: Array, fps: float) -> Array:
    return dress_frames(worn[0], [worn[1]], r, t, fps)[0]


class Simulator:
    """Our simulator at one of its accuracies, or once more from almost the same start.

    Args:
        accuracy: ``draft``, ``standard`` or ``fine``.
        moved: The root is moved by normal noise of this size [m]: how far two runs part
            that should be one is the least error that means anything.
    """

    def __init__(self, accuracy: str, moved: float = 0.0) -> None:
        self._solver, self._moved = ACCURACY[accuracy], moved
        self._scenes: dict[Template, PreparedScene] = {}

    def __call__(self, motion: Motion, name: Template) -> Answer:
        """The template's cloth in every frame."""
        if name not in self._scenes:
            self._scenes[name] = prepare_scene(Scene((template(name),)))
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
        return Answer(rollout.positions[0], float(np.median(laps[1:] if len(laps) > 1 else laps)))


def engine(name: str) -> Method:
    """Another maker's cloth as a method: ``blender`` or ``newton``.

    It is another model of cloth: how far it is from our simulator is no error of it.
    """
    run = ENGINES[name]

    def method(motion: Motion, name: Template) -> Answer:
        rollout = run(Scene((template(name),)), motion)
        # The first frame loads and settles.
        laps = rollout.diagnostics["milliseconds"]
        return Answer(rollout.positions[0], float(np.median(laps[1:] if len(laps) > 1 else laps)))

    return method
