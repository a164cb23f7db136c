"""Backward Euler and BDF2: Newton steps with block-sparse conjugate gradients."""

import dataclasses
from typing import TYPE_CHECKING, Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from ..errors import SimulationError, check_counts, check_numbers
from ..typing import pytree
from ._effect import Prepared, Step
from ._solver import TOLERANCE, Solver, accelerate_all, split, stored_energy
from ._state import System

if TYPE_CHECKING:
    from ._prepared_scene import PreparedScene


@dataclasses.dataclass(frozen=True)
class Implicit(Solver):
    """Implicit steps: unconditionally stable for elastic forces, smooth gradients.

    Each Newton step solves a symmetric positive definite system by preconditioned
    conjugate gradients. The backward pass solves the same system once more instead of
    unrolling the iterations. Effects that only constrain (contact, pins, strain limits)
    are projected after the solve, which is first order.

    Attributes:
        order: 1 for backward Euler, 2 for BDF2.
        newton: Newton steps per substep; 1 is the linearly implicit method.
        iterations: Maximum number of conjugate gradient iterations.
        tolerance: Residual, relative to the right-hand side, at which they stop.

    References:
        Baraff and Witkin, Large steps in cloth simulation (1998); Choi and Ko, Stable
        but responsive cloth (2002) for BDF2.
    """

    substeps: int = 8
    order: int = 2
    newton: int = 1
    iterations: int = 60
    tolerance: float = 1e-4

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.order not in (1, 2):
            raise ValueError(f"order {self.order} is neither 1 (backward Euler) nor 2 (BDF2).")
        check_counts(self, "newton", "iterations")
        check_numbers(self, "tolerance")

    def prepare(self, scene: "PreparedScene") -> "Pattern":
        """The sparsity pattern of the scene's elastic effects."""
        return _pattern(scene)

    def init_state(self, velocity: Array, h: float) -> Any:
        worst = jnp.zeros((velocity.shape[0], velocity.shape[2]), velocity.dtype)
        # The first step has no history, so it is a backward Euler step.
        return h * velocity, velocity, worst, jnp.ones((), velocity.dtype)

    def advance_interval(
        self,
        system: System,
        contexts: tuple[Any, ...],
        velocity: Array,
        solver_state: Any,
        h: float,
        count: int,
    ) -> tuple[Array, Array, Any]:
        elastic, rigid = split(system.effects, contexts)
        share = 1.0 / count
        free = (system.inverse_mass > 0).astype(velocity.dtype)
        mass = free / jnp.where(free > 0, system.inverse_mass, 1.0)
        pattern: Pattern = system.extra

        def stored(x: Array) -> Array:
            return stored_energy(elastic, x)

        def substep(i: Array, carry: tuple[Array, ...]) -> tuple[Array, ...]:
            d, v, step, before, _, first_step = carry
            bdf2 = (1.0 - first_step) if self.order == 2 else jnp.zeros_like(first_step)
            # Effective step: x = y + f reach^2 / m.
            reach = h * (1.0 - bdf2 / 3)
            ahead = v + bdf2 * (v - before)
            acceleration = (accelerate_all(system.effects, contexts, ahead, h) - ahead) / h
            target = d + h * v + bdf2 * (step / 3 - h * (v + 2 * before) / 9)
            target = target + reach * reach * acceleration
            progress = (i + 1).astype(d.dtype) * share
            # Initial guess: prescribed positions of held vertices, current ones of the others.
            x = d
            for e, c in rigid:
                if e.kinematic:
                    x = e.project(x, d, c, progress, Step(h, share))
            held = x
            worst = jnp.zeros((d.shape[0], d.shape[2]), d.dtype)
            if elastic:

                def newton(_: Array, at: tuple[Array, Array]) -> tuple[Array, Array]:
                    x = at[0]
                    gradient = free * (mass * (x - target) + reach * reach * jax.grad(stored)(x))
                    blocks = pattern.assemble(elastic, x, mass, reach)
                    block = pattern.diagonal(blocks, free)
                    stiff = jnp.trace(block, axis1=-2, axis2=-1) / 3
                    return x - free * self._solve(pattern, blocks, free, gradient), stiff

                x, stiff = jax.lax.fori_loop(0, self.newton, newton, (x, worst))
                gradient = free * (mass * (x - target) + reach * reach * jax.grad(stored)(x))
                worst = jnp.sqrt(jnp.sum(gradient * gradient, axis=1)) / jnp.maximum(stiff, 1e-30)
            else:
                x = jnp.where(free > 0, target, held)
            predicted = x
            for e, c in rigid:
                x = e.project(x, d, c, progress, Step(h, share))
            after = (predicted - d) / h + bdf2 * ((predicted - d) - step) / (2 * h)
            new = (x, after + (x - predicted) / h, x - d, v, worst)
            return *new, jnp.zeros_like(first_step)

        start = (jnp.zeros_like(velocity), velocity, *solver_state)
        d, v, *solver_state = jax.lax.fori_loop(0, count, substep, start)
        return d, v, tuple(solver_state)

    def _solve(self, pattern: "Pattern", blocks: Array, free: Array, right: Array) -> Array:
        """Conjugate gradients with the inverse of the diagonal blocks."""
        inverse = jnp.linalg.inv(jax.lax.stop_gradient(pattern.diagonal(blocks, free)))

        def matvec(p: Array) -> Array:
            return free * pattern.apply(blocks, free * p) + (1 - free) * p

        def precondition(r: Array) -> Array:
            return jnp.einsum("vbij,vjb->vib", inverse, r, precision=jax.lax.Precision.HIGHEST)

        def solve(apply: Any, b: Array) -> Array:
            dot = lambda a, c: jnp.sum(a * c, axis=(0, 1), keepdims=True)  # noqa: E731
            threshold = self.tolerance**2 * dot(b, precondition(b))

            def unconverged(s: tuple) -> Array:
                return (s[4] < self.iterations) & jnp.any(s[3] > threshold)

            def step(s: tuple) -> tuple:
                x, r, p, rz, n = s
                ap = apply(p)
                curvature = dot(p, ap)
                # A batch member that has converged or broken down keeps its solution, however
                # long the others take.
                going = (rz > threshold) & (curvature > 0)
                alpha = rz / jnp.where(going, curvature, 1.0)
                ahead, left = x + alpha * p, r - alpha * ap
                z = precondition(left)
                new = dot(left, z)
                beta = new / jnp.where(going, rz, 1.0)
                found = (ahead, left, z + beta * p, new)
                # Of rank 3 all: members are the last axis. Broken ones end.
                kept = [jnp.where(going, a, b) for a, b in zip(found, (x, r, p, rz), strict=True)]
                kept[3] = jnp.where(going, new, jnp.minimum(rz, threshold))
                return *kept, n + 1

            z = precondition(b)
            state = (jnp.zeros_like(b), b, z, dot(b, z), jnp.zeros((), jnp.int32))
            return jax.lax.while_loop(unconverged, step, state)[0]

        return jax.lax.custom_linear_solve(matvec, right, solve, symmetric=True)

    def residual(
        self,
        system: System,
        contexts: tuple[Any, ...],
        displacement: Array,
        solver_state: Any,
        h: float,
    ) -> Array:
        """Distance that another Newton step would move each vertex, over the tolerance."""
        return solver_state[2] / TOLERANCE


