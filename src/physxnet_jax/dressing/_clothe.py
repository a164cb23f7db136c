"""Pure functions from joint rotations to garment vertices."""

import dataclasses
import functools
from collections.abc import Iterator, Mapping, Sequence

import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jaxtyping import Array, Bool, Float

from .._environment import clear_caches_if_full
from .._programs import bounded_jit
from ..body import Body, skin_points
from ..errors import check_rate
from ..models import apply_sampled_offsets, normalise, point_features, predict_sampled
from ..motion import (
    BLOCK,
    ROTATION_LENGTHS,
    extrapolate_history,
    padded_block,
    pose_transforms,
)
from ..simulation.effects import TURBULENCE_PERIOD
from ..typing import pytree
from ._dresser import Dresser
from ._guided import GuidedState, advance_guided, init_guided, move_guided
from ._pipeline import bound, infer, limit, predict_cloth, resolve
from .postprocess import Cloth


@pytree
@dataclasses.dataclass(frozen=True, eq=False)
class Clothed(Mapping[str, Array]):
    """Garments in one pose or in several frames: a mapping from names to vertices.

    Attributes:
        vertices: Vertices of each garment by name [m], shape
            ``[*frames, vertices, 3]``.
        ok: Whether the result can be used. A pose that isn't finite, or a quaternion of almost
            no length or an enormous one, affects only the frames whose window contains it; their
            vertices are NaN. Gradients of a loss over the other frames are finite.
    """

    vertices: dict[str, Float[Array, "*frames vertices 3"]]
    ok: Bool[Array, "*frames"]

    # `Mapping` compares values, and comparing arrays gives no single truth value.
    __eq__ = object.__eq__
    __hash__ = object.__hash__  # pyright: ignore[reportAssignmentType]

    def __getitem__(self, name: str) -> Float[Array, "*frames vertices 3"]:
        """Vertices of a garment [m]."""
        return self.vertices[name]

    def __iter__(self) -> Iterator[str]:
        """Names of the garments."""
        return iter(self.vertices)

    def __len__(self) -> int:
        """Number of garments."""
        return len(self.vertices)


@pytree
@dataclasses.dataclass(frozen=True, kw_only=True)
class Stream:
    """The state between two frames of a stream.

    Attributes:
        points: Skinned texel points of the last `Dresser.history_length` frames [m],
            oldest first, shape [history, texels, 3]; None for skinning alone.
        place: Point near the person, relative to which all else is [m].
        rotations: The last usable pose, as in `Motion`.
        root: Its root [m].
        usable: Which of those frames had a usable pose, shape [history].
        guided: Simulated cloth of the last frame; None if it isn't simulated.
    """

    points: Float[Array, "history texels 3"] | None
    place: Float[Array, "3"]
    rotations: Float[Array, "joints 4"]
    root: Float[Array, "3"]
    usable: Bool[Array, " history"]
    guided: GuidedState | None = None


# A person who has moved so far along an axis from `Stream.place` has another one [m].
_FAR = 0.75 * TURBULENCE_PERIOD


def _make_clothed(
    dresser: Dresser,
    cloth: tuple[Array, ...],
    usable: Bool[Array, "*frames"],
    place: Float[Array, "3"],
) -> Clothed:
    """The result from positions relative to a place, and from which frames saw usable poses."""
    finite = [jnp.all(jnp.isfinite(x), axis=(-2, -1)) for x in cloth]
    ok = functools.reduce(jnp.logical_and, finite, usable)
    names = (w.name for w in dresser.worn)
    shown = (
        jnp.where(ok[..., None, None], x + jnp.broadcast_to(place, x.shape), jnp.nan) for x in cloth
    )
    return Clothed(dict(zip(names, shown, strict=True)), ok)


def _is_usable(
    rotations: Float[Array, "*frames joints 4"], root: Float[Array, "*frames 3"]
) -> Bool[Array, "*frames"]:
    """Which poses are finite and have quaternions that state a rotation."""
    largest = jnp.max(jnp.abs(rotations), axis=-1)
    low, high = ROTATION_LENGTHS
    turned = jnp.all((largest >= low) & (largest <= high), axis=-1)
    return turned & jnp.all(jnp.isfinite(root), axis=-1)


