"""Air: drag in still air or in steady, gusting or turbulent wind."""

import dataclasses
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int
from scipy.spatial import KDTree

from ...body import NUM_BODY_VERTICES, triangulate
from ...errors import check_numbers, check_vector
from ...geometry import materialize, spread_points, vertex_faces, vertex_normals
from ...typing import pytree
from .._assembly import Assembly, float32
from .._effect import Clock, Effect, PosedPoints, Prepared, SkinnedPoints


@dataclasses.dataclass(frozen=True)
class Air(Effect):
    """``a = -rho A / (2 m) |u| (C_n u_n + C_t u_t)`` with ``u`` the velocity in the air.

    ``u_n`` is the part of ``u`` along the cloth's normal, ``u_t`` the rest. Normals and the
    wind field are those at the start of a contact interval. The step is linearly implicit in
    ``u``, so it is stable in any wind.

    Cloth near skin that faces away from the wind lies in the lee of the body: there the mean
    wind is weaker, and weakest at the skin. This doesn't model the flow around a body. Without
    it, cloth on the lee side would be blown off the skin as hard as cloth on the windward side
    is pressed onto it.

    Attributes:
        wind: Mean wind [m/s].
        gust: Amplitude of the gusts, relative to the mean wind [1].
        period: Period of the gusts [s].
        turbulence: Root mean square of the turbulent velocity [m/s].
        eddy: Size of the largest eddies [m]; turbulence repeats every 16 m.
        seed: Random seed of the turbulence.
        density: Density of the air [kg/m^3].
        normal: Drag coefficient normal to the cloth [1].
        tangent: Drag coefficient along the cloth [1].
        shelter: Share of the mean wind that is blocked at skin that faces straight away
            from it [1].

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
    shelter: float = 0.9

    def __post_init__(self) -> None:
        check_vector(self, "wind")
        check_numbers(self, "period", "eddy")
        check_numbers(
            self, "gust", "turbulence", "density", "normal", "tangent", "shelter", zero=True
        )
        if self.shelter > 1.0:
            raise ValueError(f"shelter is {self.shelter}, expected a share from 0 to 1")

    def idle(self, assembly: Assembly) -> bool:
        """In a vacuum, or without drag."""
        return self.density == 0.0 or self.normal == self.tangent == 0.0

    def prepare(self, assembly: Assembly, inverse_mass: Array) -> Prepared:
        """Builds tables of the faces around vertices, and modes if there is turbulence."""
        x, f = assembly.rest, assembly.faces
        area = 0.5 * np.linalg.norm(
            np.cross(x[f[:, 1]] - x[f[:, 0]], x[f[:, 2]] - x[f[:, 0]]), axis=1
        )
        share = np.zeros(len(x))
        np.add.at(share, f, (area / 3)[:, None])
        around = vertex_faces(f, len(x))
        # The table repeats faces of vertices that have few; each must count once.
        count = np.bincount(f.ravel(), minlength=len(x))
        once = np.arange(around.shape[1])[None] < count[:, None]
        modes = None
        if self.turbulence > 0:
            rng = np.random.default_rng(self.seed)
            k = rng.normal(size=(_MODES, 3))
            k *= (
                2 * np.pi / self.eddy * 2.0 ** rng.uniform(0, 2, _MODES) / np.linalg.norm(k, axis=1)
            )[:, None]
            # Whole waves in the distance of repetition; eddies as large as that aren't repeated.
            whole = np.round(k * TURBULENCE_PERIOD / (2 * np.pi))
            k = np.where(whole.any(axis=1)[:, None], whole * 2 * np.pi / TURBULENCE_PERIOD, k)
            way = np.cross(k, rng.normal(size=(_MODES, 3)))
            way *= (self.turbulence * np.sqrt(2.0 / _MODES) / np.linalg.norm(way, axis=1))[:, None]
            rate = np.linalg.norm(k, axis=1) * max(self.turbulence, 1e-3)
            modes = (float32(k), float32(way), float32(rate), float32(rng.uniform(0, 6.28, _MODES)))
        return _Air(
            jax.device_put(f),
            jax.device_put(around),
            float32(once)[:, :, None, None],
            float32((0.5 * self.density * share / assembly.mass)[:, None, None]),
            modes,
            self._lee(assembly),
            self,
        )

    def _lee(self, assembly: Assembly) -> "_Lee | None":
        """Skin points that may shelter each vertex; None without wind or near skin."""
        if not (any(self.wind) and self.shelter > 0):
            return None
        skin = assembly.rest_body[:NUM_BODY_VERTICES]
        samples = spread_points(skin, _SPACING)
        far, near = KDTree(skin[samples]).query(assembly.rest, k=_NEIGHBOURS)
        if far.min() > _REACH:
            return None
        used, local = np.unique(near, return_inverse=True)
        rows = samples[used]
        faces = np.asarray(triangulate(assembly.body.quads))
        skinned_points = SkinnedPoints(
            float32(skin[rows]),
            float32(vertex_normals(skin, faces)[rows]),
            assembly.body.weights[jax.device_put(rows)],
        )
        return _Lee(skinned_points, jax.device_put(local.reshape(near.shape).astype(np.int32)))


_MODES = 16
TURBULENCE_PERIOD = 16.0
"""Distance along the axes at which the same turbulence comes again [m]."""
# Distance between skin samples [m], number of samples per vertex, and reach of their lee [m].
_SPACING, _NEIGHBOURS, _REACH = 0.05, 4, 0.15


@pytree
@dataclasses.dataclass(frozen=True)
class _Lee:
    skin: SkinnedPoints
    near: Int[Array, "vertices k"]

    def shade(self, base: Array, placed: PosedPoints, wind: tuple[float, ...]) -> Array:
        """Sheltering of each vertex, from 0 to 1, shape [vertices, 1, batch]."""
        way = np.asarray(wind) / np.linalg.norm(wind)
        gap = placed.points[self.near] - base[:, None]
        # Computed once: the gradient of `min` compares for equality.
        squared = materialize(jnp.sum(gap * gap, axis=2))
        facing = jnp.sum(placed.normals * jnp.asarray(way, base.dtype)[None, :, None], axis=1)
        least = jnp.min(squared, axis=1, keepdims=True)
        # Average the normals of all nearly closest samples; a single one would cause jumps.
        share = jnp.exp((least - squared) / (2 * (0.5 * _SPACING) ** 2))
        away = jnp.sum(share * facing[self.near], axis=1) / jnp.sum(share, axis=1)
        distance = jnp.sqrt(least[:, 0] + 1e-12)
        return (jnp.clip(away, 0.0, 1.0) * jnp.clip(1.0 - distance / _REACH, 0.0, 1.0))[:, None]


@pytree
@dataclasses.dataclass(frozen=True)
class _Air(Prepared):
    faces: Int[Array, "faces 3"]
    around: Int[Array, "vertices k"]
    once: Float[Array, "vertices k 1 1"]
    load: Float[Array, "vertices 1 1"]
    modes: tuple[Array, Array, Array, Array] | None
    lee: _Lee | None
    law: Air = dataclasses.field(metadata={"static": True})

    @property
    def skinned_points(self) -> SkinnedPoints | None:
        return None if self.lee is None else self.lee.skin

    def begin(
        self,
        base: Array,
        start: PosedPoints | None,
        end: PosedPoints | None,
        clock: Clock,
        state: Any,
    ) -> tuple[Array, Array | None]:
        a, b, c = (base[self.faces[:, k]] for k in range(3))
        normal = jnp.cross(b - a, c - a, axis=1)
        total = jnp.sum(normal[self.around] * self.once, axis=1)
        unit = total / jnp.sqrt(jnp.sum(total * total, axis=1, keepdims=True) + 1e-18)
        wind, moving_frame = None, base
        if any(self.law.wind):
            mean = jnp.asarray(self.law.wind, base.dtype)[None, :, None]
            # Eddies move with the wind.
            moving_frame = base - clock.time * mean
            if self.law.gust:
                pulse = jnp.sin(2 * jnp.pi / self.law.period * clock.time)
                mean = (1.0 + self.law.gust * pulse) * mean
            wind = jnp.broadcast_to(mean, base.shape)
        if wind is not None and self.lee is not None and start is not None:
            wind = wind * (1.0 - self.law.shelter * self.lee.shade(base, start, self.law.wind))
        if self.modes is not None:
            k, way, rate, phase = self.modes
            angle = jnp.einsum("mc,vcb->vmb", k, moving_frame, precision=jax.lax.Precision.HIGHEST)
            angle = angle - (rate * clock.time - phase)[None, :, None]
            eddies = jnp.einsum(
                "vmb,mc->vcb", jnp.cos(angle), way, precision=jax.lax.Precision.HIGHEST
            )
            wind = eddies if wind is None else wind + eddies
        return unit, wind

    def accelerate(self, velocity: Array, context: tuple[Array, Array | None], h: float) -> Array:
        unit, wind = context
        u = velocity if wind is None else velocity - wind
        across = jnp.sum(u * unit, axis=1, keepdims=True) * unit
        speed = jnp.sqrt(jnp.sum(u * u, axis=1, keepdims=True) + 1e-12)

        def slowed(part: Array, drag: float) -> Array:
            return part * (1.0 / (1.0 + h * self.load * drag * speed)) if drag else part

        left = slowed(across, self.law.normal) + slowed(u - across, self.law.tangent)
        return left if wind is None else wind + left
