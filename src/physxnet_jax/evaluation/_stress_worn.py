"""Stress tests of clothes on a body."""

import dataclasses
from collections.abc import Callable, Iterable, Iterator, Mapping

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from ..body import NUM_BODY_VERTICES, load_body
from ..garment import Garment, Template, tailor, template
from ..geometry import closest_points
from ..motion import Motion, animate, load_motion
from ..simulation import (
    STANDARD,
    XPBD,
    Effect,
    PreparedScene,
    Rollout,
    Scene,
    Status,
    prepare_scene,
    settle_on_static_body,
    simulate_batch,
    slipped,
    standard_effects,
)
from ..simulation.effects import Air, BodyContact, Damping, Pin, StrainLimit
from ._penetration import penetration
from ._strain import edge_strain
from ._stress import bad_frames, case
from ._surface_faults import surface_faults

_FPS = 30.0
NOT_FINITE = "frames not finite"
LAST_STRAIN = "99 % of edges at the end (strain)"
LAST_INSIDE = "vertices inside at the end (%)"
FALLEN = "median distance from skinned cloth at the end (m)"
VISIBLE_SKIN = "visible skin (% of pixels)"
VISIBLE_INNER = "visible inner garment (% of pixels)"
SLID = "slid along the body (mm)"


def _run(motion: Motion, name: Template = "top") -> Rollout:
    return simulate_batch(Scene((template(name),), STANDARD), [motion])[0]


@dataclasses.dataclass(frozen=True)
class PeerCase:
    """A case that external simulators run as well.

    Attributes:
        garments: The clothes, innermost first.
        motion: The motion.
        bounds: Upper bounds of the quantities that `outcome` measures.
    """

    garments: Callable[[], tuple[Garment, ...]]
    motion: Callable[[], Motion]
    bounds: Mapping[str, float]


def outcome(
    garments: tuple[Garment, ...],
    motion: Motion,
    positions: Float[np.ndarray, "frames vertices 3"],
    quantities: Iterable[str],
) -> dict[str, float]:
    """Quantities that are measured on any simulator's vertices alone.

    Args:
        garments: The clothes.
        motion: The body's motion.
        positions: Vertices of all garments [m].
        quantities: Those to measure; NaN if a frame isn't finite.
    """
    finite = np.isfinite(positions).all(axis=(1, 2))
    out = dict.fromkeys(quantities, np.nan) | {NOT_FINITE: float((~finite).sum())}
    if not finite.all():
        return out
    assembly = prepare_scene(Scene(garments, (Pin(),))).assembly
    last = np.asarray(positions[-1:], np.float32)
    still = dataclasses.replace(motion, rotations=motion.rotations[-1:], root=motion.root[-1:])
    out[LAST_STRAIN] = float(np.quantile(edge_strain(assembly, last), 0.99))
    if FALLEN in out:
        rest, weights = (jnp.asarray(x, jnp.float32) for x in (assembly.rest, assembly.weights))
        body_rest = jnp.asarray(assembly.rest_body, jnp.float32)
        skinned = np.asarray(animate(assembly.body, body_rest, rest, weights, still))
        out[FALLEN] = float(np.median(np.linalg.norm(last - skinned, axis=2)))
    if SLID in out:
        out[SLID] = 1e3 * float(slipped(assembly, motion, positions).max())
    if LAST_INSIDE in out:
        seen = penetration(assembly, still, last)
        out[LAST_INSIDE] = 100 * float((seen.cloth_inside & ~seen.pinched).mean())
    if {VISIBLE_SKIN, VISIBLE_INNER} & set(out):
        looked = np.linspace(0, len(positions) - 1, 4).round().astype(int)[1:]
        faults = surface_faults(assembly, motion, positions, frames=looked)
        shares = {VISIBLE_SKIN: faults.visible_skin, VISIBLE_INNER: faults.visible_inner}
        out |= {k: 100 * v for k, v in shares.items() if k in out}
    return out


def run_peer(name: str, engine: Callable[[Scene, Motion], Rollout]) -> dict[str, float]:
    """Runs a case of `PEER_CASES` in an external simulator and returns quantities by name.

    Args:
        name: Name of the case.
        engine: `simulate_blender` or `simulate_newton`.
    """
    peer = PEER_CASES[name]
    garments, motion = peer.garments(), peer.motion()
    out = engine(Scene(garments), motion)
    return outcome(garments, motion, np.concatenate(out.positions, axis=1), peer.bounds)


def run_own(
    name: str, effects: tuple[Effect, ...] | None = None
) -> tuple[Rollout, Iterator[tuple[str, float, float]]]:
    """Runs a case of `PEER_CASES` here; returns quantities, bounds and measured values.

    Args:
        name: Name of the case.
        effects: Effects; the default ones for its number of garments if None.
    """
    peer = PEER_CASES[name]
    garments, motion = peer.garments(), peer.motion()
    effects = standard_effects(garments) if effects is None else effects
    (out,) = simulate_batch(Scene(garments, effects), [motion])
    seen = outcome(garments, motion, np.concatenate(out.positions, axis=1), peer.bounds)
    return out, iter([(k, peer.bounds[k], seen[k]) for k in peer.bounds])


