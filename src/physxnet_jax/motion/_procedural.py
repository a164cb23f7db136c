"""Built-in clips made of a few sine curves, so that the package needs no motion file.

Angles are local rotations [rad] relative to a standing pose with hanging arms, about
the world axes of that pose: +X leans forward and bends knees, -X lifts thighs and
forearms, +Z lifts the left arm sideways, +Y turns to the left.
"""

from collections.abc import Callable, Mapping

import jax
import numpy as np
from jaxtyping import Array, Float
from scipy.interpolate import CubicSpline
from scipy.ndimage import gaussian_filter1d
from scipy.spatial.transform import Rotation

from ..body import Body, align_global, load_body
from ..errors import MotionError
from ._motion import Motion, animate, make_motion
from ._retarget import foot_heights, stand_on_floor
from ._source import MAX_JOINT_FRAMES

_X, _Y, _Z = np.eye(3)
_TAU = 2 * np.pi
# Smoothing widths of the hips' horizontal and vertical path [s]: without smoothing, a change of
# the standing foot would accelerate the hips by several g.
_SIGMA_XZ, _SIGMA_Y = 0.08, 0.03
# Rate at which steps are integrated [1/s].
_STEP_RATE = 120.0
Time = Float[np.ndarray, " frames"]
Turns = Mapping[str, Float[np.ndarray, "frames 3"]]


def _about(axis: np.ndarray, angle: np.ndarray) -> np.ndarray:
    return np.asarray(angle)[:, None] * axis[None]


def _ease(t: Time, start: float, end: float) -> Time:
    """A smooth step from 0 to 1, at rest at both ends."""
    s = np.clip((t - start) / (end - start), 0.0, 1.0)
    return s * s * s * (10 - 15 * s + 6 * s * s)


def _pulse(t: Time, start: float, length: float) -> Time:
    """A smooth bump of height 1."""
    return _ease(t, start, start + length / 2) - _ease(t, start + length / 2, start + length)


def _pair(left: np.ndarray, right: np.ndarray, joint: str) -> dict[str, np.ndarray]:
    return {f"Left{joint}": left, f"Right{joint}": right}


def _walk(t: Time) -> tuple[Turns, Time]:
    phase = _TAU * t / 1.1
    stride, other = np.sin(phase), np.sin(phase + np.pi)
    thigh = [0.38 * swing + 0.14 for swing in (stride, other)]
    # A knee bends before its thigh swings forward; else the rear foot would stay planted.
    knee = [0.15 + 0.9 * np.maximum(np.cos(phase + k), 0.0) ** 2 for k in (0.5, 0.5 + np.pi)]
    # Soles stay level within the range of the ankles.
    foot = [0.3 * np.tanh((up - bent) / 0.3) for up, bent in zip(thigh, knee, strict=True)]
    turns = {
        **_pair(_about(-_X, thigh[0]), _about(-_X, thigh[1]), "UpLeg"),
        **_pair(_about(_X, knee[0]), _about(_X, knee[1]), "Leg"),
        **_pair(_about(_X, foot[0]), _about(_X, foot[1]), "Foot"),
        **_pair(_about(-_X, 0.45 * other), _about(-_X, 0.45 * stride), "Arm"),
        **_pair(_about(-_X, 0.35 + 0.2 * other), _about(-_X, 0.35 + 0.2 * stride), "ForeArm"),
        "Spine": _about(_Y, -0.08 * stride),
        "Hips": _about(_Y, 0.08 * stride),
    }
    return turns, np.zeros_like(t)


