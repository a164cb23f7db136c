"""The loop over frames, contact intervals and substeps, common to all solvers."""

import dataclasses
import functools
from typing import Any

import jax
import jax.numpy as jnp
from jax.sharding import Mesh, PartitionSpec
from jaxtyping import Array, Float

from ._effect import Clock, PosedPoints
from ._quantile import upper_quantile
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
    """Initial state for `advance`; pure and differentiable.

    Args:
        system: The scene, from `make_system` with the same solver.
        position: Cloth positions [m]: garments concatenated, people along the batch axis.
        velocity: Cloth velocities [m/s]; zero if omitted.
        solver: Solver that will advance the cloth.
        fps: Frames per second.
    """
    velocity = jnp.zeros_like(position) if velocity is None else velocity
    return State(
        position,
        velocity,
        solver.init_state(velocity, 1.0 / (fps * solver.substeps)),
        # Initialised here: with None, the second call of `advance` would have to recompile.
        tuple(e.init_state(position.shape[2]) for e in system.effects),
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
    guide: Float[Array, "frames patches 3 batch"] | None = None,
) -> tuple[State, Float[Array, "later vertices 3 batch"], dict[str, Array]]:
    """Advances the cloth through frames 1, 2, ... from its state at frame 0.

    Skinned points move linearly between frames, split into `Solver.contact_updates`
    contact intervals. Differentiable; the backward pass recomputes the intermediate
    values of each frame.

    Args:
        system: The scene.
        state: State at frame 0.
        rotations: Poses of all frames, wxyz.
        root: Hips positions of all frames [m].
        solver: Solver of the cloth.
        fps: Frames per second.
        time: Time of frame 0, for effects that depend on it [s].
        energies: Also return the energy of each effect.
        guide: Where an effect such as `Guide` draws the cloth to in all frames, in the form of
            its `means` [m].

    Returns:
        The last state, positions of frames 1 and later, and diagnostics of each frame.
    """
    h = 1.0 / (fps * solver.substeps)
    system = solver.at_step(system, h)
    effects = system.effects

    def skin(q: Array, p: Array) -> tuple[PosedPoints | None, ...]:
        if all(e.skinned_points is None for e in effects):
            return tuple(None for _ in effects)
        transforms = jax.vmap(lambda a, b: system.body.transforms(system.rest, a, b))(q, p)
        return skin_effects(system, *transforms)

    def frame(carry: tuple, pose: tuple[Array, ...]) -> tuple[tuple, tuple]:
        state, before, now, *drawn = carry
        after = skin(*pose[:2])
        pair = (drawn[0], pose[2]) if drawn else None
        state, info = advance_frame(
            system,
            state,
            before,
            after,
            solver=solver,
            fps=fps,
            time=now,
            guide=pair,
            energies=energies,
        )
        return (state, after, now + 1.0 / fps, *pose[2:]), (state.position, info)

    if state.effect_state is None:
        effect_state = tuple(e.init_state(state.position.shape[2]) for e in effects)
        state = dataclasses.replace(state, effect_state=effect_state)
    if not jax.tree.leaves(state.solver_state):
        solver_state = solver.init_state(state.velocity, h)
        state = dataclasses.replace(state, solver_state=solver_state)
    first = skin(rotations[0], root[0])
    start_time = jnp.asarray(time, state.position.dtype)
    begins = () if guide is None else (guide[0],)
    later = () if guide is None else (guide[1:],)
    (state, *_), (positions, diagnostics) = jax.lax.scan(
        jax.checkpoint(frame),
        (state, first, start_time, *begins),
        (rotations[1:], root[1:], *later),
    )
    return state, positions, diagnostics


def skin_effects(
    system: System,
    rotations: Float[Array, "batch joints 3 3"],
    translations: Float[Array, "batch joints 3"],
) -> tuple[PosedPoints | None, ...]:
    """What each effect needs of the skin in a pose, from world transforms of the joints."""
    return tuple(
        None if e.skinned_points is None else place(e.skinned_points, rotations, translations)
        for e in system.effects
    )