def _body_rows(out: Rollout) -> Iterator[tuple[str, float, float]]:
    d = out.diagnostics
    yield "frames not finite in the diagnostics", 0, bad_frames(out)
    yield "deepest vertex (mm)", 2.0, 1e3 * float(d["penetration_max"].max())


def _sunk(scene: PreparedScene, depth: float) -> Float[np.ndarray, "vertices 3"]:
    """Cloth at a depth below the skin that it lies on [m]."""
    body = load_body()
    rest = body.rest_vertices(body.default_shape())
    mesh = body.mesh(rest[:NUM_BODY_VERTICES])
    x = scene.assembly.rest
    hit = closest_points(mesh, jnp.asarray(x, jnp.float32))
    tri = np.asarray(mesh.faces)[np.asarray(hit.face)]
    foot = np.einsum("vk,vkc->vc", np.asarray(hit.weights), np.asarray(mesh.vertices)[tri])
    away = (x - foot) / np.linalg.norm(x - foot, axis=1, keepdims=True)
    return foot - depth * away


@case
def start_ten_millimetres_inside() -> Iterator[tuple[str, float, float]]:
    scene = prepare_scene(Scene((template("bottom"),), (BodyContact(), Pin())))
    out = settle_on_static_body(scene, 5, solver=XPBD(32, 4), start=_sunk(scene, 0.010))
    yield "frames not finite", 0, bad_frames(out)
    yield "deepest after a frame (mm)", 1.0, 1e3 * float(out.diagnostics["penetration_max"][0])
    yield "greatest speed later (m/s)", 1.5, float(out.diagnostics["speed_max"][1:].max())


@case
def start_fifty_millimetres_inside() -> Iterator[tuple[str, float, float]]:
    """Deeper than the middle of an arm, whose other side is nearer; tight and loose clothes."""
    bad, deepest, strain = [], [], []
    for garment in (template("top"), template("bottom"), tailor("shirt"), tailor("aline")):
        scene = prepare_scene(Scene((garment,)))
        out = settle_on_static_body(scene, 10, solver=XPBD(32, 4), start=_sunk(scene, 0.050))
        bad.append(bad_frames(out))
        deepest.append(1e3 * float(out.diagnostics["penetration_max"][-1]))
        strain.append(float(np.abs(edge_strain(scene.assembly, out.positions[0][-1:])).max()))
    yield "frames not finite", 0, max(bad)
    yield "deepest at the end (mm)", 1.0, max(deepest)
    yield "greatest strain at the end", 0.5, max(strain)


def _late_spin() -> Motion:
    m = load_motion("spin", fps=_FPS)
    return dataclasses.replace(m, rotations=m.rotations[20:40], root=m.root[20:40])


@case
def first_frame_far_from_rest() -> Iterator[tuple[str, float, float]]:
    """A clip starts in the middle of a spin: the warmup has to reach that pose."""
    out, rows = run_own("first_frame_far_from_rest")
    yield from rows
    yield from _body_rows(out)
    yield "99 % of edges in the first frame (strain)", 0.35, float(out.diagnostics["strain_p99"][0])


@case
def a_minute_of_turns() -> Iterator[tuple[str, float, float]]:
    """1,800 frames of swaying and turning: a clip played forwards and backwards."""
    m = load_motion("side step", fps=_FPS)
    n = m.num_frames
    # Forwards and backwards, so that consecutive frames stay close.
    index = np.abs((np.arange(1800) + n - 1) % (2 * (n - 1)) - (n - 1))
    long = dataclasses.replace(
        m, rotations=jnp.asarray(m.rotations)[index], root=jnp.asarray(m.root)[index]
    )
    scene = prepare_scene(Scene((template("bottom"),), STANDARD))
    out = simulate_batch(scene, [long], solver=XPBD(16, 2))[0]
    yield from _body_rows(out)
    strain = out.diagnostics["strain_p99"]
    yield "99 % of edges in the last ten seconds (strain)", 0.35, float(strain[-300:].max())


def _fast_punch() -> Motion:
    m = load_motion("punch", fps=_FPS)
    # The last frame is held for a third of a second, so that the cloth can recover.
    index = np.append(np.arange(0, m.num_frames, 8), np.full(10, m.num_frames - 1))
    return dataclasses.replace(m, rotations=m.rotations[index], root=m.root[index])


