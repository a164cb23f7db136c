"""Hard cases: what is measured, its bound, and whether it holds."""

import dataclasses
from collections.abc import Callable, Iterator

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from ..body import load_body
from ..garment import Fabric, Garment, Template, free_garment, square_sheet, template
from ..motion import Motion, load_motion
from ..simulation import (
    STANDARD,
    XPBD,
    Air,
    Bend,
    BodyContact,
    Clock,
    Dihedral,
    Effect,
    Gravity,
    Implicit,
    Membrane,
    Pin,
    Rollout,
    Scene,
    Status,
    Stretch,
    prepare_scene,
    simulate_batch,
    simulate_still,
)

_FPS = 30.0
_FREE: tuple[Effect, ...] = (Gravity(), Stretch(), Bend())
_FLOATING: tuple[Effect, ...] = (Stretch(compression=1.0), Bend())


@dataclasses.dataclass(frozen=True)
class Finding:
    """One line of the stress table.

    Attributes:
        case: Name of the case.
        quantity: What was measured, with its unit.
        bound: What it must not exceed.
        measured: What it was.
    """

    case: str
    quantity: str
    bound: float
    measured: float

    @property
    def holds(self) -> bool:
        """Whether the bound holds; a NaN never does."""
        return bool(self.measured <= self.bound)


Case = Callable[[], Iterator[tuple[str, float, float]]]
CASES: dict[str, Case] = {}
"""Every case by name; each yields quantity, bound and measured value."""


def run_case(name: str) -> list[Finding]:
    """Runs one case of `CASES`."""
    return [Finding(name, what, float(b), float(m)) for what, b, m in CASES[name]()]


def _case(function: Case) -> Case:
    CASES[function.__name__.strip("_")] = function
    return function


def _roll(
    garment: Garment,
    effects: tuple[Effect, ...],
    frames: int,
    *,
    substeps: int = 32,
    queries: int = 4,
    start: np.ndarray | None = None,
    shift: tuple[float, float, float] = (0.0, 0.0, 0.0),
    energies: bool = False,
) -> Rollout:
    scene = prepare_scene(Scene((garment,), effects))
    solver = XPBD(substeps, queries)
    return simulate_still(scene, frames, solver=solver, start=start, shift=shift, energies=energies)


def _bad(out: Rollout) -> float:
    """Frames that aren't finite."""
    return float((~out.finite).sum())


def _edge_ratio(g: Garment, x: Float[np.ndarray, "vertices 3"]) -> tuple[float, float]:
    faces = np.asarray(g.mesh.faces)
    ends = np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]])
    rest = np.asarray(g.mesh.vertices)
    ratio = np.linalg.norm(x[ends[:, 0]] - x[ends[:, 1]], axis=1) / np.linalg.norm(
        rest[ends[:, 0]] - rest[ends[:, 1]], axis=1
    )
    return float(ratio.min()), float(ratio.max())


@_case
def free_fall() -> Iterator[tuple[str, float, float]]:
    g = square_sheet(6)
    out = _roll(g, _FREE, 15)
    t = 15 / _FPS
    # Symplectic steps fall g h t / 2 farther than the parabola.
    exact = 0.5 * 9.81 * t * (t + 1 / (_FPS * 32))
    fallen = np.asarray(g.mesh.vertices)[:, 1] - out.positions[0][-1, :, 1]
    yield "relative error of the fall", 1e-4, float(np.abs(fallen / exact - 1).max())


@_case
def hanging_strip() -> Iterator[tuple[str, float, float]]:
    """A strip under its own weight grows by rho g L^2 / (2 Y)."""
    n, size, y = 9, 0.4, 40.0
    fabric = Fabric(density=0.5, bend=1e-6, warp=y, weft=y, shear=y)
    g = square_sheet(n, size, upright=True, pinned=np.arange(n), fabric=fabric)
    scene = prepare_scene(Scene((g,), (Gravity(), Membrane(), Pin())))
    out = simulate_still(scene, 30, solver=Implicit(2, 1, order=1, newton=4), fps=5.0)
    lowest = out.positions[0][-1][-n:, 1].mean() - np.asarray(g.mesh.vertices)[0, 1]
    expected = 0.5 * 9.81 * size**2 / (2 * y)
    yield "relative error of the sag", 0.03, abs((-lowest - size) / expected - 1)


@_case
def rotated_rest_state() -> Iterator[tuple[str, float, float]]:
    g = square_sheet(8)
    x = np.asarray(g.mesh.vertices)
    q = np.linalg.qr(np.random.default_rng(0).normal(size=(3, 3)))[0]
    turned = (x - x.mean(0)) @ (q * np.sign(np.linalg.det(q))).T + x.mean(0)
    out = _roll(g, _FLOATING, 5, start=turned)
    yield (
        "drift of a turned sheet (mm)",
        0.02,
        1e3 * float(np.abs(out.positions[0][-1] - turned).max()),
    )