def _jump(t: Time) -> tuple[Turns, Time]:
    u = np.mod(t, 2.0)
    crouch = _pulse(u, 0.2, 0.7) + 0.8 * _pulse(u, 1.05, 0.6)
    flight = np.clip((u - 0.75) / 0.5, 0.0, 1.0)
    air = 9.81 / 2 * 0.5**2 * flight * (1 - flight)
    reach = _ease(u, 0.5, 0.85) - _ease(u, 1.0, 1.4)
    thigh, knee = _about(-_X, 0.9 * crouch), _about(_X, 1.5 * crouch)
    arm = _about(-_X, 2.4 * reach - 0.6 * crouch)
    turns = {
        **_pair(thigh, thigh, "UpLeg"),
        **_pair(knee, knee, "Leg"),
        **_pair(_about(-_X, 0.6 * crouch), _about(-_X, 0.6 * crouch), "Foot"),
        **_pair(arm, arm, "Arm"),
        "LowerBack": _about(_X, 0.35 * crouch),
    }
    return turns, air


def _punch(t: Time) -> tuple[Turns, Time]:
    u = np.mod(t, 1.6)
    left, right = _pulse(u, 0.1, 0.5), _pulse(u, 0.9, 0.5)
    guard = np.ones_like(t) * _ease(t, -0.4, 0.1)

    def arm(hit: Time) -> tuple[np.ndarray, np.ndarray]:
        return (
            _about(-_X, 0.5 * guard + 1.0 * hit),
            _about(-_X, 2.0 * guard - 1.9 * hit),
        )

    (la, lf), (ra, rf) = arm(left), arm(right)
    turns = {
        **_pair(la, ra, "Arm"),
        **_pair(lf, rf, "ForeArm"),
        "Spine": _about(_Y, 0.45 * (right - left)),
        "LowerBack": _about(_X, 0.1 * guard),
        **_pair(_about(-_X, 0.25 * guard), _about(_X, 0.2 * guard), "UpLeg"),
        **_pair(_about(_X, 0.3 * guard), _about(_X, 0.25 * guard), "Leg"),
        **_pair(_about(-_X, 0.05 * guard), _about(-_X, 0.45 * guard), "Foot"),
    }
    return turns, np.zeros_like(t)


def _turn(t: Time) -> tuple[Turns, Time]:
    def heading(t: Time) -> Time:
        return 0.5 * np.pi * (_ease(t, 0.3, 1.3) - 2 * _ease(t, 1.7, 3.1) + _ease(t, 3.3, 4.0))

    yaw, h = heading(t), 1.0 / _STEP_RATE
    lead = (heading(t + h) - heading(t - h)) / (2 * h) * 0.06
    step = 0.25 * np.abs(np.sin(2 * yaw))
    turns = {
        "Hips": _about(_Y, yaw),
        "Spine": _about(_Y, lead),
        "Neck": _about(_Y, 2 * lead),
        **_pair(_about(-_X, step), _about(-_X, 0.2 * step), "UpLeg"),
        **_pair(_about(_X, 2 * step), _about(_X, 0.4 * step), "Leg"),
        **_pair(_about(_Z, 3 * np.abs(lead)), _about(-_Z, 3 * np.abs(lead)), "Arm"),
    }
    return turns, np.zeros_like(t)


def _side_step(t: Time) -> tuple[Turns, Time]:
    phase = _TAU * t / 1.2
    spread = 0.3 * (1 - np.cos(phase)) / 2
    lift = [0.35 * np.maximum(np.sin(phase + k), 0.0) for k in (0.0, np.pi)]
    turns = {
        **_pair(
            _about(_Z, spread) + _about(-_X, lift[0]),
            _about(-_Z, spread) + _about(-_X, lift[1]),
            "UpLeg",
        ),
        **_pair(_about(_X, 2 * lift[0]), _about(_X, 2 * lift[1]), "Leg"),
        **_pair(_about(-_Z, spread), _about(_Z, spread), "Foot"),
        **_pair(_about(_Z, 0.25 + spread), _about(-_Z, 0.25 + spread), "Arm"),
        **_pair(_about(-_X, 0.4 + 0 * t), _about(-_X, 0.4 + 0 * t), "ForeArm"),
    }
    return turns, np.zeros_like(t)