def _hold(
    rotations: Float[Array, "frames joints 4"], root: Float[Array, "frames 3"]
) -> tuple[Array, Array, Bool[Array, " frames"]]:
    """Poses of which those that can't be used are replaced by the last one that can.

    NaN must not enter the computation: its gradient would be NaN in all frames, whatever the loss.
    """
    usable = _is_usable(rotations, root)
    index = jnp.where(usable, jnp.arange(rotations.shape[0]), -1)
    index = jax.lax.cummax(index)
    # Before the first usable pose: that one.
    index = jnp.where(index < 0, jnp.argmax(usable), index)
    none = ~jnp.any(usable)
    still = jnp.zeros((4,), rotations.dtype).at[0].set(1.0)
    rotations = jnp.where(none, still[None, None], rotations[index])
    return rotations, jnp.where(none, 0.0, root[index]), usable


def _on_ground(root: Float[Array, "3"]) -> Float[Array, "3"]:
    """The point at height 0 below the hips, see `ground_point`."""
    return jax.lax.stop_gradient(root * jnp.asarray([1.0, 0.0, 1.0], root.dtype))


def _check_pose(body: Body, rotations: Array, root: Array, axes: tuple[str, ...]) -> None:
    """Checks shapes only, which works under `jax.jit`."""
    batch = rotations.shape[: len(axes)]
    wanted = (*batch, len(body.parents), 4), (*batch, 3)
    got = rotations.shape, root.shape
    if got != wanted or rotations.ndim != len(axes) + 2:
        names = ", ".join((*axes, "joints", "4"))
        raise ValueError(
            f"rotations [{names}] have shape {got[0]} and root {got[1]}; the body has"
            f" {len(body.parents)} joints, so {wanted[0]} and {wanted[1]} are expected. Retarget a"
            " motion of another skeleton (load_motion), or add the frame axis."
        )


def clothe(
    dresser: Dresser,
    rotations: Float[Array, "frames joints 4"],
    root: Float[Array, "frames 3"],
    fps: float,
) -> Clothed:
    """Computes garments in successive frames; pure, for `jax.jit`, `jax.vmap`, `jax.grad`.

    Poses before frame 0 are extrapolated, see `extrapolate_history`.

    Outside of such transformations the clip is computed in blocks of 16 frames, so that
    clips of any lengths share a few compiled programs. Within your own `jax.jit` each length is a
    program: pass what `pad_frames` makes, and cut the result.

    Args:
        dresser: From `make_dresser`.
        rotations: Joint rotations relative to their parents, unit quaternions wxyz, as in
            `Motion`.
        root: Position of the root joint [m].
        fps: Frames per second; static under `jax.jit`.

    Returns:
        Vertices of each garment, and which frames are finite.

    Raises:
        ValueError: The clip has no frames, or its skeleton isn't the body's.
        PhysXNetError: ``fps`` isn't a positive number.

    Example:
        >>> from physxnet_jax.dressing import make_dresser
        >>> from physxnet_jax.motion import load_motion
        >>> motion = load_motion("walk", fps=30)
        >>> cloth = jax.jit(clothe, static_argnames="fps")(
        ...     make_dresser(["bottom"]), motion.rotations[:2], motion.root[:2], fps=30.0
        ... )
        >>> cloth["bottom"].shape
        (2, 2726, 3)
    """
    rotations, root = jnp.asarray(rotations), jnp.asarray(root)
    _check_pose(dresser.body, rotations, root, ("frames",))
    check_rate(fps)
    if rotations.shape[0] == 0:
        raise ValueError("the clip has no frames; clothe needs at least one.")
    if any(isinstance(x, Tracer) for x in jax.tree.leaves((dresser, rotations, root))):
        return _clothe(dresser, rotations, root, fps)
    return _clothe_blocks(dresser, rotations, root, fps)


