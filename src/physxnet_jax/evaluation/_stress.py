"""Stress tests of the simulator: measured quantities and their bounds."""

import dataclasses
from collections.abc import Callable, Iterator

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from ..garment import Fabric, Garment, free_garment, square_sheet
from ..simulation import (
    XPBD,
    Clock,
    Effect,
    Implicit,
    Rollout,
    Scene,
    Status,
    prepare_scene,
    settle_on_static_body,
)
from ..simulation.effects import (
    Air,
    Bend,
    BodyContact,
    Dihedral,
    Gravity,
    LayerContact,
    Membrane,
    Pin,
    SelfContact,
    Stretch,
)

_FPS = 30.0
_FREE: tuple[Effect, ...] = (Gravity(), Stretch(), Bend())
_FLOATING: tuple[Effect, ...] = (Stretch(compression=1.0), Bend())


@dataclasses.dataclass(frozen=True)
class Finding:
    """One line of the stress table.

    Attributes:
        case: Name of the case.
        quantity: The measured quantity, with its unit.
        bound: Upper bound.
        measured: Measured value.
    """

    case: str
    quantity: str
    bound: float
    measured: float

    @property
    def holds(self) -> bool:
        """Whether the bound holds; it never does for NaN."""
        return bool(self.measured <= self.bound)


Case = Callable[[], Iterator[tuple[str, float, float]]]
CASES: dict[str, Case] = {}
"""Every case by name; each yields quantities, bounds and measured values."""


def run_case(name: str) -> list[Finding]:
    """Runs one case of `CASES`."""
    return [Finding(name, what, float(b), float(m)) for what, b, m in CASES[name]()]


def case(function: Case) -> Case:
    CASES[function.__name__.strip("_")] = function
    return function


def _run(
    garment: Garment,
    effects: tuple[Effect, ...],
    frames: int,
    *,
    substeps: int = 32,
    contact_updates: int = 4,
    start: np.ndarray | None = None,
    shift: tuple[float, float, float] = (0.0, 0.0, 0.0),
    energies: bool = False,
) -> Rollout:
    scene = prepare_scene(Scene((garment,), effects))
    solver = XPBD(substeps, contact_updates)
    return settle_on_static_body(
        scene, frames, solver=solver, start=start, shift=shift, energies=energies
    )


def bad_frames(out: Rollout) -> float:
    """Number of frames that aren't finite."""
    return float((~out.finite).sum())


def _edge_ratio(g: Garment, x: Float[np.ndarray, "vertices 3"]) -> tuple[float, float]:
    faces = np.asarray(g.mesh.faces)
    ends = np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]])
    rest = np.asarray(g.mesh.vertices)
    ratio = np.linalg.norm(x[ends[:, 0]] - x[ends[:, 1]], axis=1) / np.linalg.norm(
        rest[ends[:, 0]] - rest[ends[:, 1]], axis=1
    )
    return float(ratio.min()), float(ratio.max())


@case
def free_fall() -> Iterator[tuple[str, float, float]]:
    g = square_sheet(6)
    out = _run(g, _FREE, 15)
    t = 15 / _FPS
    # Steps of XPBD fall 3/22 g h t farther than the parabola.
    exact = 9.81 * t * (t / 2 + 3 / 22 / (_FPS * 32))
    fallen = np.asarray(g.mesh.vertices)[:, 1] - out.positions[0][-1, :, 1]
    yield "relative error of the fall", 1e-4, float(np.abs(fallen / exact - 1).max())


@case
def hanging_strip() -> Iterator[tuple[str, float, float]]:
    """A strip under its weight elongates by rho g L^2 / (2 Y)."""
    n, size, y = 9, 0.4, 40.0
    fabric = Fabric(density=0.5, bend=1e-6, warp=y, weft=y, shear=y)
    g = square_sheet(n, size, upright=True, pinned=np.arange(n), fabric=fabric)
    scene = prepare_scene(Scene((g,), (Gravity(), Membrane(), Pin())))
    out = settle_on_static_body(scene, 30, solver=Implicit(2, 1, order=1, newton=4), fps=5.0)
    lowest = out.positions[0][-1][-n:, 1].mean() - np.asarray(g.mesh.vertices)[0, 1]
    expected = 0.5 * 9.81 * size**2 / (2 * y)
    yield "relative error of the sag", 0.03, abs((-lowest - size) / expected - 1)


@case
def rotated_rest_state() -> Iterator[tuple[str, float, float]]:
    g = square_sheet(8)
    x = np.asarray(g.mesh.vertices)
    q = np.linalg.qr(np.random.default_rng(0).normal(size=(3, 3)))[0]
    turned = (x - x.mean(0)) @ (q * np.sign(np.linalg.det(q))).T + x.mean(0)
    out = _run(g, _FLOATING, 5, start=turned)
    yield (
        "drift of a turned sheet (mm)",
        0.02,
        1e3 * float(np.abs(out.positions[0][-1] - turned).max()),
    )