def _balance(t: Time) -> tuple[Turns, Time]:
    up = _ease(t, 0.3, 1.3) - _ease(t, 3.0, 3.9)
    sway = 0.05 * np.sin(_TAU * t / 1.3) * up
    turns = {
        **_pair(_about(_Z, 1.35 * up + sway), _about(-_Z, 1.35 * up - sway), "Arm"),
        **_pair(_about(-_X, 1.1 * up), _about(-_X, 0.1 * up), "UpLeg"),
        **_pair(_about(_X, 1.4 * up), _about(_X, 0.2 * up), "Leg"),
        "RightFoot": _about(-_X, 0.1 * up),
        "LowerBack": _about(_Z, sway),
        "Hips": _about(_Z, -sway),
    }
    return turns, np.zeros_like(t)


def _stretch(t: Time) -> tuple[Turns, Time]:
    high = _ease(t, 0.2, 1.2) - _ease(t, 3.0, 3.9)
    bend = 0.45 * np.sin(_TAU * (t - 1.2) / 1.8) * (_ease(t, 1.2, 1.5) - _ease(t, 2.7, 3.0))
    turns = {
        **_pair(_about(_Z, 2.6 * high), _about(-_Z, 2.6 * high), "Arm"),
        "LowerBack": _about(_Z, 0.5 * bend),
        "Spine": _about(_Z, 0.5 * bend),
        "Spine1": _about(_X, -0.12 * high),
    }
    return turns, np.zeros_like(t)


def _spin(t: Time) -> tuple[Turns, Time]:
    yaw = _TAU * 2 * _ease(t, 0.4, 2.9)
    out = _ease(t, 0.1, 0.8) - _ease(t, 2.6, 3.4)
    turns = {
        "Hips": _about(_Y, yaw),
        **_pair(_about(_Z, 1.0 * out), _about(-_Z, 1.0 * out), "Arm"),
        **_pair(_about(-_X, 0.3 * out), _about(-_X, 0.3 * out), "ForeArm"),
        "LeftUpLeg": _about(-_X, 0.35 * out),
        "LeftLeg": _about(_X, 0.9 * out),
    }
    return turns, np.zeros_like(t)


def _squat(t: Time) -> tuple[Turns, Time]:
    down = _ease(np.mod(t, 2.6), 0.1, 0.9) - _ease(np.mod(t, 2.6), 1.5, 2.3)
    thigh, knee = _about(-_X, 1.45 * down), _about(_X, 1.8 * down)
    foot, arm = _about(-_X, 0.45 * down), _about(-_X, 1.3 * down)
    turns = {
        **_pair(thigh, thigh, "UpLeg"),
        **_pair(knee, knee, "Leg"),
        **_pair(foot, foot, "Foot"),
        **_pair(arm, arm, "Arm"),
        "LowerBack": _about(_X, 0.5 * down),
    }
    return turns, np.zeros_like(t)


CLIPS: dict[str, Callable[[Time], tuple[Turns, Time]]] = {
    "walk": _walk,
    "jump": _jump,
    "punch": _punch,
    "turn": _turn,
    "side step": _side_step,
    "balance": _balance,
    "stretch": _stretch,
    "spin": _spin,
    "squat": _squat,
}
"""Built-in clips: joint rotations and height of the feet above the floor [m] over time."""