def pad_frames(
    rotations: Float[Array, "frames joints 4"], root: Float[Array, "frames 3"]
) -> tuple[Float[Array, "padded joints 4"], Float[Array, "padded 3"]]:
    """Repeats the last pose of a clip up to one of a few lengths: 1, 2, 4, 8, 16, 24, 32, 48, ...

    Frames of `clothe` don't depend on later ones: cut its result to the clip's length.

    Args:
        rotations: Joint rotations.
        root: Positions of the root joint [m].

    Example:
        >>> still = jnp.zeros((37, 31, 4)), jnp.zeros((37, 3))
        >>> [x.shape[0] for x in pad_frames(*still)]
        [48, 48]
    """
    return _padded(rotations, root, _padded_length(rotations.shape[0]))


def _padded(rotations: Array, root: Array, length: int) -> tuple[Array, Array]:
    frames = rotations.shape[0]
    if length == frames:
        return rotations, root
    # On the host: another length would be another program here too.
    index = np.minimum(np.arange(length), frames - 1)
    q, p = (jax.device_put(np.asarray(x)[index]) for x in (rotations, root))
    return q, p


def _padded_length(frames: int) -> int:
    whole = 1 << max(frames - 1, 0).bit_length()
    less = 3 * whole // 4
    return less if whole > 16 and less >= frames else whole


def _clothe(
    dresser: Dresser,
    rotations: Float[Array, "frames joints 4"],
    root: Float[Array, "frames 3"],
    fps: float,
) -> Clothed:
    past = dresser.history_length(fps)
    rotations, root, well, place = _placed(rotations, root, past, dresser.seen(fps))
    history = extrapolate_history(rotations, root, past, fps)
    joints = (jnp.concatenate(pair) for pair in zip(history, (rotations, root), strict=True))
    r, t = jax.vmap(lambda q, p: dresser.body.transforms(dresser.rest, q, p))(*joints)
    return _make_clothed(dresser, infer(dresser, r, t, fps)[1], well, place)


def _placed(
    rotations: Float[Array, "frames joints 4"],
    root: Float[Array, "frames 3"],
    past: int,
    seen: tuple[int, ...],
) -> tuple[Array, Array, Bool[Array, " frames"], Float[Array, "3"]]:
    """Usable poses relative to a place near them, which frames saw no other, and the place [m].

    Args:
        rotations: Joint rotations.
        root: Positions of the root joint [m].
        past: Number of poses before the first frame, which are usable.
        seen: How many frames back the poses lie that a frame depends on.
    """
    rotations, root, usable = _hold(rotations, root)
    place = _on_ground(root[0])
    usable = jnp.concatenate([jnp.ones((past,), bool), usable])
    shifted = (usable[past - k : usable.shape[0] - k] for k in seen)
    return rotations, root - place[None], functools.reduce(jnp.logical_and, shifted), place


_placed_jitted = bounded_jit(static_argnames=("past", "seen"), keep=8)(_placed)


def _clothe_blocks(
    dresser: Dresser,
    rotations: Float[Array, "frames joints 4"],
    root: Float[Array, "frames 3"],
    fps: float,
) -> Clothed:
    """`_clothe` in blocks of one or `BLOCK` frames."""
    clear_caches_if_full()
    frames, past = rotations.shape[0], dresser.history_length(fps)
    length = 1 if frames == 1 else BLOCK
    # So little is computed for each of these frames that short clips share a length.
    padded = _padded(rotations, root, max(64, _padded_length(frames)))
    *posed, place = _placed_jitted(*padded, past, dresser.seen(fps))
    # On the host: each cut would be a program too.
    q, p, well = (np.asarray(x)[:frames] for x in posed)
    before = extrapolate_history(*(jax.device_put(x[:2]) for x in (q, p)), past, fps)
    q, p = (np.concatenate([np.asarray(a), b]) for a, b in zip(before, (q, p), strict=True))
    r, t = pose_transforms(dresser.body, dresser.rest, q, p)
    state = None
    if dresser.guided is not None:
        state = _init_guided(dresser.guided, *(jax.device_put(x[past - 1]) for x in (r, t)))
    blocks = []
    for start in range(0, frames, length):
        a, b = (jax.device_put(padded_block(x, start + past, past, length)) for x in (r, t))
        fine = jax.device_put(padded_block(well, start, 0, length))
        block, state = _clothe_block(dresser, a, b, fine, place, fps, state)
        blocks.append(block)
    return jax.tree.map(lambda *parts: _joined(parts, frames), *blocks)


