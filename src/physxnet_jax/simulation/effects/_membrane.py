"""Membrane: triangles resist stretch along warp and weft, and shear between them."""

import dataclasses
from collections.abc import Mapping
from typing import Any

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from ...errors import check_numbers
from ...typing import pytree
from .._assembly import Assembly
from .._effect import Effect, Prepared, Rest
from ._colored import Colored, Constraint, Group, color_constraints, directed
from ._hinge import sound
from ._strain_report import strain_report


@dataclasses.dataclass(frozen=True)
class Membrane(Effect):
    """``E = 1/2 sum A (Y_u (|w_u|-1)^2 + Y_v (|w_v|-1)^2 + G s^2)`` over triangles.

    ``w_u`` and ``w_v`` are the images of the warp and weft directions. ``s`` is their
    inner product over their lengths, the sine of the shear angle. Unlike springs along
    edges (`Stretch`), the three stiffnesses don't depend on the triangulation.

    Attributes:
        compression: Stiffness in compression relative to that in tension [1].

    References:
        Baraff and Witkin, Large steps in cloth simulation (1998), section 4.2 (shear
        here by angle); Macklin et al., XPBD (2016).
    """

    compression: float = 0.2

    def __post_init__(self) -> None:
        check_numbers(self, "compression")

    def prepare(self, assembly: Assembly, inverse_mass: Array) -> Prepared:
        """Colours the triangles, except slivers."""
        faces, area, inverse = rest_frames(assembly)
        usable = sound(assembly.rest, faces)
        a = area[usable]
        fabric = assembly.membrane[usable]
        law = {
            "u1": inverse[usable, 0, 0],
            "u2": inverse[usable, 1, 0],
            "v1": inverse[usable, 0, 1],
            "v2": inverse[usable, 1, 1],
            "warp": 1.0 / np.maximum(a * fabric[:, 0], 1e-9),
            "weft": 1.0 / np.maximum(a * fabric[:, 1], 1e-9),
            "shear": 1.0 / np.maximum(a * fabric[:, 2], 1e-9),
            "area": a,
        }
        group = color_constraints(faces[usable], np.asarray(inverse_mass), law)
        return _Membrane(group, 1.0 / self.compression)


def rest_frames(
    assembly: Assembly,
) -> tuple[Int[np.ndarray, "faces 3"], Float[np.ndarray, " faces"], Float[np.ndarray, "faces 2 2"]]:
    """Faces, their areas [m^2] and inverse edge matrices in warp and weft axes [1/m].

    The warp is the projection of the vertical axis at rest, or of the depth axis for
    level triangles.
    """
    x, f = assembly.rest, assembly.faces
    return f, *_frames(x[f[:, 0]], x[f[:, 1]], x[f[:, 2]], xp=np)


def _frames(a: Any, b: Any, c: Any, xp: Any) -> tuple[Any, Any]:
    """Areas and inverse edge matrices of triangles, by numpy or jax.numpy."""

    def length(v: Any) -> Any:
        return xp.sqrt(xp.maximum(xp.sum(v * v, axis=1), 1e-24))

    e1, e2 = b - a, c - a
    normal = xp.cross(e1, e2)
    twice = length(normal)
    n = normal / twice[:, None]
    up, ahead = (xp.asarray(np.eye(3)[k : k + 1], a.dtype) for k in (1, 2))
    warp = up - n * n[:, 1:2]
    warp = xp.where((length(warp) < 0.2)[:, None], ahead - n * n[:, 2:3], warp)
    warp = warp / length(warp)[:, None]
    weft = xp.cross(n, warp)
    one, two = ([xp.sum(e * way, axis=1) for e in (e1, e2)] for way in (warp, weft))
    edges = xp.stack([xp.stack(one, axis=1), xp.stack(two, axis=1)], axis=1)
    safe = xp.where((twice > 1e-10)[:, None, None], edges, xp.asarray(np.eye(2)[None], a.dtype))
    return 0.5 * twice, xp.linalg.inv(safe)