def procedural_clip(
    name: str,
    *,
    fps: float = 30.0,
    seconds: float = 4.0,
    body: Body | None = None,
    shape: Float[Array, " shapes"] | None = None,
) -> Motion:
    """Computes a built-in clip on the body's skeleton.

    The lower foot stays in place on the floor, and the hips move relative to it. Their path
    is smoothed over changes of the standing foot.

    Args:
        name: One of ``CLIPS``.
        fps: Frames per second.
        seconds: Duration [s]; four seconds show every clip once.
        body: Body to drive; the built-in one by default.
        shape: Its shape parameters.

    Returns:
        The motion.

    Raises:
        MotionError: An unknown name, or too many frames.
    """
    if name not in CLIPS:
        raise MotionError(f"No built-in clip '{name}'; there are {', '.join(CLIPS)}.")
    body = load_body() if body is None else body
    count = max(1, round(seconds * fps))
    lead = int(np.ceil(4 * _SIGMA_XZ * _STEP_RATE))  # margin of the smoothing at both ends
    last = lead + int(np.ceil((count - 1) / fps * _STEP_RATE))
    often = max(1, int(np.ceil(_STEP_RATE / fps)))
    if max(last + 2 * lead, often * count) * len(body.parents) > MAX_JOINT_FRAMES:
        raise MotionError(
            f"{seconds:g} s at {fps:g} frames per second are too many frames. Request a shorter"
            " clip or a lower rate."
        )
    # Steps are integrated at one rate, so that clips cover the same ground at every fps.
    t = np.arange(-lead, last + 1 + lead) / _STEP_RATE
    turns, air = CLIPS[name](t)
    still = np.zeros((len(t), 3))
    stepping = make_motion(_local_rotations(body, shape, turns), still, _STEP_RATE, name=name)
    path = CubicSpline(t, _planted_root(body, stepping, air, shape))
    fine = np.arange(-1, often * count + 1) / (often * fps)
    local = _local_rotations(body, shape, CLIPS[name](fine)[0])[1:-1:often]
    root = path(fine[1:-1:often])
    root[:, [0, 2]] -= root[0, [0, 2]]
    rest = body.rest_vertices(body.default_shape() if shape is None else shape)
    return stand_on_floor(body, make_motion(local, root, fps, name=name), rest)


def _local_rotations(
    body: Body, shape: Float[Array, " shapes"] | None, turns: Turns
) -> Float[np.ndarray, "frames joints 4"]:
    """Joint rotations relative to their parents, wxyz, from turns about the world's axes."""
    down = {"Left": np.array([0.14, -1.0, 0.02]), "Right": np.array([-0.14, -1.0, 0.02])}
    stance = {f"{s}{b}": d for s, d in down.items() for b in ("Arm", "ForeArm")}
    stance |= {f"{s}{b}": -_Y for s in down for b in ("UpLeg", "Leg")}
    aligned = align_global(body, stance, shape)
    frames = len(next(iter(turns.values())))
    local = np.zeros((frames, len(body.parents), 4))
    for j, (joint, parent) in enumerate(zip(body.joint_names, body.parents, strict=True)):
        # world = change * aligned, so the local turn is conjugated by the parent's.
        turn = Rotation.from_rotvec(turns.get(joint, np.zeros((frames, 3))))
        up = aligned[parent].inv() if parent >= 0 else Rotation.identity()
        local[:, j] = (up * turn * aligned[j]).as_quat(scalar_first=True)
    return local


def _planted_root(
    body: Body, motion: Motion, air: Time, shape: Float[Array, " shapes"] | None
) -> Float[np.ndarray, "frames 3"]:
    """Hips positions that keep the lower foot in place and the feet at height ``air``.

    The path is smooth except within 4 horizontal smoothing widths of either end.
    """
    rest = body.rest_vertices(body.default_shape() if shape is None else shape)
    ankles = [body.joint("LeftFoot"), body.joint("RightFoot")]
    heads = jax.device_put(np.asarray(body.joint_positions(rest)[0])[ankles])
    follow = jax.device_put(np.eye(len(body.parents), dtype=np.float32)[ankles])
    feet = np.asarray(animate(body, rest, heads, follow, motion), dtype=np.float64)
    left, right = feet[:, 0], feet[:, 1]
    # Soft choice of the standing foot: a hard switch would jerk the hips.
    share = 1.0 / (1.0 + np.exp((left[:, 1] - right[:, 1]) / 0.01))
    step = share[1:, None] * np.diff(left, axis=0) + (1 - share[1:, None]) * np.diff(right, axis=0)
    root = np.zeros((len(left), 3))
    root[1:] = -np.cumsum(step, axis=0)
    root = gaussian_filter1d(root, _SIGMA_XZ * motion.fps, axis=0, mode="nearest", truncate=4.0)
    feet_to_hips = -foot_heights(body, motion, rest)
    root[:, 1] = air + gaussian_filter1d(feet_to_hips, _SIGMA_Y * motion.fps, mode="nearest")
    return root