@case
def scrambled_start() -> Iterator[tuple[str, float, float]]:
    g = square_sheet(7)
    x = np.asarray(g.mesh.vertices)
    noise = np.random.default_rng(1).normal(size=x.shape) * 0.1
    out = _run(g, _FLOATING, 90, start=x + noise)
    low, high = _edge_ratio(g, out.positions[0][-1])
    yield "frames not finite", 0, bad_frames(out)
    yield "longest edge after 3 s (1 = rest)", 1.1, high
    yield "shortest edge after 3 s, missing share", 0.15, 1 - low


@case
def collapsed_start() -> Iterator[tuple[str, float, float]]:
    g = square_sheet(7)
    x = np.repeat(np.asarray(g.mesh.vertices)[:1], 49, axis=0)
    out = _run(g, _FLOATING, 90, start=x + 1e-6 * np.random.default_rng(2).normal(size=x.shape))
    _, high = _edge_ratio(g, out.positions[0][-1])
    yield "frames not finite", 0, bad_frames(out)
    yield "longest edge after 3 s (1 = rest)", 1.15, high


@case
def degenerate_mesh() -> Iterator[tuple[str, float, float]]:
    """A sliver, a needle, a duplicate vertex, a zero-area triangle, an unreferenced vertex."""
    v = np.asarray(
        [[0, 0, 0], [0.1, 0, 0], [0, 0, 0.1], [0, 0, 0], [0.3, 0.3, 0], [0.05, 0, 1e-7], [1, 0, 0]]
    )
    f = np.asarray([[0, 1, 2], [0, 3, 1], [0, 5, 1], [1, 6, 5]])
    g = free_garment(v + np.asarray([0, 0, 1.5]), f)
    out = _run(g, (Gravity(), Stretch(), Membrane(), Bend(), Dihedral(), Air()), 30)
    yield "frames not finite", 0, bad_frames(out)
    yield "greatest speed (m/s)", 12.0, float(out.diagnostics["speed_max"].max())


@case
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

            def total_energy(y: jax.Array, e: object = e, c: object = context) -> jax.Array:
                return jnp.sum(e.energy(y, c))  # pyright: ignore[reportAttributeAccessIssue]

            value, slope = jax.value_and_grad(total_energy)(d)
            count += int(not (np.isfinite(float(value)) and np.isfinite(np.asarray(slope)).all()))
    yield "values or gradients not finite", 0, count


@case
def stiffness_over_nine_decades() -> Iterator[tuple[str, float, float]]:
    nonfinite, strains = 0.0, []
    for stiffness in (1e0, 1e3, 1e6, 1e9):
        fabric = Fabric(stretch=stiffness, bend=1e-12 * stiffness)
        g = square_sheet(6, upright=True, pinned=np.arange(6), fabric=fabric)
        out = _run(g, (*_FREE, Pin()), 10)
        nonfinite += bad_frames(out)
        strains.append(float(out.diagnostics["strain_max"].max()))
    yield "frames not finite", 0, nonfinite
    yield "strain that grows with stiffness", 1e-3, max(np.diff(strains).max(), 0.0)


@case
def masses_over_seven_decades() -> Iterator[tuple[str, float, float]]:
    nonfinite, speed = 0.0, 0.0
    for density in (1e-4, 1e3):
        g = square_sheet(6, upright=True, pinned=np.arange(6), fabric=Fabric(density=density))
        out = _run(g, (*_FREE, Pin()), 10)
        nonfinite += bad_frames(out)
        speed = max(speed, float(out.diagnostics["speed_max"].max()))
    yield "frames not finite", 0, nonfinite
    yield "greatest speed (m/s), free fall 3.3", 3.6, speed


@case
def pendulum() -> Iterator[tuple[str, float, float]]:
    """A stiff sheet that hangs from its edge swings with T = 2 pi sqrt(2 L / (3 g))."""
    size, tilt = 0.4, 0.1
    fabric = Fabric(stretch=2e4, bend=10.0)
    g = square_sheet(3, size, upright=True, pinned=np.arange(3), fabric=fabric)
    rest = np.asarray(g.mesh.vertices, np.float64)
    depth = rest[:, 1] - rest[0, 1]
    start = rest.copy()
    start[:, 1] = rest[0, 1] + depth * np.cos(tilt)
    start[:, 2] = rest[0, 2] - depth * np.sin(tilt)
    effects = (Gravity(), Stretch(compression=1.0), Bend(), Pin())
    out = _run(g, effects, 45, substeps=128, start=start)
    z = out.positions[0][:, -1, 2] - rest[0, 2]
    cross = np.flatnonzero(z[:-1] * z[1:] < 0)
    when = cross + z[cross] / (z[cross] - z[cross + 1])
    half = np.diff(when).mean() / _FPS
    exact = np.pi * np.sqrt(2 * size / (3 * 9.81)) * (1 + tilt**2 / 16)
    # Lumped masses: the sheet's three rows carry 1/4, 1/2 and 1/4 of its mass.
    lumped = np.sqrt((0.5 * 0.25 + 0.25) / (0.5 * 0.5 + 0.25) * 1.5)
    yield "relative error of the period", 0.02, abs(half / (exact * lumped) - 1)


