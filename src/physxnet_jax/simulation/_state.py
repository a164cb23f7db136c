"""The state of the cloth, and the scene on the device."""

import dataclasses
import math
from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from ..body import NUM_BODY_VERTICES, Body, blend_rotations, triangulate
from ..errors import SimulationError
from ..geometry import vertex_normals
from ..typing import pytree
from ._assembly import vertex_masses
from ._effect import PosedPoints, Prepared, Rest, SkinnedPoints

# Same precision as the skinning of the body.
_EXACT = jax.lax.Precision.HIGHEST


@pytree
@dataclasses.dataclass(frozen=True)
class State:
    """State of the cloth at one time.

    Attributes:
        position: Positions [m], shape [vertices, 3, batch].
        velocity: Velocities [m/s], shape [vertices, 3, batch].
        solver_state: Solver's data from earlier steps, see `Solver.init_state`.
        effect_state: State of each effect, see `Prepared.init_state`; None at the start.
    """

    position: Float[Array, "vertices 3 batch"]
    velocity: Float[Array, "vertices 3 batch"]
    solver_state: Any = ()
    effect_state: Any = None


@pytree
@dataclasses.dataclass(frozen=True)
class System:
    """A scene on the device.

    Attributes:
        body: The body.
        rest: Rest vertices of the body [m], shape [all, 3].
        effects: Prepared effects, in their order of application.
        inverse_mass: Inverse masses [1/kg], 0 for held vertices, shape [vertices, 1, 1].
        faces: Triangles of the cloth, shape [faces, 3].
        density: Their mass per area [kg/m^2], shape [faces].
        extra: The solver's tables, see `Solver.prepare`.
    """

    body: Body
    rest: Float[Array, "all 3"]
    effects: tuple[Prepared, ...]
    inverse_mass: Float[Array, "vertices 1 1"]
    faces: Int[Array, "faces 3"]
    density: Float[Array, " faces"]
    extra: Any = None

    def rescaled(self, **factors: Float[Array, ""] | float) -> "System":
        """The scene with scaled material parameters, differentiable in the factors.

        Args:
            **factors: Factors of the parameters ``stretch``, ``bend`` (stiffnesses) and
                ``friction`` (on the skin).

        Raises:
            SimulationError: An unknown parameter, one that no effect of the scene has, or
                a factor that isn't finite and positive (zero is valid for friction).

        Example:
            ``jax.grad(lambda k: loss(system.rescaled(bend=k)))``
        """
        names = {"stretch", "bend", "friction"}
        if set(factors) - names:
            raise SimulationError(
                f"Unknown parameter {', '.join(sorted(set(factors) - names))}; choose from"
                f" {', '.join(sorted(names))}."
            )
        for name in factors:
            if not any(name in e.materials for e in self.effects):
                raise SimulationError(
                    f"No effect of this scene has {name}, so its factor changes nothing. Leave it"
                    " out, or add the effect."
                )
        for name, factor in factors.items():
            _check_factor(name, factor)
        effects = tuple(e.rescaled(factors) for e in self.effects)
        # The solver's tables may depend on the materials.
        extra = self.extra.rescaled(effects) if hasattr(self.extra, "rescaled") else self.extra
        return dataclasses.replace(self, effects=effects, extra=extra)

    def reshaped(self, cloth: Float[Array, "vertices 3"], rest: Float[Array, "all 3"]) -> "System":
        """The scene with cloth of other measures on a body of another shape, differentiable.

        Lengths, areas, masses and the skin change; what was searched for when the scene was
        prepared stays: the patches of the skin that contact compares, and how much higher large
        triangles lie above features of the skin. Those depend on shape but little.

        Args:
            cloth: Rest positions of all garments' vertices [m], of the same meshes.
            rest: Rest vertices of the body [m].

        Raises:
            SimulationError: An effect of the scene, or its solver, can't be reshaped.
        """
        if self.extra is not None:
            raise SimulationError("This solver has tables of its own; prepare the scene anew.")
        mass = vertex_masses(cloth, self.faces, self.density)
        held = self.inverse_mass[:, 0, 0] == 0.0
        inverse = jnp.where(held, 0.0, 1.0 / mass)
        faces = triangulate(self.body.quads)
        normals = vertex_normals(rest[:NUM_BODY_VERTICES], jax.device_put(faces))
        new = Rest(cloth, rest, normals, inverse)
        return dataclasses.replace(
            self,
            rest=rest,
            effects=tuple(e.reshaped(new) for e in self.effects),
            inverse_mass=inverse[:, None, None],
        )


def _check_factor(name: str, factor: Any) -> None:
    """Raises if a concrete factor is invalid; zero stiffness has no gradient."""
    try:
        known = float(factor)
    # The value of a traced factor isn't known.
    except jax.errors.ConcretizationTypeError:
        return
    least = 0.0 if name == "friction" else 1e-9
    if not least <= known < math.inf:
        wanted = "a non-negative number" if name == "friction" else "a positive number"
        raise SimulationError(f"{name} is {known}, expected {wanted}, or leave the effect out.")


def place(
    skinned_points: SkinnedPoints,
    rotations: Float[Array, "batch joints 3 3"],
    translations: Float[Array, "batch joints 3"],
) -> PosedPoints:
    """Skins points with the body in a batch of poses, from world transforms of its joints."""

    def one(world: Array, shift: Array) -> tuple[Array, Array]:
        blend = blend_rotations(skinned_points.weights, world)
        points = jnp.einsum("vab,vb->va", blend, skinned_points.rest, precision=_EXACT)
        points = points + jnp.matmul(skinned_points.weights, shift, precision=_EXACT)
        return points, jnp.einsum("vab,vb->va", blend, skinned_points.normals, precision=_EXACT)

    points, normals = jax.vmap(one, out_axes=2)(rotations, translations)
    return PosedPoints(points, normals)
