"""Air: drag against still air or wind, steady, gusting or turbulent."""

import dataclasses
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from ...geometry import vertex_faces
from ...typing import pytree
from .._assembly import Assembly, float32
from .._effect import Clock, Effect, Prepared


@dataclasses.dataclass(frozen=True)
class Air(Effect):
    """``a = -rho A / (2 m) |u| (C_n u_n + C_t u_t)`` with ``u`` the speed through the air.

    ``u_n`` is its part along the cloth's normal, ``u_t`` the rest. Normals and the
    wind's field are those at the start of a block. The step is implicit in ``|u|``, so
    that no wind is strong enough to make it unstable.

    Attributes:
        wind: Mean wind [m/s].
        gust: The mean wind swells and fades by this share.
        period: Of gusts [s].
        turbulence: Root mean square of the turbulent velocity [m/s].
        eddy: Size of the largest eddies [m].
        seed: Of the turbulence.
        density: Of air [kg/m^3].
        normal: Drag coefficient across the cloth [1].
        tangent: Along it [1].

    References:
        Flat plate across the flow: Hoerner, Fluid-dynamic drag (1965), chapter 3;
        turbulence as random divergence-free modes: Kraichnan (1970).
    """

    wind: tuple[float, float, float] = (0.0, 0.0, 0.0)
    gust: float = 0.0
    period: float = 2.0
    turbulence: float = 0.0
    eddy: float = 0.5
    seed: int = 0
    density: float = 1.2
    normal: float = 1.2
    tangent: float = 0.02

    def prepare(self, assembly: Assembly, inverse_mass: Array) -> Prepared:
        """Tables of faces around vertices; modes of turbulence if there is any."""
        x, f = assembly.rest, assembly.faces
        area = 0.5 * np.linalg.norm(
            np.cross(x[f[:, 1]] - x[f[:, 0]], x[f[:, 2]] - x[f[:, 0]]), axis=1
        )
        share = np.zeros(len(x))
        np.add.at(share, f, (area / 3)[:, None])
        around = vertex_faces(f, len(x))
        # The table repeats faces where a vertex has few; each counts once.
        count = np.bincount(f.ravel(), minlength=len(x))
        once = np.arange(around.shape[1])[None] < count[:, None]
        modes = None
        if self.turbulence > 0:
            rng = np.random.default_rng(self.seed)
            k = rng.normal(size=(_MODES, 3))
            k *= (
                2 * np.pi / self.eddy * 2.0 ** rng.uniform(0, 2, _MODES) / np.linalg.norm(k, axis=1)
            )[:, None]
            way = np.cross(k, rng.normal(size=(_MODES, 3)))
            way *= (self.turbulence * np.sqrt(2.0 / _MODES) / np.linalg.norm(way, axis=1))[:, None]
            rate = np.linalg.norm(k, axis=1) * max(self.turbulence, 1e-3)
            modes = (float32(k), float32(way), float32(rate), float32(rng.uniform(0, 6.28, _MODES)))
        return _Air(
            jnp.asarray(f),
            jnp.asarray(around),
            float32(once)[:, :, None, None],
            float32((0.5 * self.density * share / assembly.mass)[:, None, None]),
            modes,
            self,
        )


_MODES = 16


@pytree
@dataclasses.dataclass(frozen=True)
class _Air(Prepared):
    faces: Int[Array, "faces 3"]
    around: Int[Array, "vertices k"]
    once: Float[Array, "vertices k 1 1"]
    load: Float[Array, "vertices 1 1"]
    modes: tuple[Array, Array, Array, Array] | None
    law: Air = dataclasses.field(metadata={"static": True})

    def begin(
        self, base: Array, start: None, end: None, clock: Clock, memory: Any
    ) -> tuple[Array, Array]:
        a, b, c = (base[self.faces[:, k]] for k in range(3))
        normal = jnp.cross(b - a, c - a, axis=1)
        total = jnp.sum(normal[self.around] * self.once, axis=1)
        unit = total / jnp.sqrt(jnp.sum(total * total, axis=1, keepdims=True) + 1e-18)
        swell = 1.0 + self.law.gust * jnp.sin(2 * jnp.pi / self.law.period * clock.time)
        mean = jnp.asarray(self.law.wind, base.dtype)[None, :, None]
        wind = jnp.broadcast_to(swell * mean, base.shape)
        if self.modes is not None:
            k, way, rate, phase = self.modes
            # Eddies travel with the wind.
            seen = base - clock.time * mean
            angle = jnp.einsum("mc,vcb->vmb", k, seen, precision=jax.lax.Precision.HIGHEST)
            angle = angle - (rate * clock.time - phase)[None, :, None]
            wind = wind + jnp.einsum(
                "vmb,mc->vcb", jnp.cos(angle), way, precision=jax.lax.Precision.HIGHEST
            )
        return unit, wind

    def accelerate(self, velocity: Array, context: tuple[Array, Array], h: float) -> Array:
        unit, wind = context
        u = velocity - wind
        across = jnp.sum(u * unit, axis=1, keepdims=True) * unit
        speed = jnp.sqrt(jnp.sum(u * u, axis=1, keepdims=True) + 1e-12)
        slow = lambda c: 1.0 / (1.0 + h * self.load * c * speed)  # noqa: E731
        return wind + slow(self.law.normal) * across + slow(self.law.tangent) * (u - across)
