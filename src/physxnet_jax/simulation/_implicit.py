"""Backward Euler and BDF2: Newton steps with block-sparse conjugate gradients."""

import dataclasses
from typing import TYPE_CHECKING, Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from ..errors import check_counts, check_numbers
from ..typing import pytree
from ._effect import Prepared
from ._solver import TOLERANCE, Solver, accelerate_all, split, stored_energy
from ._state import System

if TYPE_CHECKING:
    from ._scene import PreparedScene


@dataclasses.dataclass(frozen=True)
class Implicit(Solver):
    """Implicit steps: unconditionally stable for elastic forces, smooth gradients.

    Each Newton step solves a symmetric positive system by preconditioned conjugate
    gradients; backwards, the same system is solved once more instead of its iterations
    being unrolled. What only constrains (contact, pins, strain limits) is projected
    after the solve, which is first order.

    Attributes:
        order: 1 for backward Euler, 2 for BDF2.
        newton: Newton steps a substep; 1 is the linearly implicit method.
        iterations: At most so many conjugate gradient steps.
        tolerance: They stop at this residual relative to the right-hand side.

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

    def remember(self, velocity: Array, h: float) -> Any:
        worst = jnp.zeros((velocity.shape[0], velocity.shape[2]), velocity.dtype)
        # Without a past, the first step is one of backward Euler.
        return h * velocity, velocity, worst, jnp.ones((), velocity.dtype)

    def block(
        self,
        system: System,
        contexts: tuple[Any, ...],
        velocity: Array,
        memory: Any,
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

        def substep(i: Array, moving: tuple[Array, ...]) -> tuple[Array, ...]:
            d, v, step, before, _, young = moving
            two = (1.0 - young) if self.order == 2 else jnp.zeros_like(young)
            # The factor of the force in the step: x = y + f reach^2 / m.
            reach = h * (1.0 - two / 3)
            ahead = v + two * (v - before)
            push = (accelerate_all(system.effects, contexts, ahead, h) - ahead) / h
            goal = d + h * v + two * (step / 3 - h * (v + 2 * before) / 9)
            goal = goal + reach * reach * push
            progress = (i + 1).astype(d.dtype) * share
            # Held vertices stand where they are held; the others start where they are.
            x = d
            for e, c in rigid:
                if e.holds:
                    x = e.project(x, d, c, progress, (h, share))
            held = x
            worst = jnp.zeros((d.shape[0], d.shape[2]), d.dtype)
            if elastic:

                def newton(_: Array, at: tuple[Array, Array]) -> tuple[Array, Array]:
                    x = at[0]
                    slope = free * (mass * (x - goal) + reach * reach * jax.grad(stored)(x))
                    blocks = pattern.assemble(elastic, x, mass, reach)
                    block = pattern.diagonal(blocks, free)
                    stiff = jnp.trace(block, axis1=-2, axis2=-1) / 3
                    return x - free * self._solve(pattern, blocks, free, slope), stiff

                x, stiff = jax.lax.fori_loop(0, self.newton, newton, (x, worst))
                slope = free * (mass * (x - goal) + reach * reach * jax.grad(stored)(x))
                worst = jnp.sqrt(jnp.sum(slope * slope, axis=1)) / jnp.maximum(stiff, 1e-30)
            else:
                x = jnp.where(free > 0, goal, held)
            predicted = x
            for e, c in rigid:
                x = e.project(x, d, c, progress, (h, share))
            after = (predicted - d) / h + two * ((predicted - d) - step) / (2 * h)
            new = (x, after + (x - predicted) / h, x - d, v, worst)
            return *new, jnp.zeros_like(young)

        start = (jnp.zeros_like(velocity), velocity, *memory)
        d, v, *memory = jax.lax.fori_loop(0, count, substep, start)
        return d, v, tuple(memory)

    def _solve(self, pattern: "Pattern", blocks: Array, free: Array, right: Array) -> Array:
        """Conjugate gradients with the inverse of the diagonal blocks."""
        inverse = jnp.linalg.inv(jax.lax.stop_gradient(pattern.diagonal(blocks, free)))

        def matvec(p: Array) -> Array:
            return free * pattern.apply(blocks, free * p) + (1 - free) * p

        def precondition(r: Array) -> Array:
            return jnp.einsum("vbij,vjb->vib", inverse, r, precision=jax.lax.Precision.HIGHEST)

        def solve(apply: Any, b: Array) -> Array:
            dot = lambda a, c: jnp.sum(a * c, axis=(0, 1), keepdims=True)  # noqa: E731
            enough = self.tolerance**2 * dot(b, precondition(b))

            def going(s: tuple) -> Array:
                return (s[4] < self.iterations) & jnp.any(s[3] > enough)

            def step(s: tuple) -> tuple:
                x, r, p, rz, n = s
                ap = apply(p)
                curve = dot(p, ap)
                # A batch member that is done, or breaks down, stands still.
                alpha = jnp.where(curve > 0, rz / jnp.where(curve > 0, curve, 1.0), 0.0)
                x, r = x + alpha * p, r - alpha * ap
                z = precondition(r)
                new = dot(r, z)
                beta = jnp.where(rz > 0, new / jnp.where(rz > 0, rz, 1.0), 0.0)
                return x, r, z + beta * p, new, n + 1

            z = precondition(b)
            state = (jnp.zeros_like(b), b, z, dot(b, z), jnp.zeros((), jnp.int32))
            return jax.lax.while_loop(going, step, state)[0]

        return jax.lax.custom_linear_solve(matvec, right, solve, symmetric=True)

    def residual(
        self,
        system: System,
        contexts: tuple[Any, ...],
        displacement: Array,
        memory: Any,
        h: float,
    ) -> Array:
        """How far another Newton step would move each vertex, over the tolerance."""
        return memory[2] / TOLERANCE


@pytree
@dataclasses.dataclass(frozen=True)
class Pattern:
    """Where the blocks of the system matrix lie: rows of equal length.

    Attributes:
        neighbour: Vertices coupled to each, itself first, shape [vertices, k].
        slots: For each elastic effect, the places of its blocks, shape [blocks].
        constant: Constant multiples of the identity, shape [vertices, k].
    """

    neighbour: Int[Array, "vertices k"]
    slots: tuple[Int[Array, " blocks"], ...]
    constant: Float[Array, "vertices k"]

    def rescaled(self, effects: tuple[Prepared, ...]) -> "Pattern":
        """With the constant blocks of effects whose materials have changed."""
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
        """``M + h'^2 K`` at displacements x, K positive semidefinite."""
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
        around = p[self.neighbour].transpose(0, 3, 1, 2).reshape(rows, p.shape[2], 3 * k)
        return jnp.einsum("vbim,vbm->vib", blocks, around, precision=jax.lax.Precision.HIGHEST)

    def diagonal(self, blocks: Array, free: Array) -> Float[Array, "vertices batch 3 3"]:
        """The diagonal blocks; the identity for held vertices, whose own may be singular."""
        eye = jnp.eye(3, dtype=blocks.dtype)[None, None]
        return jnp.where(free[..., None] > 0, blocks[..., :3], eye)