def advance_frame(
    system: System,
    state: State,
    before: tuple[PosedPoints | None, ...],
    after: tuple[PosedPoints | None, ...],
    *,
    solver: Solver,
    fps: float,
    time: Float[Array, ""],
    guide: tuple[Array, Array] | None = None,
    diagnose: bool = True,
    energies: bool = False,
) -> tuple[State, dict[str, Array]]:
    """Advances the cloth by one frame; `advance` for those who have the skin already.

    Args:
        system: The scene, with the tables of `Solver.at_step` for this length of substeps.
        state: State at the start, from `start_state`.
        before: `skin_effects` at the start.
        after: `skin_effects` at the end.
        solver: Solver of the cloth.
        fps: Frames per second.
        time: Time at the start [s].
        guide: Where an effect such as `Guide` draws the cloth to at the start and at the end.
        diagnose: Whether to return diagnostics.
        energies: Also return the energy of each effect.
    """
    count = solver.substeps // solver.contact_updates
    h = 1.0 / (fps * solver.substeps)
    length, effects = count * h, system.effects

    def interval(carry: tuple, k: Array) -> tuple[tuple, None]:
        state, _, _ = carry
        start = jax.tree.map(lambda a, b: a + (k / solver.contact_updates) * (b - a), before, after)
        end = jax.tree.map(
            lambda a, b: a + ((k + 1) / solver.contact_updates) * (b - a), before, after
        )
        base = state.position
        clock = Clock(time + k * length, length)
        contexts = tuple(
            e.begin(base, s, t, clock, m)
            for e, s, t, m in zip(effects, start, end, state.effect_state, strict=True)
        )
        effect_state = tuple(e.update_state(c) for e, c in zip(effects, contexts, strict=True))
        d, v, solver_state = solver.advance_interval(
            system, contexts, state.velocity, state.solver_state, h, count
        )
        return (
            State(base + d, v, solver_state, effect_state),
            d,
            contexts,
        ), None

    if guide is not None:
        received = tuple(
            e.receive(s, guide, time, 1.0 / fps)
            for e, s in zip(effects, state.effect_state, strict=True)
        )
        state = dataclasses.replace(state, effect_state=received)
    # The loop's carry needs the contexts' shapes; the first interval fills them.
    shapes = jax.eval_shape(
        lambda x, at, effect_state: tuple(
            e.begin(x, s, s, Clock(time, length), m)
            for e, s, m in zip(effects, at, effect_state, strict=True)
        ),
        state.position,
        before,
        state.effect_state,
    )
    contexts = jax.tree.map(lambda s: jnp.zeros(s.shape, s.dtype), shapes)
    first = (state, jnp.zeros_like(state.position), contexts)
    steps = jnp.arange(solver.contact_updates, dtype=state.position.dtype)
    (state, d, contexts), _ = jax.lax.scan(interval, first, steps)
    if not diagnose:
        return state, {}
    return state, _diagnose(system, solver, state, d, contexts, h, energies)


def advance_on(
    mesh: Mesh,
    system: System,
    state: State,
    rotations: Float[Array, "frames batch joints 4"],
    root: Float[Array, "frames batch 3"],
    *,
    solver: Solver,
    fps: float,
    time: Float[Array, ""],
    energies: bool = False,
) -> tuple[State, Float[Array, "later vertices 3 batch"], dict[str, Array]]:
    """`advance` with the people split among the devices of a mesh.

    Each device runs the program of its share, so that the result doesn't depend on their number.
    """
    if mesh.size == 1:
        return advance(
            system, state, rotations, root, solver=solver, fps=fps, time=time, energies=energies
        )
    return _advance_shares(
        system,
        state,
        rotations,
        root,
        time,
        mesh=mesh,
        solver=solver,
        fps=fps,
        energies=energies,
    )


@functools.partial(jax.jit, static_argnames=("mesh", "solver", "fps", "energies"))
def _advance_shares(
    system: System,
    state: State,
    rotations: Float[Array, "frames batch joints 4"],
    root: Float[Array, "frames batch 3"],
    time: Float[Array, ""],
    *,
    mesh: Mesh,
    solver: Solver,
    fps: float,
    energies: bool,
) -> tuple[State, Float[Array, "later vertices 3 batch"], dict[str, Array]]:
    (axis,) = mesh.axis_names

    # People are the last axis of every array of the state.
    def share(x: Array) -> PartitionSpec:
        return PartitionSpec(*[None] * (x.ndim - 1), axis) if x.ndim else PartitionSpec()

    def run(*arguments: Any) -> Any:
        *inputs, at = arguments
        return advance(*inputs, solver=solver, fps=fps, time=at, energies=energies)

    whole, frames_first = PartitionSpec(), PartitionSpec(None, axis)
    shares = jax.tree.map(share, state)
    # Nothing passes between devices; the loops' first carries are constants, which the check of
    # what varies among devices doesn't accept.
    return jax.shard_map(
        run,
        mesh=mesh,
        in_specs=(whole, shares, frames_first, frames_first, whole),
        out_specs=(shares, PartitionSpec(None, None, None, axis), frames_first),
        check_vma=False,
    )(system, state, rotations, root, time)


def _diagnose(
    system: System,
    solver: Solver,
    state: State,
    displacement: Array,
    contexts: tuple[Any, ...],
    h: float,
    energies: bool,
) -> dict[str, Array]:
    """Diagnostics at the end of a frame, shapes [batch]."""
    finite = jnp.isfinite(state.position).all(axis=1)
    speed = jnp.sqrt(jnp.sum(state.velocity**2, axis=1))
    residual = solver.residual(system, contexts, displacement, state.solver_state, h)
    info = {
        "finite": finite.all(axis=0),
        "speed_max": speed.max(axis=0),
        # A non-finite vertex counts as the fastest.
        "worst_vertex": jnp.argmax(jnp.where(finite, speed, jnp.inf), axis=0),
        "residual_max": residual.max(axis=0),
        "residual_p99": upper_quantile(residual, 0.99),
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