_init_guided = bounded_jit(keep=4)(init_guided)


@bounded_jit(static_argnames=("fps",), keep=4)
def _clothe_block(
    dresser: Dresser,
    rotations: Float[Array, "padded joints 3 3"],
    translations: Float[Array, "padded joints 3"],
    well: Bool[Array, " frames"],
    place: Float[Array, "3"],
    fps: float,
    state: GuidedState | None,
) -> tuple[Clothed, GuidedState | None]:
    _, cloth, state = infer(dresser, rotations, translations, fps, state)
    return _make_clothed(dresser, cloth, well, place), state


def _joined(blocks: Sequence[Array], frames: int) -> Array:
    """The first frames of all; on the host where that costs little, for the reason above."""
    (device, *others) = blocks[0].devices()
    if not others and device.platform == "cpu":
        whole = np.concatenate([np.asarray(x) for x in blocks])
        return jax.device_put(whole[:frames], device)
    return jnp.concatenate(blocks)[:frames]


def init_stream(
    dresser: Dresser,
    rotations: Float[Array, "joints 4"] | Float[Array, "frames joints 4"],
    root: Float[Array, "3"] | Float[Array, "frames 3"],
    fps: float = 30.0,
) -> Stream:
    """Makes the state before the first frame of `clothe_step`.

    Args:
        dresser: From `make_dresser`.
        rotations: Joint rotations of the first frame, which assumes a static pose before
            it; or of the first frames (two are enough), whose motion is extrapolated
            backwards as in `clothe`.
        root: Position of the root joint [m] in the same frames.
        fps: Frames per second of the stream; static under `jax.jit`.

    Returns:
        The stream before the first frame.

    Raises:
        ValueError: The skeleton isn't the body's, or there is no pose.
    """
    check_rate(fps)
    rotations, root = jnp.asarray(rotations), jnp.asarray(root)
    if rotations.ndim == 2:
        rotations, root = rotations[None], root[None]
    _check_pose(dresser.body, rotations, root, ("frames",))
    if not rotations.shape[0]:
        raise ValueError("no pose: pass the first one or two.")
    rotations, root, usable = _hold(rotations, root)
    place = _on_ground(root[0])
    root = root - place[None]
    length = dresser.history_length(fps)
    stream = Stream(
        points=None,
        place=place,
        rotations=rotations[0],
        root=root[0],
        # The poses before follow from these.
        usable=jnp.broadcast_to(jnp.all(usable), (length,)),
    )
    if dresser.predictor is None:
        return stream
    texels = dresser.predictor.texel_points
    history = extrapolate_history(rotations, root, length, fps)
    r, t = jax.vmap(lambda q, p: dresser.body.transforms(dresser.rest, q, p))(*history)
    points = jax.vmap(lambda a, b: skin_points(texels.rest, texels.weights, a, b)[0])(r, t)
    scene = dresser.guided
    guided = None if scene is None else init_guided(scene, r[-1], t[-1])
    stream = dataclasses.replace(stream, points=points, guided=guided)
    # Each part in a buffer of its own: `clothe_step` may be given all of them.
    return jax.tree.map(jnp.copy, stream)