def _pattern(scene: "PreparedScene") -> Pattern:
    count = len(scene.assembly.rest)
    elastic = [e for e in scene.effects if e.elastic]
    pairs = [np.asarray(e.coupled(), np.int64).reshape(-1, 2) for e in elastic]
    own = np.repeat(np.arange(count)[:, None], 2, axis=1)
    every = np.unique(np.concatenate([own, *pairs]), axis=0)
    # Each row's own block first.
    every = every[np.lexsort((every[:, 1], every[:, 0] != every[:, 1], every[:, 0]))]
    start = np.searchsorted(every[:, 0], np.arange(count))
    place = np.arange(len(every)) - start[every[:, 0]]
    width = int(place.max()) + 1
    neighbour = np.repeat(np.arange(count)[:, None], width, axis=1)
    neighbour[every[:, 0], place] = every[:, 1]
    key = every[:, 0] * count + every[:, 1]
    order = np.argsort(key)

    def slot(p: np.ndarray) -> np.ndarray:
        at = order[np.searchsorted(key[order], p[:, 0] * count + p[:, 1])]
        return p[:, 0] * width + place[at]

    slots = tuple(jnp.asarray(slot(p)) for p in pairs)
    nothing = jnp.zeros((count, width), jnp.float32)
    return Pattern(jnp.asarray(neighbour), slots, nothing).rescaled(scene.effects)