@_case
def scrambled_start() -> Iterator[tuple[str, float, float]]:
    g = square_sheet(7)
    x = np.asarray(g.mesh.vertices)
    noise = np.random.default_rng(1).normal(size=x.shape) * 0.1
    out = _roll(g, _FLOATING, 90, start=x + noise)
    low, high = _edge_ratio(g, out.positions[0][-1])
    yield "frames not finite", 0, _bad(out)
    yield "longest edge after 3 s (1 = rest)", 1.1, high
    yield "shortest edge after 3 s, missing share", 0.15, 1 - low


@_case
def collapsed_start() -> Iterator[tuple[str, float, float]]:
    g = square_sheet(7)
    x = np.repeat(np.asarray(g.mesh.vertices)[:1], 49, axis=0)
    out = _roll(g, _FLOATING, 90, start=x + 1e-6 * np.random.default_rng(2).normal(size=x.shape))
    _, high = _edge_ratio(g, out.positions[0][-1])
    yield "frames not finite", 0, _bad(out)
    yield "longest edge after 3 s (1 = rest)", 1.15, high


@_case
def degenerate_mesh() -> Iterator[tuple[str, float, float]]:
    """A sliver, a needle, a doubled vertex, a triangle without area, a lonely vertex."""
    v = np.asarray(
        [[0, 0, 0], [0.1, 0, 0], [0, 0, 0.1], [0, 0, 0], [0.3, 0.3, 0], [0.05, 0, 1e-7], [1, 0, 0]]
    )
    f = np.asarray([[0, 1, 2], [0, 3, 1], [0, 5, 1], [1, 6, 5]])
    g = free_garment(v + np.asarray([0, 0, 1.5]), f)
    out = _roll(g, (Gravity(), Stretch(), Membrane(), Bend(), Dihedral(), Air()), 30)
    yield "frames not finite", 0, _bad(out)
    yield "greatest speed (m/s)", 12.0, float(out.diagnostics["speed_max"].max())


@_case
def gradients_at_singular_points() -> Iterator[tuple[str, float, float]]:
    g = square_sheet(3)
    count = 0
    for effect in (Stretch(), Membrane(), Bend(), Dihedral()):
        scene = prepare_scene(Scene((g,), (effect,)))
        e, rest = scene.effects[0], scene.assembly.rest
        base = jnp.asarray(rest, jnp.float32)[:, :, None]
        clock = Clock(jnp.zeros(()), 0.01)
        for x in (rest, 0 * rest, rest * [1, 1, 0], rest * [-1, 1, 1]):
            d = jnp.asarray(x, jnp.float32)[:, :, None] - base
            context = e.begin(base, None, None, clock, ())

            def stored(y: jax.Array, e: object = e, c: object = context) -> jax.Array:
                return jnp.sum(e.energy(y, c))  # pyright: ignore[reportAttributeAccessIssue]

            value, slope = jax.value_and_grad(stored)(d)
            count += int(not (np.isfinite(float(value)) and np.isfinite(np.asarray(slope)).all()))
    yield "values or gradients not finite", 0, count


@_case
def stiffness_over_nine_decades() -> Iterator[tuple[str, float, float]]:
    wrong, strains = 0.0, []
    for stiffness in (1e0, 1e3, 1e6, 1e9):
        fabric = Fabric(stretch=stiffness, bend=1e-12 * stiffness)
        g = square_sheet(6, upright=True, pinned=np.arange(6), fabric=fabric)
        out = _roll(g, (*_FREE, Pin()), 10)
        wrong += _bad(out)
        strains.append(float(out.diagnostics["strain_max"].max()))
    yield "frames not finite", 0, wrong
    yield "strain that grows with stiffness", 1e-3, max(np.diff(strains).max(), 0.0)


@_case
def masses_over_seven_decades() -> Iterator[tuple[str, float, float]]:
    wrong, speed = 0.0, 0.0
    for density in (1e-4, 1e3):
        g = square_sheet(6, upright=True, pinned=np.arange(6), fabric=Fabric(density=density))
        out = _roll(g, (*_FREE, Pin()), 10)
        wrong += _bad(out)
        speed = max(speed, float(out.diagnostics["speed_max"].max()))
    yield "frames not finite", 0, wrong
    yield "greatest speed (m/s), free fall 3.3", 3.6, speed