@pytree
@dataclasses.dataclass(frozen=True)
class _Membrane(Colored):
    group: Group
    softer: float = dataclasses.field(metadata={"static": True})
    materials = ("stretch",)

    def rescaled(self, factors: Mapping[str, Any]) -> Prepared:
        if "stretch" not in factors:
            return self
        law = dict(self.group.law)
        law |= {k: law[k] / factors["stretch"] for k in ("warp", "weft", "shear")}
        return dataclasses.replace(self, group=dataclasses.replace(self.group, law=law))

    def reshaped(self, rest: Rest) -> Prepared:
        law = self.group.law
        area, inverse = _frames(*(rest.cloth[i] for i in self.group.index), xp=jnp)
        area = area[:, None, None]
        entries = {"u1": (0, 0), "u2": (1, 0), "v1": (0, 1), "v2": (1, 1)}
        law = {
            **{k: inverse[:, i, j, None, None] for k, (i, j) in entries.items()},
            **{k: law[k] * (law["area"] / area) for k in ("warp", "weft", "shear")},
            "area": area,
        }
        return dataclasses.replace(self, group=self.group.reshaped(rest, law))

    def measure(self, law: Any, corners: tuple[Array, ...]) -> list[Any]:
        def direction(one: str, two: str, compliance: str) -> Any:
            def c(x: tuple[Array, ...]) -> Constraint:
                p, q = law[one], law[two]
                w = directed(p * x[1] + q * x[2], 1.0)
                length = jnp.sqrt(jnp.sum(w * w, axis=1, keepdims=True) + 1e-18)
                n = w / length
                alpha = law[compliance] * jnp.where(length < 1.0, self.softer, 1.0)
                return Constraint(length - 1.0, (-(p + q) * n, p * n, q * n), alpha)

            return c

        def shear(x: tuple[Array, ...]) -> Constraint:
            u1, u2, v1, v2 = law["u1"], law["u2"], law["v1"], law["v2"]
            u, v = u1 * x[1] + u2 * x[2], v1 * x[1] + v2 * x[2]
            # A collapsed direction has no angle: lengths below a tenth count as a tenth.
            lu = jnp.sqrt(jnp.maximum(jnp.sum(u * u, axis=1, keepdims=True), 1e-2))
            lv = jnp.sqrt(jnp.maximum(jnp.sum(v * v, axis=1, keepdims=True), 1e-2))
            u, v = u / lu, v / lv
            sine = jnp.sum(u * v, axis=1, keepdims=True)
            by_u, by_v = (v - sine * u) / lu, (u - sine * v) / lv
            one, two = u1 * by_u + v1 * by_v, u2 * by_u + v2 * by_v
            return Constraint(sine, (-(one + two), one, two), law["shear"])

        return [direction("u1", "u2", "warp"), direction("v1", "v2", "weft"), shear]

    def hessian(self, displacement: Array, context: tuple) -> Array | None:
        """Gauss-Newton blocks, plus the effect of tension across each taut direction."""
        blocks = super().hessian(displacement, context)
        if blocks is None:
            return None
        g = self.group
        x = self._corners([displacement[i] for i in g.index], context[0])
        eye = jnp.eye(3, dtype=displacement.dtype)[None, None]
        more: list[Any] = [0.0] * 9
        for one, two, compliance in (("u1", "u2", "warp"), ("v1", "v2", "weft")):
            p, q = g.law[one][..., None], g.law[two][..., None]
            w = jnp.swapaxes(g.law[one] * x[1] + g.law[two] * x[2], 1, 2)
            length = jnp.sqrt(jnp.sum(w * w, axis=2, keepdims=True) + 1e-18)
            n = w / length
            taut = jnp.maximum(1.0 - 1.0 / length, 0.0)[..., None]
            k = 1.0 / g.law[compliance][..., None]
            across = k * taut * (eye - n[..., :, None] * n[..., None, :])
            c = (-(p + q), p, q)
            more = [m + c[i // 3] * c[i % 3] * across for i, m in enumerate(more)]
        return blocks + jnp.concatenate(more)

    def diagnose(self, displacement: Array, context: tuple) -> dict[str, Array]:
        g = self.group
        if not len(g.index[0]):
            return {}
        x = self._corners([displacement[i] for i in g.index], context[0])
        strain = []
        for one, two in (("u1", "u2"), ("v1", "v2")):
            w = g.law[one] * x[1] + g.law[two] * x[2]
            strain.append(jnp.sqrt(jnp.sum(w * w, axis=1)) - 1.0)
        every = jnp.concatenate(strain)
        return strain_report(every)