def clothe_step(
    dresser: Dresser,
    stream: Stream,
    rotations: Float[Array, "joints 4"],
    root: Float[Array, "3"],
    fps: float,
) -> tuple[Stream, Clothed]:
    """Computes the garments of the next frame; equivalent to `clothe` of the whole clip.

    Each pose is skinned once, whatever the window length. Under `jax.jit` make ``fps``
    static and donate ``stream``.

    Args:
        dresser: From `make_dresser`.
        stream: From `init_stream` or the previous frame.
        rotations: Joint rotations of this frame.
        root: Position of the root joint [m].
        fps: Frames per second.

    Returns:
        The stream for the next frame, and the garments of this one.

    Raises:
        ValueError: The skeleton isn't the body's, or the stream was made for another frame rate.

    Example:
        >>> step = jax.jit(clothe_step, static_argnames="fps", donate_argnames="stream")
    """
    check_rate(fps)
    rotations, root = jnp.asarray(rotations), jnp.asarray(root)
    _check_pose(dresser.body, rotations, root, ())
    usable = _is_usable(rotations, root)
    rotations = jnp.where(usable, rotations, stream.rotations)
    stream, root = _follow(stream, jnp.where(usable, root - stream.place, stream.root))
    r, t = dresser.body.transforms(dresser.rest, rotations, root)
    stream, cloth = _predict_step(dresser, stream, r, t, fps)
    past = jnp.concatenate([stream.usable, usable[None]])
    well = functools.reduce(jnp.logical_and, (past[-1 - k] for k in dresser.seen(fps)))
    stream = dataclasses.replace(stream, rotations=rotations, root=root, usable=past[1:])
    if dresser.guided is not None and stream.guided is not None:
        one = tuple(x[0] for x in cloth)
        guided, one = advance_guided(dresser.guided, dresser.worn, stream.guided, one, r, t, fps)
        stream = dataclasses.replace(stream, guided=guided)
    else:
        cloth = limit(dresser, cloth, r[None], t[None])
        cloth = resolve(dresser, cloth, r[None], t[None])
        one = tuple(x[0] for x in cloth)
    whole = dresser.expand(tuple(x[None] for x in one), r[None], t[None])
    one = tuple(x[0] for x in whole)
    return stream, _make_clothed(dresser, one, well, stream.place)


def _follow(stream: Stream, root: Float[Array, "3"]) -> tuple[Stream, Float[Array, "3"]]:
    """Moves the stream's place below a person who has gone far from it."""
    ahead = _on_ground(root)
    # By whole periods, in which the wind is the same.
    steps = TURBULENCE_PERIOD * jnp.round(ahead / TURBULENCE_PERIOD)
    ahead = jnp.where(jnp.abs(ahead) > _FAR, steps, 0.0)
    guided = stream.guided
    moved = dataclasses.replace(
        stream,
        place=stream.place + ahead,
        points=None if stream.points is None else stream.points - ahead[None, None],
        guided=None if guided is None else move_guided(guided, -ahead),
    )
    return moved, root - ahead


def _predict_step(
    dresser: Dresser,
    stream: Stream,
    rotations: Float[Array, "joints 3 3"],
    translations: Float[Array, "joints 3"],
    fps: float,
) -> tuple[Stream, Cloth]:
    """`predict_cloth` for one frame, from the texel points of the previous frames."""
    predictor = dresser.predictor
    if predictor is None or stream.points is None:
        return stream, predict_cloth(dresser, rotations[None], translations[None], fps)
    texels, inputs = predictor.texel_points, predictor.config.inputs
    if stream.points.shape[0] != dresser.history_length(fps):
        raise ValueError(
            f"the stream keeps {stream.points.shape[0]} frames, but at {fps:g} frames per second"
            f" {dresser.history_length(fps)} are needed: pass fps to init_stream too."
        )
    points, blend = skin_points(texels.rest, texels.weights, rotations, translations)
    window = jnp.concatenate([stream.points, points[None]])
    features = point_features(window, blend[None], fps, inputs)
    features = normalise(features, predictor.normalisation, inputs)
    worn, family = bound(dresser), predictor.config.family
    sampled = predict_sampled(predictor, worn, features)
    cloth = (
        apply_sampled_offsets(w, rotations, translations, offsets[0], family)[None]
        for w, offsets in zip(worn, sampled, strict=True)
    )
    return dataclasses.replace(stream, points=window[1:]), tuple(cloth)