@pytree
@dataclasses.dataclass(frozen=True)
class Pattern:
    """Sparsity pattern of the system matrix in 3x3 blocks, with rows of equal length.

    Attributes:
        neighbour: Vertices coupled to each vertex, itself first, shape [vertices, k].
        slots: Flat positions of the blocks of each elastic effect, shapes [blocks].
        constant: Sums of constant multiples of the identity, shape [vertices, k].
    """

    neighbour: Int[Array, "vertices k"]
    slots: tuple[Int[Array, " blocks"], ...]
    constant: Float[Array, "vertices k"]

    def rescaled(self, effects: tuple[Prepared, ...]) -> "Pattern":
        """The pattern with the constant blocks of effects with other materials."""
        elastic = [e for e in effects if e.elastic]
        fixed = [e.constant_stiffness() for e in elastic]
        total = jnp.zeros(self.constant.size, self.constant.dtype)
        for slot, values in zip(self.slots, fixed, strict=True):
            if values is not None:
                total = total.at[slot].add(values.astype(total.dtype))
        return dataclasses.replace(self, constant=total.reshape(self.constant.shape))

    def assemble(
        self, elastic: list, x: Array, mass: Array, reach: Array
    ) -> Float[Array, "vertices batch 3 k3"]:
        """``M + h'^2 K`` at displacements x, with K positive semidefinite."""
        rows, k = self.neighbour.shape
        batch = x.shape[2]
        total = jnp.zeros((rows * k, batch, 3, 3), x.dtype)
        for (e, c), slot in zip(elastic, self.slots, strict=True):
            values = e.hessian(x, c)
            if values is not None:
                total = total.at[slot].add(values)
        scalar = (reach * reach * self.constant).at[:, 0].add(mass[:, 0, 0])
        eye = jnp.eye(3, dtype=x.dtype)[None, None]
        total = reach * reach * total + scalar.reshape(-1, 1, 1, 1) * eye
        total = total.reshape(rows, k, batch, 3, 3).transpose(0, 2, 3, 1, 4)
        return total.reshape(rows, batch, 3, 3 * k)

    def apply(self, blocks: Array, p: Array) -> Array:
        """The matrix times a vector of shape [vertices, 3, batch]."""
        rows, k = self.neighbour.shape
        neighbours = p[self.neighbour].transpose(0, 3, 1, 2).reshape(rows, p.shape[2], 3 * k)
        return jnp.einsum("vbim,vbm->vib", blocks, neighbours, precision=jax.lax.Precision.HIGHEST)

    def diagonal(self, blocks: Array, free: Array) -> Float[Array, "vertices batch 3 3"]:
        """The diagonal blocks; the identity for held vertices, whose blocks may be singular."""
        eye = jnp.eye(3, dtype=blocks.dtype)[None, None]
        return jnp.where(free[..., None] > 0, blocks[..., :3], eye)


