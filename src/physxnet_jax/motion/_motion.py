"""Motion of the body: joint rotations, root position and frame rate."""

import dataclasses
from collections.abc import Iterator
from typing import Any

import jax
import numpy as np
from jaxtyping import Array, Float

from ..body import NUM_BODY_VERTICES, Body, linear_blend_skinning
from ..errors import MotionError
from ..geometry import slerp
from ..typing import pytree
from ._source import MAX_JOINT_FRAMES

# Frames per block: clips of any length share one compiled program.
_BLOCK = 32
# Frames that are normalised at once.
_PART = 4096
# A root farther from the origin than this indicates a damaged file [m].
_FARTHEST = 1e5
ROTATION_LENGTHS = (1e-6, 1e6)
"""A quaternion whose largest component is smaller or larger states no rotation."""


@pytree
@dataclasses.dataclass(frozen=True)
class Motion:
    """A clip of body motion.

    Attributes:
        rotations: Local joint rotations, wxyz, shape [frames, joints, 4].
        root: World position of the hips joint [m], shape [frames, 3].
        fps: Frame rate [1/s].
        name: Name of the clip.
    """

    rotations: Float[Array, "frames joints 4"]
    root: Float[Array, "frames 3"]
    fps: float = dataclasses.field(metadata={"static": True})
    name: str = dataclasses.field(default="motion", metadata={"static": True})

    @property
    def num_frames(self) -> int:
        """Number of frames."""
        return self.root.shape[0]

    def __getitem__(self, frames: slice) -> "Motion":
        """The motion of some frames; a step other than 1 changes the frame rate.

        Raises:
            MotionError: No frame is left, or the step isn't positive.

        Example:
            >>> still = make_motion(np.tile([1.0, 0, 0, 0], (60, 31, 1)), np.zeros((60, 3)), 30.0)
            >>> still[10:40].num_frames
            30
        """
        if not isinstance(frames, slice):
            raise MotionError(f"a motion is cut by a slice, as in motion[10:40], not [{frames!r}].")
        step = 1 if frames.step is None else int(frames.step)
        count = len(range(*frames.indices(self.num_frames)))
        if step < 1 or count == 0:
            raise MotionError(
                f"{self.name}: {frames.start}:{frames.stop}:{step} of {self.num_frames} frames"
                " leaves none in their order."
            )
        return Motion(self.rotations[frames], self.root[frames], self.fps / step, name=self.name)

    def moved(self, by: Float[np.ndarray, "3"]) -> "Motion":
        """The motion displaced [m]; the same if that is zero."""
        return dataclasses.replace(self, root=self.root + by[None]) if by.any() else self


def ground_point(motion: Motion) -> Float[np.ndarray, "3"]:
    """The point at height 0 below the first frame's hips [m].

    Far from the origin positions are coarse (1 mm at 10 km), so cloth is computed relative to this
    point: ``motion.moved(-ground_point(motion))``. Its height stays because a floor may have one.
    """
    x, _, z = np.asarray(motion.root[0])
    return np.asarray([x, 0.0, z] if np.isfinite([x, z]).all() else [0.0] * 3, np.float32)


def make_motion(rotations: Any, root: Any, fps: float | int, *, name: str = "motion") -> Motion:
    """A `Motion` from host arrays, checked and normalised.

    Args:
        rotations: Local quaternions, wxyz, shape [frames, joints, 4].
        root: Hips positions [m], shape [frames, 3].
        fps: Frames per second.
        name: Name used in errors and outputs.

    Raises:
        MotionError: Wrong shapes, no frames, a rate that isn't positive, a value that
            isn't finite, or a quaternion of almost no length or an enormous one. The message names
            the frame and joint.
    """
    # Checked before copying: an archive of kilobytes may hold gigabytes of zeros.
    shape, places = np.shape(rotations), np.shape(root)
    if len(shape) != 3 or shape[2] != 4 or places != (shape[0], 3) or shape[0] == 0:
        raise MotionError(
            f"{name}: rotations {shape} and root {places}, expected"
            " [frames, joints, 4] and [frames, 3] with at least one frame."
        )
    if not (np.isfinite(fps) and fps > 0):
        raise MotionError(f"{name}: fps is {fps}, expected a positive number.")
    if shape[0] * shape[1] > MAX_JOINT_FRAMES:
        raise MotionError(f"{name}: {shape[0]:,} frames of {shape[1]:,} joints. Cut the clip.")
    r, p = (np.asarray(x, dtype=np.float64) for x in (rotations, root))
    # Beyond this, float32 can't resolve millimetres.
    p = np.where(np.abs(p) < _FARTHEST, p, np.nan)
    bad = ~np.isfinite(r).all(axis=2)
    bad_root = ~np.isfinite(p).all(axis=1)
    if bad.any() or bad_root.any():
        frame, joint = (
            (int(x) for x in np.argwhere(bad)[0]) if bad.any() else (int(np.argmax(bad_root)), 0)
        )
        raise MotionError(
            f"{name}: frame {frame}, joint {joint} is not finite or over"
            " 100 km away. Cut the frame out or interpolate over it."
        )
    largest = np.maximum(r.max(axis=2, keepdims=True), -r.min(axis=2, keepdims=True))
    wrong = (largest < ROTATION_LENGTHS[0]) | (largest > ROTATION_LENGTHS[1])
    if wrong.any():
        frame, joint, _ = (int(x) for x in np.argwhere(wrong)[0])
        kind = "zero" if largest[frame, joint, 0] < 1.0 else "huge"
        raise MotionError(
            f"{name}: frame {frame}, joint {joint} has a {kind} quaternion; use"
            " (1, 0, 0, 0) for no rotation."
        )
    out = np.empty(r.shape, np.float32)
    # By parts, as copies of a long clip fill the memory.
    for at in range(0, len(r), _PART):
        part = r[at : at + _PART] / largest[at : at + _PART]
        out[at : at + _PART] = part / np.linalg.norm(part, axis=2, keepdims=True)
    return Motion(
        jax.device_put(out),
        jax.device_put(p.astype(np.float32)),
        float(fps),
        name,
    )


