"""XPBD with small steps: one coloured Gauss-Seidel sweep a substep."""

import dataclasses
import functools

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from ..body import Body, blend_rotations
from ..typing import pytree
from ._effect import Attached, Placed, Prepared


@dataclasses.dataclass(frozen=True)
class XPBD:
    """Settings of the solver.

    Attributes:
        substeps: Substeps a frame; first order in their number.
        queries: Blocks a frame: how often contact looks for the closest skin.
    """

    substeps: int = 32
    queries: int = 4

    def __post_init__(self) -> None:
        if self.queries < 1 or self.substeps % self.queries:
            raise ValueError(
                f"substeps {self.substeps} must be a multiple of queries {self.queries}."
            )


@pytree
@dataclasses.dataclass(frozen=True)
class State:
    """Cloth in motion.

    Attributes:
        position: Positions [m], shape [vertices, 3, batch].
        velocity: Velocities [m/s], shape [vertices, 3, batch].
    """

    position: Float[Array, "vertices 3 batch"]
    velocity: Float[Array, "vertices 3 batch"]


def place(
    body: Body,
    rest: Float[Array, "all 3"],
    attached: Attached,
    rotations: Float[Array, "batch joints 4"],
    root: Float[Array, "batch 3"],
) -> Placed:
    """Attached points skinned with the body in a batch of poses."""

    def one(q: Array, p: Array) -> tuple[Array, Array]:
        world, shift = body.transforms(rest, q, p)
        blend = blend_rotations(attached.weights, world)
        points = jnp.einsum("vab,vb->va", blend, attached.rest) + attached.weights @ shift
        return points, jnp.einsum("vab,vb->va", blend, attached.normals)

    points, normals = jax.vmap(one, out_axes=2)(rotations, root)
    return Placed(points, normals)


@functools.partial(jax.jit, static_argnames=("solver", "fps"))
def advance(
    body: Body,
    rest: Float[Array, "all 3"],
    effects: tuple[Prepared, ...],
    state: State,
    rotations: Float[Array, "frames batch joints 4"],
    root: Float[Array, "frames batch 3"],
    *,
    solver: XPBD,
    fps: float,
) -> tuple[State, Float[Array, "later vertices 3 batch"], dict[str, Array]]:
    """Rolls the cloth through frames 1, 2, ... from its state at frame 0.

    Velocities come from the corrections of a substep, not from differences of
    positions, and positions are kept relative to where the block began: float32 then
    stays accurate however small the substep and however far the origin.

    Args:
        body: The body.
        rest: Its rest vertices [m].
        effects: Prepared effects.
        state: Cloth at frame 0.
        rotations: Poses of all frames, wxyz.
        root: Hips positions of all frames [m].
        solver: Substeps and queries.
        fps: Frames a second.

    Returns:
        The last state, positions of frames 1 and later, and diagnostics of each frame.

    References:
        Macklin et al., Small steps in physics simulation (2019), algorithm 1.
    """
    per_block = solver.substeps // solver.queries
    h = 1.0 / (fps * solver.substeps)
    share = 1.0 / per_block

    def skin(q: Array, p: Array) -> tuple[Placed | None, ...]:
        return tuple(
            None if e.attached is None else place(body, rest, e.attached, q, p) for e in effects
        )

    def block(carry: tuple, k: Array) -> tuple[tuple, None]:
        state, _, _, before, after = carry
        start = jax.tree.map(lambda a, b: a + (k / solver.queries) * (b - a), before, after)
        end = jax.tree.map(lambda a, b: a + ((k + 1) / solver.queries) * (b - a), before, after)
        base = state.position
        contexts = tuple(e.begin(base, s, t) for e, s, t in zip(effects, start, end, strict=True))

        def substep(i: Array, moving: tuple[Array, Array]) -> tuple[Array, Array]:
            d, v = moving
            for e in effects:
                v = e.accelerate(v, h)
            predicted = d + h * v
            progress = (i + 1).astype(d.dtype) * share
            x = predicted
            for e, context in zip(effects, contexts, strict=True):
                x = e.project(x, d, context, progress, (h, share))
            return x, v + (x - predicted) / h

        d, v = jax.lax.fori_loop(0, per_block, substep, (jnp.zeros_like(base), state.velocity))
        return (State(base + d, v), d, contexts, before, after), None

    def frame(carry: tuple, pose: tuple[Array, Array]) -> tuple[tuple, tuple]:
        state, before = carry
        after = skin(*pose)
        # The loop's carry needs the contexts' shapes; the first block fills them.
        shapes = jax.eval_shape(
            lambda x, at: tuple(e.begin(x, s, s) for e, s in zip(effects, at, strict=True)),
            state.position,
            before,
        )
        contexts = jax.tree.map(lambda s: jnp.zeros(s.shape, s.dtype), shapes)
        start = (state, jnp.zeros_like(state.position), contexts, before, after)
        steps = jnp.arange(solver.queries, dtype=state.position.dtype)
        (state, d, contexts, _, _), _ = jax.lax.scan(block, start, steps)
        diagnostics = {"finite": jnp.isfinite(state.position).all(axis=(0, 1))}
        speed = jnp.sqrt(jnp.sum(state.velocity**2, axis=1)).max(axis=0)
        diagnostics["speed_max"] = speed
        for e, context in zip(effects, contexts, strict=True):
            diagnostics |= e.diagnose(d, context)
        return (state, after), (state.position, diagnostics)

    first = skin(rotations[0], root[0])
    (state, _), (positions, diagnostics) = jax.lax.scan(
        frame, (state, first), (rotations[1:], root[1:])
    )
    return state, positions, diagnostics