def _pattern(scene: "PreparedScene") -> Pattern:
    count = len(scene.assembly.rest)
    elastic = [e for e in scene.effects if e.elastic]
    for e in elastic:
        values = (type(e).hessian, type(e).constant_stiffness)
        nothing = values == (Prepared.hessian, Prepared.constant_stiffness)
        if nothing or type(e).coupled is Prepared.coupled:
            raise SimulationError(
                f"{type(e).__name__.lstrip('_')} stores energy but does not implement `coupled`"
                " and `hessian`, which Implicit requires. Implement them, or choose XPBD or Verlet."
            )
    pairs = [np.asarray(e.coupled(), np.int64).reshape(-1, 2) for e in elastic]
    own = np.repeat(np.arange(count)[:, None], 2, axis=1)
    every = np.unique(np.concatenate([own, *pairs]), axis=0)
    # The diagonal block comes first in each row.
    every = every[np.lexsort((every[:, 1], every[:, 0] != every[:, 1], every[:, 0]))]
    start = np.searchsorted(every[:, 0], np.arange(count))
    column = np.arange(len(every)) - start[every[:, 0]]
    width = int(column.max()) + 1
    neighbour = np.repeat(np.arange(count)[:, None], width, axis=1)
    neighbour[every[:, 0], column] = every[:, 1]
    key = every[:, 0] * count + every[:, 1]
    order = np.argsort(key)

    def slot(p: np.ndarray) -> np.ndarray:
        at = order[np.searchsorted(key[order], p[:, 0] * count + p[:, 1])]
        return p[:, 0] * width + column[at]

    slots = tuple(jax.device_put(slot(p)) for p in pairs)
    nothing = jnp.zeros((count, width), jnp.float32)
    return Pattern(jax.device_put(neighbour), slots, nothing).rescaled(scene.effects)