@case
def a_fold_lands_on_itself() -> Iterator[tuple[str, float, float]]:
    """The upper of two sheets of one garment falls on the lower one, which is pinned."""
    low, high = square_sheet(8, 0.3), square_sheet(8, 0.15, corner=(0.08, 0.03, 1.58))
    v = np.concatenate([np.asarray(g.mesh.vertices) for g in (low, high)])
    f = np.concatenate([np.asarray(low.mesh.faces), np.asarray(high.mesh.faces) + 64])
    g = free_garment(v, f, pinned=np.arange(64))
    effects = (Gravity(), Stretch(), SelfContact(gap=0.004), Pin())
    out = _run(g, effects, 20)
    above = out.positions[0][:, 64:, 1]
    yield "frames not finite", 0, bad_frames(out)
    yield "below the lower sheet, ever (mm)", 0, float(max(-1e3 * above.min(), 0.0))
    yield (
        "less than three quarters of the gap at the end (mm)",
        0,
        1e3 * max(0.003 - float(above[-1].min()), 0.0),
    )


@case
def layers_in_the_wrong_order() -> Iterator[tuple[str, float, float]]:
    """An outer sheet starts 10 mm behind the inner one, which is pinned."""
    inner = square_sheet(10, 0.3, upright=True, pinned=np.arange(100))
    outer = square_sheet(7, 0.18, upright=True, corner=(0.06, -0.06, 1.49))
    scene = prepare_scene(Scene((inner, outer), (Stretch(), Bend(), LayerContact(), Pin())))
    out = settle_on_static_body(scene, 12, solver=XPBD(32, 4))
    crossed = out.diagnostics["layers_crossed"]
    yield "frames not finite", 0, bad_frames(out)
    yield "crossings unnoticed at the start (1 = yes)", 0, float(crossed[0] == 0)
    yield "vertices in the wrong order at the end", 0, float(crossed[-1])
    yield "greatest speed (m/s)", 0.5, float(out.diagnostics["speed_max"].max())


@case
def a_step_of_a_second() -> Iterator[tuple[str, float, float]]:
    for name, solver in (("xpbd", XPBD(1, 1)), ("bdf2", Implicit(1, 1, newton=3))):
        g = square_sheet(6, pinned=np.arange(6))
        scene = prepare_scene(Scene((g,), (*_FREE, Pin())))
        out = settle_on_static_body(scene, 5, solver=solver, fps=1.0)
        reach = float(np.abs(out.positions[0] - np.asarray(g.mesh.vertices)).max())
        yield f"{name}: frames not finite", 0, bad_frames(out)
        yield f"{name}: farthest from the start (m), free fall 125", 125.0, reach


@case
def contradicting_pins() -> Iterator[tuple[str, float, float]]:
    """Two opposite edges are pinned at twice the sheet's length."""
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
    out = settle_on_static_body(mixed, 30, solver=XPBD(32, 4), start=far)
    moved = np.abs(out.positions[0][-1][held] - far[held]).max()
    yield "frames not finite", 0, bad_frames(out)
    yield "pins off their place (mm)", 0.01, 1e3 * float(moved)
    yield "speed at the end (m/s)", 0.5, float(out.diagnostics["speed_max"][-1])
    yield "strain unnoticed (1 = yes)", 0, float(not out.status[-1] & Status.STRAINED)


@case
def a_kilometre_from_the_origin() -> Iterator[tuple[str, float, float]]:
    g = square_sheet(6)
    here = _run(g, _FREE, 10).positions[0][-1]
    shift = (1000.0, 0.0, -1000.0)
    there = _run(g, _FREE, 10, shift=shift).positions[0][-1] - np.asarray(shift)
    # Positions are rounded once per contact interval: 40 intervals.
    ulp = float(np.spacing(np.float32(1000.0)))
    yield (
        "difference (mm), 40 roundings of the position",
        40e3 * ulp,
        1e3 * float(np.abs(here - there).max()),
    )


@case
def ten_thousand_steps() -> Iterator[tuple[str, float, float]]:
    g = square_sheet(5, pinned=np.arange(5))
    out = _run(g, (Gravity(), Stretch(compression=1.0), Bend(), Pin()), 313, energies=True)
    d = out.diagnostics
    scene = prepare_scene(Scene((g,), (Gravity(), Pin())))
    height = out.positions[0][..., 1] - np.asarray(g.mesh.vertices)[:, 1]
    free = ~scene.assembly.pinned
    total = d["energy_kinetic"] + d["energy_stretch"] + d["energy_bend"]
    total = total + 9.81 * height[:, free] @ scene.assembly.mass[free]
    scale = float(d["energy_kinetic"].max())
    yield "frames not finite", 0, bad_frames(out)
    yield (
        "energy gained over its start, share of the greatest kinetic",
        0.01,
        float(total.max() / scale),
    )


@case
def an_effect_that_touches_nothing() -> Iterator[tuple[str, float, float]]:
    g = square_sheet(5)
    plain = _run(g, _FREE, 5).positions[0]
    more = _run(g, (*_FREE, BodyContact()), 5).positions[0]
    yield "bits changed (largest difference, m)", 0, float(np.abs(plain - more).max())