def sample(motion: Motion, times: Float[np.ndarray, " frames"], fps: float) -> Motion:
    """Samples a motion at given times, by spherical interpolation between its frames.

    Args:
        motion: A clip.
        times: Times from its first frame [s]; those outside take the nearest frame.
        fps: Frame rate of the result [1/s].

    Returns:
        One frame for each time.
    """
    at = np.clip(np.asarray(times) * motion.fps, 0.0, motion.num_frames - 1)
    low = np.minimum(np.floor(at + 1e-6), motion.num_frames - 1).astype(np.int32)
    high = np.minimum(low + 1, motion.num_frames - 1).astype(np.int32)
    t = np.clip(at - low, 0.0, 1.0)
    q, p = np.asarray(motion.rotations), np.asarray(motion.root)
    rotations = slerp(q[low], q[high], t[:, None, None])
    root = p[low] + t[:, None] * (p[high] - p[low])
    return make_motion(rotations, root, fps, name=motion.name)


def resample(motion: Motion, fps: float | int) -> Motion:
    """Resamples a motion to another frame rate.

    Args:
        motion: A clip.
        fps: New frame rate [1/s].

    Returns:
        The clip from its first frame to its last, or to just before it if the
        duration isn't a whole number of new frames.

    Raises:
        MotionError: ``fps`` isn't positive, or the result has too many frames.
    """
    if not (np.isfinite(fps) and fps > 0):
        raise MotionError(f"fps is {fps}, expected a positive number.")
    duration = (motion.num_frames - 1) / motion.fps
    wanted = duration * fps
    if wanted * motion.rotations.shape[1] > MAX_JOINT_FRAMES:
        raise MotionError(
            f"{duration:.0f} s at {fps:g} frames per second are too many frames. Pass the file's"
            " true rate (source_fps), or cut the clip."
        )
    frames = int(np.floor(wanted + 1e-6)) + 1
    return sample(motion, np.arange(frames) / fps, fps)


def body_animation(
    body: Body, motion: Motion, shape: Float[Array, " shapes"] | None = None
) -> Float[Array, "frames vertices 3"]:
    """Body vertices [m] of every frame, computed in blocks to bound memory."""
    return jax.device_put(np.concatenate(list(body_blocks(body, motion, shape))))


def body_blocks(
    body: Body, motion: Motion, shape: Float[Array, " shapes"] | None = None
) -> Iterator[Float[np.ndarray, "some vertices 3"]]:
    """Yields the frames of `body_animation` in blocks."""
    rest = body.rest_vertices(body.default_shape() if shape is None else shape)
    yield from animation_blocks(body, rest, rest[:NUM_BODY_VERTICES], _body_weights(body), motion)


def animate(
    body: Body,
    rest: Float[Array, "all 3"],
    vertices: Float[Array, "vertices 3"],
    weights: Float[Array, "vertices joints"],
    motion: Motion,
) -> Float[Array, "frames vertices 3"]:
    """Skins vertices in every frame of a clip.

    Clips of any length share one compiled block of frames.

    Args:
        body: The body.
        rest: Rest positions of all its vertices, from `Body.rest_vertices` [m].
        vertices: Rest positions of the vertices to skin [m].
        weights: Their skinning weights.
        motion: The clip.

    Returns:
        Positions [m] of every frame.
    """
    return jax.device_put(
        np.concatenate(list(animation_blocks(body, rest, vertices, weights, motion)))
    )


def animation_blocks(
    body: Body,
    rest: Float[Array, "all 3"],
    vertices: Float[Array, "vertices 3"],
    weights: Float[Array, "vertices joints"],
    motion: Motion,
) -> Iterator[Float[np.ndarray, "some vertices 3"]]:
    """Yields the frames of `animate` in blocks."""
    check_joints(body, motion)
    frames = motion.num_frames
    place = ground_point(motion)
    motion = motion.moved(-place)
    rotations, root = np.asarray(motion.rotations), np.asarray(motion.root)
    for start in range(0, frames, _BLOCK):
        rows = np.minimum(np.arange(start, start + _BLOCK), frames - 1)
        block = _animate_block(body, rest, vertices, weights, rotations[rows], root[rows])
        block = np.asarray(block)[: frames - start]
        yield block + place if place.any() else block


def check_joints(body: Body, motion: Motion) -> None:
    """Raises if a motion belongs to another skeleton.

    Raises:
        MotionError: The numbers of joints differ.
    """
    if motion.rotations.shape[1] != len(body.parents):
        raise MotionError(
            f"{motion.name}: {motion.rotations.shape[1]} joints, but the body has"
            f" {len(body.parents)}. Retarget the motion first."
        )


@jax.jit
def _animate_block(
    body: Body, rest: Array, vertices: Array, weights: Array, rotations: Array, root: Array
) -> Array:
    def one(q: Array, p: Array) -> Array:
        world, shift = body.transforms(rest, q, p)
        return linear_blend_skinning(vertices, weights, world, shift)

    return jax.vmap(one)(rotations, root)


def _body_weights(body: Body) -> Array:
    return body.weights[:NUM_BODY_VERTICES]
