"""The loop over frames, blocks and substeps, whatever the solver."""

import dataclasses
import functools
from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from ._effect import Clock, Placed
from ._solver import Solver
from ._state import State, System, place


def start_state(
    system: System,
    position: Float[Array, "vertices 3 batch"],
    velocity: Float[Array, "vertices 3 batch"] | None = None,
    *,
    solver: Solver,
    fps: float,
) -> State:
    """Cloth from which `advance` goes on; pure and differentiable.

    Args:
        system: The scene, by `PreparedScene.system` of the solver.
        position: Cloth [m], garments one after another; people side by side.
        velocity: Its velocity [m/s]; at rest if omitted.
        solver: How the cloth will move.
        fps: Frames a second.
    """
    velocity = jnp.zeros_like(position) if velocity is None else velocity
    return State(
        position,
        velocity,
        solver.remember(velocity, 1.0 / (fps * solver.substeps)),
        # Filled in here, or a second call of `advance` would be another program to compile.
        tuple(e.initial(position.shape[2]) for e in system.effects),
    )


@functools.partial(jax.jit, static_argnames=("solver", "fps", "energies"))
def advance(
    system: System,
    state: State,
    rotations: Float[Array, "frames batch joints 4"],
    root: Float[Array, "frames batch 3"],
    *,
    solver: Solver,
    fps: float,
    time: Float[Array, ""] | float = 0.0,
    energies: bool = False,
) -> tuple[State, Float[Array, "later vertices 3 batch"], dict[str, Array]]:
    """Rolls the cloth through frames 1, 2, ... from its state at frame 0.

    The body moves between frames in a straight line, in as many pieces as there are
    queries. Differentiable; intermediate values of a frame are recomputed backwards.

    Args:
        system: The scene.
        state: Cloth at frame 0.
        rotations: Poses of all frames, wxyz.
        root: Hips positions of all frames [m].
        solver: How the cloth moves.
        fps: Frames a second.
        time: Of frame 0, for effects that depend on it [s].
        energies: Give the energy of each effect as well.

    Returns:
        The last state, positions of frames 1 and later, and diagnostics of each frame.
    """
    effects = system.effects
    count = solver.substeps // solver.queries
    h = 1.0 / (fps * solver.substeps)
    length = count * h

    def skin(q: Array, p: Array) -> tuple[Placed | None, ...]:
        return tuple(
            None if e.attached is None else place(system.body, system.rest, e.attached, q, p)
            for e in effects
        )

    def block(carry: tuple, k: Array) -> tuple[tuple, None]:
        state, _, _, before, after, began = carry
        start = jax.tree.map(lambda a, b: a + (k / solver.queries) * (b - a), before, after)
        end = jax.tree.map(lambda a, b: a + ((k + 1) / solver.queries) * (b - a), before, after)
        base = state.position
        clock = Clock(began + k * length, length)
        contexts = tuple(
            e.begin(base, s, t, clock, m)
            for e, s, t, m in zip(effects, start, end, state.kept, strict=True)
        )
        kept = tuple(e.keep(c) for e, c in zip(effects, contexts, strict=True))
        d, v, memory = solver.block(system, contexts, state.velocity, state.memory, h, count)
        return (State(base + d, v, memory, kept), d, contexts, before, after, began), None

    def frame(carry: tuple, pose: tuple[Array, Array]) -> tuple[tuple, tuple]:
        state, before, began = carry
        after = skin(*pose)
        # The loop's carry needs the contexts' shapes; the first block fills them.
        shapes = jax.eval_shape(
            lambda x, at, kept: tuple(
                e.begin(x, s, s, Clock(began, length), m)
                for e, s, m in zip(effects, at, kept, strict=True)
            ),
            state.position,
            before,
            state.kept,
        )
        contexts = jax.tree.map(lambda s: jnp.zeros(s.shape, s.dtype), shapes)
        start = (state, jnp.zeros_like(state.position), contexts, before, after, began)
        steps = jnp.arange(solver.queries, dtype=state.position.dtype)
        (state, d, contexts, _, _, _), _ = jax.lax.scan(block, start, steps)
        info = _look(system, solver, state, d, contexts, h, energies)
        return (state, after, began + 1.0 / fps), (state.position, info)

    if state.kept is None:
        kept = tuple(e.initial(state.position.shape[2]) for e in effects)
        state = dataclasses.replace(state, kept=kept)
    first = skin(rotations[0], root[0])
    began = jnp.asarray(time, state.position.dtype)
    (state, _, _), (positions, diagnostics) = jax.lax.scan(
        jax.checkpoint(frame), (state, first, began), (rotations[1:], root[1:])
    )
    return state, positions, diagnostics


def _look(
    system: System,
    solver: Solver,
    state: State,
    displacement: Array,
    contexts: tuple[Any, ...],
    h: float,
    energies: bool,
) -> dict[str, Array]:
    """Diagnostics at a frame's end, shapes [batch]."""
    finite = jnp.isfinite(state.position).all(axis=1)
    speed = jnp.sqrt(jnp.sum(state.velocity**2, axis=1))
    residual = solver.residual(system, contexts, displacement, state.memory, h)
    info = {
        "finite": finite.all(axis=0),
        "speed_max": speed.max(axis=0),
        # A value that isn't finite is the worst of all.
        "worst_vertex": jnp.argmax(jnp.where(finite, speed, jnp.inf), axis=0),
        "residual_max": residual.max(axis=0),
        "residual_p99": jnp.sort(residual, axis=0)[int(0.99 * (residual.shape[0] - 1))],
    }
    for e, context in zip(system.effects, contexts, strict=True):
        for name, worst in e.diagnose(displacement, context).items():
            info[name] = jnp.maximum(info[name], worst) if name in info else worst
        stored = e.energy(displacement, context) if energies and e.elastic else None
        if stored is not None:
            info[f"energy_{type(e).__name__.strip('_').lower()}"] = stored
    if energies:
        mass = jnp.where(system.inverse_mass > 0, 1.0 / system.inverse_mass, 0.0)
        info["energy_kinetic"] = 0.5 * jnp.sum(mass * state.velocity**2, axis=(0, 1))
    return info
