"""Hard cases of clothes on a body."""

import dataclasses
from collections.abc import Iterator

import jax.numpy as jnp
import numpy as np

from ..body import NUM_BODY_VERTICES, load_body
from ..garment import Template, template
from ..geometry import closest_points
from ..motion import Motion, load_motion
from ..simulation import (
    STANDARD,
    XPBD,
    BodyContact,
    Pin,
    Rollout,
    Scene,
    Status,
    prepare_scene,
    simulate_batch,
    simulate_still,
)
from ._stress import bad_frames, case

_FPS = 30.0


def _worn(motion: Motion, name: Template = "top") -> Rollout:
    return simulate_batch(prepare_scene(Scene((template(name),), STANDARD)), [motion])[0]


def _body_rows(out: Rollout) -> Iterator[tuple[str, float, float]]:
    d = out.diagnostics
    yield "frames not finite", 0, bad_frames(out)
    yield "deepest vertex (mm)", 2.0, 1e3 * float(d["penetration_max"].max())


@case
def start_ten_millimetres_inside() -> Iterator[tuple[str, float, float]]:
    g = template("bottom")
    scene = prepare_scene(Scene((g,), (BodyContact(), Pin())))
    body = load_body()
    rest = body.rest_vertices(body.default_shape())
    mesh = body.mesh(rest[:NUM_BODY_VERTICES])
    x = scene.assembly.rest
    hit = closest_points(mesh, jnp.asarray(x, jnp.float32))
    tri = np.asarray(mesh.faces)[np.asarray(hit.face)]
    foot = np.einsum("vk,vkc->vc", np.asarray(hit.weights), np.asarray(mesh.vertices)[tri])
    away = (x - foot) / np.linalg.norm(x - foot, axis=1, keepdims=True)
    out = simulate_still(scene, 5, solver=XPBD(32, 4), start=foot - 0.010 * away)
    yield "frames not finite", 0, bad_frames(out)
    yield "deepest after a frame (mm)", 1.0, 1e3 * float(out.diagnostics["penetration_max"][0])
    yield "greatest speed later (m/s)", 1.5, float(out.diagnostics["speed_max"][1:].max())


@case
def first_frame_far_from_rest() -> Iterator[tuple[str, float, float]]:
    """A clip that begins in the middle of a spin: the lead-in has to reach it."""
    m = load_motion("spin", fps=_FPS)
    out = _worn(dataclasses.replace(m, rotations=m.rotations[20:40], root=m.root[20:40]), "bottom")
    yield from _body_rows(out)
    yield "99 % of edges in the first frame (strain)", 0.35, float(out.diagnostics["strain_p99"][0])


@case
def a_minute_of_turns() -> Iterator[tuple[str, float, float]]:
    """1,800 frames: a person who sways and turns, cut together from a clip and back."""
    m = load_motion("side step", fps=_FPS)
    n = m.num_frames
    # Forth and back, so that no frame is far from the one before.
    index = np.abs((np.arange(1800) + n - 1) % (2 * (n - 1)) - (n - 1))
    long = dataclasses.replace(
        m, rotations=jnp.asarray(m.rotations)[index], root=jnp.asarray(m.root)[index]
    )
    scene = prepare_scene(Scene((template("bottom"),), STANDARD))
    out = simulate_batch(scene, [long], solver=XPBD(16, 2))[0]
    yield from _body_rows(out)
    strain = out.diagnostics["strain_p99"]
    yield "99 % of edges in the last ten seconds (strain)", 0.35, float(strain[-300:].max())


@case
def limbs_at_eight_times_their_speed() -> Iterator[tuple[str, float, float]]:
    m = load_motion("punch", fps=_FPS)
    yield from _body_rows(
        _worn(dataclasses.replace(m, rotations=m.rotations[::8], root=m.root[::8]))
    )


@case
def a_teleport_of_two_metres() -> Iterator[tuple[str, float, float]]:
    m = load_motion("balance", fps=_FPS)
    root = np.asarray(m.root[:30]).copy()
    root[10:] += [2.0, 0.0, 0.0]
    out = _worn(
        dataclasses.replace(m, rotations=m.rotations[:30], root=jnp.asarray(root)), "bottom"
    )
    yield from _body_rows(out)
    calm = np.flatnonzero(out.diagnostics["strain_p99"][10:] < 0.3)
    yield "frames until 99 % of edges are within 30 %", 15, float(calm[0] if len(calm) else np.inf)


@case
def closed_armpits_and_crossed_arms() -> Iterator[tuple[str, float, float]]:
    """The arms go through the trunk, which no cloth can separate."""
    body = load_body()
    frames = 24
    angle = 1.2 * np.sin(np.pi * np.arange(frames) / (frames - 1))
    pose = np.repeat(np.asarray(body.a_pose())[None], frames, axis=0)
    for name, sign in (("LeftArm", -1.0), ("RightArm", 1.0)):
        half = 0.5 * sign * angle
        pose[:, body.joint(name)] = np.column_stack(
            [np.cos(half), 0 * half, 0 * half, np.sin(half)]
        )
    rest = body.rest_vertices(body.default_shape())
    root = np.repeat(np.asarray(body.joint_positions(rest)[0])[:1], frames, axis=0)
    out = _worn(Motion(jnp.asarray(pose, jnp.float32), jnp.asarray(root), _FPS, "arms"))
    yield from _body_rows(out)
    yield "greatest speed (m/s)", 20.0, float(out.diagnostics["speed_max"].max())
    yield "99 % of edges at the end (strain)", 0.35, float(out.diagnostics["strain_p99"][-1])
    yield "pinching unnoticed (1 = yes)", 0, float(not (out.status & Status.PINCHED).any())
