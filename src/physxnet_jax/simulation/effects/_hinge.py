"""Hinges: stencils over two triangles, and what they make of a curvature."""

import dataclasses

import numpy as np
from jaxtyping import Float, Int

from ...geometry import hinges
from .._assembly import Assembly

# Triangles flatter than this share of their longest edge squared bend nothing.
_SLIVER = 1e-3


@dataclasses.dataclass(frozen=True)
class Hinges:
    """Interior edges with sound triangles on both sides.

    Attributes:
        corners: Ends a, b and the opposite corners left and right, shape [hinges, 4].
        coefficient: Of the quadratic bending energy, shape [hinges, 4].
        area: Of both triangles [m^2], shape [hinges].
        length: Of the edge [m], shape [hinges].
        stiffness: Of ``|sum c x|^2 / 2`` [N/m], calibrated, shape [hinges].
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
    """The hinges of a scene, their stiffness such that cylinders store the right energy.

    Weighted by ``3 / A`` (Bergou et al. 2006) hinges count a cylinder of curvature kappa
    1.5 times on equilateral triangles, and up to 3 times or not at all on a right-angled
    grid, where each direction meets other edges. Here each hinge gets a weight such that
    cylinders in all directions store ``k kappa^2 / 2`` an area, as well as the three
    hinges of a triangle can (within 6 % on right-angled grids, tested).

    Known limit: where diagonals alternate, zigzags of every other vertex stretch these
    hinges little, so that strips sag too far under a load, the more the longer the cells.
    """
    x = assembly.rest
    every = hinges(assembly.faces[sound(x, assembly.faces)])
    coefficient, area = hinge_stencils(x, every)
    length = np.linalg.norm(x[every[:, 1]] - x[every[:, 0]], axis=1)
    of_vertex = np.zeros(len(x))
    of_vertex[assembly.faces] = assembly.bend[:, None]
    k = of_vertex[every[:, 0]] / area * _weights(x, every, area)
    return Hinges(every, coefficient, area, length, k)


def hinge_stencils(
    x: Float[np.ndarray, "vertices 3"], quads: Int[np.ndarray, "hinges 4"]
) -> tuple[Float[np.ndarray, "hinges 4"], Float[np.ndarray, " hinges"]]:
    """Coefficients of (a, b, left, right) and the area of both triangles."""
    a, b, p, q = (x[quads[:, i]] for i in range(4))

    def cot(u: np.ndarray, v: np.ndarray) -> np.ndarray:
        sine = np.linalg.norm(np.cross(u, v), axis=1)
        return np.einsum("ij,ij->i", u, v) / np.maximum(sine, 1e-9)

    at_a = cot(b - a, p - a), cot(b - a, q - a)
    at_b = cot(a - b, p - b), cot(a - b, q - b)
    c = np.column_stack(
        [at_b[0] + at_b[1], at_a[0] + at_a[1], -at_a[0] - at_b[0], -at_a[1] - at_b[1]]
    )
    area = 0.5 * (
        np.linalg.norm(np.cross(b - a, p - a), axis=1)
        + np.linalg.norm(np.cross(b - a, q - a), axis=1)
    )
    return c, area


_DIRECTIONS = np.arange(8) * np.pi / 8


def _weights(
    x: Float[np.ndarray, "vertices 3"],
    quads: Int[np.ndarray, "hinges 4"],
    area: Float[np.ndarray, " hinges"],
) -> Float[np.ndarray, " hinges"]:
    """Weights that bring the energy of cylinders of every direction to ``A kappa^2 / 2``.

    A least-squares fit a triangle, its hinges counted half; then the mean of both sides.
    """
    if len(quads) == 0:
        return np.zeros(0)
    response = _responses(x, quads) / area[:, None, None]
    # The triangles beside a hinge: (a, b, left) and (b, a, right).
    sides = np.sort(np.concatenate([quads[:, [0, 1, 2]], quads[:, [0, 1, 3]]]), axis=1)
    _, triangle = np.unique(sides, axis=0, return_inverse=True)
    triangle = triangle.reshape(2, -1)
    members = np.full((triangle.max() + 1, 3), -1)
    count = np.zeros(len(members), int)
    for side in range(2):
        for hinge, t in enumerate(triangle[side]):
            if count[t] < 3:
                members[t, count[t]] = 2 * hinge + side
                count[t] += 1
    whole = members[count == 3]
    if len(whole) == 0:
        # No triangle has all its hinges: the mean over directions has to do.
        c, s = np.cos(_DIRECTIONS), np.sin(_DIRECTIONS)
        b = np.stack([c * c, s * s, c * s], axis=1)
        mean = np.einsum("dm,hmn,dn->", b, response, b) / len(_DIRECTIONS)
        return np.full(len(quads), area.sum() / 3 / max(float(mean), 1e-30))
    hinge, side = whole // 2, whole % 2
    # Directions are turned into the frame of the triangle's first hinge.
    turned = np.stack(
        [
            _turned(x, quads, response, hinge[:, 0], side[:, 0], hinge[:, k], side[:, k])
            for k in range(3)
        ],
        axis=2,
    )
    surface = 0.5 * np.linalg.norm(
        np.cross(
            x[quads[hinge[:, 0], 1]] - x[quads[hinge[:, 0], 0]],
            x[quads[hinge[:, 0], 2 + side[:, 0]]] - x[quads[hinge[:, 0], 0]],
        ),
        axis=1,
    )
    matrix = 0.5 * turned / surface[:, None, None]
    # In units of each hinge's own mean: long cells make them differ by orders.
    scale = np.maximum(matrix.mean(axis=1, keepdims=True), 1e-30)
    matrix = matrix / scale
    ridge = 1e-3 * np.einsum("tdk,tdk->t", matrix, matrix)[:, None, None] * np.eye(3)
    normal = np.einsum("tdi,tdj->tij", matrix, matrix) + ridge
    right = matrix.sum(axis=1) + ridge.sum(axis=2) / 3
    w = np.linalg.solve(normal, right[..., None])[..., 0]
    w = np.clip(w, 0.02, 2.0) / scale[:, 0]
    total, number = np.zeros(len(quads)), np.zeros(len(quads))
    np.add.at(total, hinge, w)
    np.add.at(number, hinge, 1.0)
    mean = np.median(total[number > 0] / number[number > 0])
    return np.where(number > 0, total / np.maximum(number, 1), mean)


def _responses(
    x: Float[np.ndarray, "vertices 3"], quads: Int[np.ndarray, "hinges 4"]
) -> Float[np.ndarray, "hinges 3 3"]:
    """``g g^T`` for curvatures (uu, vv, uv) of a hinge unfolded with its edge along u."""
    a, b, p, q = (x[quads[:, i]] for i in range(4))
    length = np.linalg.norm(b - a, axis=1)
    along = (b - a) / length[:, None]
    flat = np.zeros((len(quads), 4, 3))
    flat[:, 1, 0] = length
    for k, (corner, sign) in enumerate(((p, 1.0), (q, -1.0)), start=2):
        u = np.einsum("ij,ij->i", corner - a, along)
        flat[:, k, 0] = u
        flat[:, k, 1] = sign * np.linalg.norm(corner - a - u[:, None] * along, axis=1)
    c, _ = hinge_stencils(flat.reshape(-1, 3), np.arange(4 * len(quads)).reshape(-1, 4))
    u, v = flat[..., 0], flat[..., 1]
    heights = np.stack([0.5 * u * u, 0.5 * v * v, u * v], axis=2)
    g = np.einsum("hk,hkm->hm", c, heights)
    return g[:, :, None] * g[:, None, :]


def _turned(
    x: Float[np.ndarray, "vertices 3"],
    quads: Int[np.ndarray, "hinges 4"],
    response: Float[np.ndarray, "hinges 3 3"],
    first: Int[np.ndarray, " triangles"],
    first_side: Int[np.ndarray, " triangles"],
    other: Int[np.ndarray, " triangles"],
    other_side: Int[np.ndarray, " triangles"],
) -> Float[np.ndarray, "triangles directions"]:
    """Energy of unit cylinders in a hinge, directions measured from another's edge."""
    e = x[quads[first, 1]] - x[quads[first, 0]]
    f = x[quads[other, 1]] - x[quads[other, 0]]
    n = np.cross(e, x[quads[first, 2 + first_side]] - x[quads[first, 0]])
    n *= np.where(first_side == 0, 1.0, -1.0)[:, None]
    n /= np.linalg.norm(n, axis=1, keepdims=True)
    # In the other hinge's frame its left side points up; flip if it sees the other face.
    m = np.cross(f, x[quads[other, 2 + other_side]] - x[quads[other, 0]])
    m *= np.where(other_side == 0, 1.0, -1.0)[:, None]
    same = np.sign(np.einsum("ij,ij->i", n, m))
    angle = np.arctan2(np.einsum("ij,ij->i", np.cross(e, f), n), np.einsum("ij,ij->i", e, f))
    phi = same[:, None] * (_DIRECTIONS[None] - angle[:, None])
    c, s = np.cos(phi), np.sin(phi)
    b = np.stack([c * c, s * s, c * s], axis=2)
    return np.einsum("tdm,tmn,tdn->td", b, response[other], b)