@case
def standing_still() -> Iterator[tuple[str, float, float]]:
    """A dress on a static body comes to rest and stays at rest."""
    m = load_motion("balance", fps=_FPS)
    index = np.zeros(60, int)
    out = _run(dataclasses.replace(m, rotations=m.rotations[index], root=m.root[index]), "dress")
    yield from _body_rows(out)
    x = out.positions[0][-20:].astype(np.float64)
    acceleration = np.linalg.norm(np.diff(x, n=2, axis=0), axis=2) * _FPS**2
    yield "acceleration, median (m/s^2)", 0.5, float(np.median(acceleration))
    yield "acceleration, 99 % (m/s^2)", 5.0, float(np.quantile(acceleration, 0.99))


@case
def limbs_at_eight_times_their_speed() -> Iterator[tuple[str, float, float]]:
    out, rows = run_own("limbs_at_eight_times_their_speed")
    yield from rows
    yield from _body_rows(out)


def _teleport() -> Motion:
    m = load_motion("balance", fps=_FPS)
    root = np.asarray(m.root[:30]).copy()
    root[10:] += [2.0, 0.0, 0.0]
    return dataclasses.replace(m, rotations=m.rotations[:30], root=jnp.asarray(root))


@case
def a_teleport_of_two_metres() -> Iterator[tuple[str, float, float]]:
    out, rows = run_own("a_teleport_of_two_metres")
    yield from rows
    yield from _body_rows(out)
    calm = np.flatnonzero(out.diagnostics["strain_p99"][10:] < 0.3)
    yield "frames until 99 % of edges are within 30 %", 15, float(calm[0] if len(calm) else np.inf)


def arm_motion(*, axis: int, angle: float) -> Motion:
    """Both arms turn about an axis as far as an angle [rad], mirrored, and return."""
    body = load_body()
    frames = 24
    turn = angle * np.sin(np.pi * np.arange(frames) / (frames - 1))
    pose = np.repeat(np.asarray(body.a_pose())[None], frames, axis=0)
    for name, sign in (("LeftArm", -1.0), ("RightArm", 1.0)):
        half = 0.5 * sign * turn
        q = np.zeros((frames, 4))
        q[:, 0], q[:, 1 + axis] = np.cos(half), np.sin(half)
        pose[:, body.joint(name)] = q
    rest = body.rest_vertices(body.default_shape())
    root = np.repeat(np.asarray(body.joint_positions(rest)[0])[:1], frames, axis=0)
    return Motion(jnp.asarray(pose, jnp.float32), jnp.asarray(root), _FPS, "arms")


def pressed_arms() -> Motion:
    """Both arms are pressed through the trunk and return."""
    return arm_motion(axis=2, angle=1.2)


@case
def closed_armpits_and_crossed_arms() -> Iterator[tuple[str, float, float]]:
    """The arms pass through the trunk, so that no cloth fits between them."""
    out, rows = run_own("closed_armpits_and_crossed_arms")
    yield from rows
    yield from _body_rows(out)
    yield "greatest speed (m/s)", 20.0, float(out.diagnostics["speed_max"].max())
    yield "pinching unnoticed (1 = yes)", 0, float(not (out.status & Status.PINCHED).any())


@case
def a_strain_limit_in_a_storm() -> Iterator[tuple[str, float, float]]:
    """A dress in wind of 30 m/s, with and without a limit of 10 % on the strain of its edges."""
    m = load_motion("walk", fps=_FPS)
    m = dataclasses.replace(m, rotations=m.rotations[:24], root=m.root[:24])
    garments = (template("dress"),)
    storm = tuple(e for e in standard_effects(garments) if not isinstance(e, Damping))
    storm = (Air(wind=(0.0, 0.0, 30.0)), *storm)
    at = [type(e) for e in storm].index(BodyContact)
    limited = (*storm[:at], StrainLimit(), *storm[at:])
    free, held = (simulate_batch(Scene(garments, e), [m])[0] for e in (storm, limited))
    most = [float(out.diagnostics["strain_p99"].max()) for out in (held, free)]
    yield NOT_FINITE, 0, bad_frames(held)
    yield "99 % of edges, most strain over that without a limit (1)", 0.9, most[0] / most[1]


def one(name: Template) -> Callable[[], tuple[Garment, ...]]:
    """Clothes of one template."""
    return lambda: (template(name),)


def bounds(strain: float = 0.35) -> dict[str, float]:
    """Bounds of a case with a body, by the strain at the end."""
    return {NOT_FINITE: 0.0, LAST_STRAIN: strain, LAST_INSIDE: 0.5}


PEER_CASES: dict[str, PeerCase] = {
    "first_frame_far_from_rest": PeerCase(one("bottom"), _late_spin, bounds()),
    "limbs_at_eight_times_their_speed": PeerCase(one("top"), _fast_punch, bounds(0.4)),
    "a_teleport_of_two_metres": PeerCase(one("bottom"), _teleport, bounds()),
    "closed_armpits_and_crossed_arms": PeerCase(one("top"), pressed_arms, bounds()),
}
"""Cases that external simulators run as well."""
