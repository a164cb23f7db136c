"""Hinges: bending stencils over two triangles that share an edge."""

import dataclasses
from typing import Any

import numpy as np
from jaxtyping import Float, Int

from ...geometry import hinges
from .._assembly import Assembly

# Triangles whose doubled area is below this share of the longest edge squared are left out.
_SLIVER = 1e-3


@dataclasses.dataclass(frozen=True)
class Hinges:
    """Interior edges with non-degenerate triangles on both sides.

    Attributes:
        corners: Ends a, b and the opposite corners left and right, shape [hinges, 4].
        coefficient: Coefficients of the quadratic bending energy, shape [hinges, 4].
        area: Total area of both triangles [m^2], shape [hinges].
        length: Length of the edge [m], shape [hinges].
        stiffness: Factor of ``|sum c x|^2 / 2`` [N/m], shape [hinges].
    """

    corners: Int[np.ndarray, "hinges 4"]
    coefficient: Float[np.ndarray, "hinges 4"]
    area: Float[np.ndarray, " hinges"]
    length: Float[np.ndarray, " hinges"]
    stiffness: Float[np.ndarray, " hinges"]


def sound(x: Float[np.ndarray, "vertices 3"], faces: Int[np.ndarray, "faces 3"]) -> np.ndarray:
    """Which triangles are neither slivers nor needles."""
    side = [x[faces[:, (k + 1) % 3]] - x[faces[:, k]] for k in range(3)]
    twice = np.linalg.norm(np.cross(side[0], side[1]), axis=1)
    longest = np.max([np.einsum("ij,ij->i", s, s) for s in side], axis=0)
    return twice > np.maximum(_SLIVER * longest, 1e-10)


def bending_hinges(assembly: Assembly) -> Hinges:
    """The hinges of a scene, weighted by ``1 / A``.

    With ``3 / A``, which makes the quadratic form a Laplacian of edge midpoints (Bergou et al.
    2006), strips sag only 0.4 times as far as a beam of the same stiffness. With ``1 / A``
    cylinders about a grid axis store ``k kappa^2 / 2`` per area within 3 %. Strips clamped at
    one end sag 1.1 to 1.3 times as far as beams on all triangulations, farthest on right-angled
    grids (tested). With weights fitted hinge by hinge to cylinders of all directions they sag
    even farther, as some hinges nearly vanish.
    """
    x = assembly.rest
    interior = hinges(assembly.faces[sound(x, assembly.faces)])
    coefficient, area = hinge_stencils(*(x[interior[:, i]] for i in range(4)), xp=np)
    length = np.linalg.norm(x[interior[:, 1]] - x[interior[:, 0]], axis=1)
    vertex_bend = np.zeros(len(x))
    vertex_bend[assembly.faces] = assembly.bend[:, None]
    k = vertex_bend[interior[:, 0]] / area
    return Hinges(interior, np.column_stack(coefficient), area, length, k)


def hinge_stencils(a: Any, b: Any, p: Any, q: Any, xp: Any) -> tuple[list[Any], Any]:
    """Coefficients of (a, b, left, right) and the total area of both triangles.

    Args:
        a: First ends of the edges, shape [hinges, 3].
        b: Second ends.
        p: Opposite corners on the left.
        q: Opposite corners on the right.
        xp: numpy or jax.numpy.
    """

    def sine(u: Any, v: Any) -> Any:
        normal = xp.cross(u, v)
        return xp.sqrt(xp.maximum(xp.sum(normal * normal, axis=1), 1e-18))

    def cot(u: Any, v: Any) -> Any:
        return xp.sum(u * v, axis=1) / sine(u, v)

    at_a = cot(b - a, p - a), cot(b - a, q - a)
    at_b = cot(a - b, p - b), cot(a - b, q - b)
    c = [at_b[0] + at_b[1], at_a[0] + at_a[1], -at_a[0] - at_b[0], -at_a[1] - at_b[1]]
    return c, 0.5 * (sine(b - a, p - a) + sine(b - a, q - a))
