"""The incremental potential: what cloth minimises over a step, without a solver."""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from ._effect import Clock, Prepared
from ._state import System


def incremental_potential(
    system: System,
    position: Float[Array, "vertices 3 batch"],
    before: Float[Array, "vertices 3 batch"],
    velocity: Float[Array, "vertices 3 batch"],
    *,
    length: float,
) -> Float[Array, " batch"]:
    """``sum m |x - y|^2 / (2 h^2) + E(x)`` with ``y = x_0 + h v``, v after external forces.

    Positions that minimise it are those of a step of backward Euler. As a loss it teaches a network
    the physics of cloth without any simulation. Gravity, air and elastic effects have a part in it;
    effects that need the skin, such as contact and pins, have none.

    Args:
        system: The scene, from `make_system`.
        position: Positions at the end of the step [m].
        before: Positions at its start [m].
        velocity: Velocities at its start [m/s].
        length: Length of the step [s].

    Returns:
        The potential [J].

    References:
        Martin et al., Example-based elastic materials (2011); Santesteban et al., SNUG:
        self-supervised neural dynamic garments (2022).
    """
    # Displacements from where the cloth is: energies stay accurate far from the origin.
    base = jax.lax.stop_gradient(position)
    displacement, after = position - base, velocity
    total = jnp.zeros(position.shape[2], position.dtype)
    clock = Clock(jnp.zeros((), position.dtype), length)
    for e in system.effects:
        pulls = type(e).accelerate is not Prepared.accelerate
        if e.skinned_points is not None or not (e.elastic or pulls):
            continue
        context = e.begin(base, None, None, clock, e.init_state(position.shape[2]))
        after = e.accelerate(after, context, length)
        energy = e.energy(displacement, context) if e.elastic else None
        total = total if energy is None else total + energy
    free = system.inverse_mass > 0
    mass = jnp.where(free, 1.0 / jnp.where(free, system.inverse_mass, 1.0), 0.0)
    # From differences, for the same reason.
    away = displacement + (base - before) - length * after
    return total + jnp.sum(mass * away * away, axis=(0, 1)) / (2.0 * length * length)