@_case
def a_step_of_a_second() -> Iterator[tuple[str, float, float]]:
    for name, solver in (("xpbd", XPBD(1, 1)), ("bdf2", Implicit(1, 1, newton=3))):
        g = square_sheet(6, pinned=np.arange(6))
        scene = prepare_scene(Scene((g,), (*_FREE, Pin())))
        out = simulate_still(scene, 5, solver=solver, fps=1.0)
        reach = float(np.abs(out.positions[0] - np.asarray(g.mesh.vertices)).max())
        yield f"{name}: frames not finite", 0, _bad(out)
        yield f"{name}: farthest from the start (m), free fall 125", 125.0, reach


@_case
def contradicting_pins() -> Iterator[tuple[str, float, float]]:
    """Two opposite edges held at twice the length the sheet has."""
    g = square_sheet(6)
    v = np.asarray(g.mesh.vertices).copy()
    held = np.concatenate([np.arange(6), np.arange(30, 36)])
    far = v.copy()
    far[:, 2] = 1.5 + 2 * (v[:, 2] - 1.5)
    wide = square_sheet(6, (0.3, 0.6), pinned=held)
    # The rest shape of the small sheet with the pins of the large one.
    scene = prepare_scene(Scene((wide,), (Gravity(), Stretch(), Pin())))
    small = prepare_scene(Scene((square_sheet(6, pinned=held),), (Gravity(), Stretch(), Pin())))
    mixed = dataclasses.replace(
        scene, effects=(small.effects[0], small.effects[1], scene.effects[2])
    )
    out = simulate_still(mixed, 30, solver=XPBD(32, 4), start=far)
    moved = np.abs(out.positions[0][-1][held] - far[held]).max()
    yield "frames not finite", 0, _bad(out)
    yield "pins off their place (mm)", 0.01, 1e3 * float(moved)
    yield "speed at the end (m/s)", 0.5, float(out.diagnostics["speed_max"][-1])
    yield "strain unnoticed (1 = yes)", 0, float(not out.status[-1] & Status.STRAINED)


@_case
def a_kilometre_from_the_origin() -> Iterator[tuple[str, float, float]]:
    g = square_sheet(6)
    here = _roll(g, _FREE, 10).positions[0][-1]
    shift = (1000.0, 0.0, -1000.0)
    there = _roll(g, _FREE, 10, shift=shift).positions[0][-1] - np.asarray(shift)
    # Positions themselves are rounded once a block: 40 blocks.
    ulp = float(np.spacing(np.float32(1000.0)))
    yield (
        "difference (mm), 40 roundings of the position",
        40e3 * ulp,
        1e3 * float(np.abs(here - there).max()),
    )


@_case
def ten_thousand_steps() -> Iterator[tuple[str, float, float]]:
    g = square_sheet(5, pinned=np.arange(5))
    out = _roll(g, (Gravity(), Stretch(compression=1.0), Bend(), Pin()), 313, energies=True)
    d = out.diagnostics
    scene = prepare_scene(Scene((g,), (Gravity(), Pin())))
    height = out.positions[0][..., 1] - np.asarray(g.mesh.vertices)[:, 1]
    free = ~scene.assembly.pinned
    total = d["energy_kinetic"] + d["energy_stretch"] + d["energy_bend"]
    total = total + 9.81 * height[:, free] @ scene.assembly.mass[free]
    scale = float(d["energy_kinetic"].max())
    yield "frames not finite", 0, _bad(out)
    yield (
        "energy gained over its start, share of the greatest kinetic",
        0.01,
        float(total.max() / scale),
    )


@_case
def an_effect_that_touches_nothing() -> Iterator[tuple[str, float, float]]:
    g = square_sheet(5)
    plain = _roll(g, _FREE, 5).positions[0]
    more = _roll(g, (*_FREE, BodyContact()), 5).positions[0]
    yield "bits changed (largest difference, m)", 0, float(np.abs(plain - more).max())


def _worn(motion: Motion, name: Template = "top") -> Rollout:
    return simulate_batch(prepare_scene(Scene((template(name),), STANDARD)), [motion])[0]


def _body_rows(out: Rollout) -> Iterator[tuple[str, float, float]]:
    d = out.diagnostics
    yield "frames not finite", 0, _bad(out)
    yield "deepest vertex (mm)", 2.0, 1e3 * float(d["penetration_max"].max())


@_case
def limbs_at_eight_times_their_speed() -> Iterator[tuple[str, float, float]]:
    m = load_motion("punch", fps=_FPS)
    yield from _body_rows(
        _worn(dataclasses.replace(m, rotations=m.rotations[::8], root=m.root[::8]))
    )


@_case
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


@_case
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
