"""Simple cloth meshes for experiments and tests."""

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, Int

from ..body import load_body
from ..geometry import make_mesh
from ._garment import COTTON, Fabric, Garment

_FRONT = (0.0, 0.0, 1.5)


def square_sheet(
    n: int = 6,
    size: float | tuple[float, float] = 0.3,
    *,
    corner: tuple[float, float, float] = _FRONT,
    upright: bool = False,
    pinned: Int[np.ndarray, " pins"] | None = None,
    fabric: Fabric = COTTON,
) -> Garment:
    """A horizontal or hanging sheet of n x n vertices in front of the body.

    Vertex ``i * n + j`` lies in row i along z (or downwards) and column j along x.

    Args:
        n: Vertices per side.
        size: Length of its sides [m], across and along.
        corner: Position of its first vertex [m].
        upright: Let it hang down from its first row instead of lying horizontally.
        pinned: Pinned vertices, see `free_garment`.
        fabric: Material.
    """
    across, along = (size, size) if isinstance(size, (int, float)) else size
    x, y = np.meshgrid(np.linspace(0, across, n), np.linspace(0, along, n))
    zero = np.zeros(n * n)
    if upright:
        v = np.column_stack([x.ravel(), -y.ravel(), zero]) + corner
    else:
        v = np.column_stack([x.ravel(), zero, y.ravel()]) + corner
    return free_garment(v, grid_faces(n, n), pinned=pinned, fabric=fabric)


def grid_faces(rows: int, columns: int) -> Int[np.ndarray, "faces 3"]:
    """Triangles of a grid whose vertex ``i * columns + j`` lies in row i and column j.

    Diagonals alternate, so that no direction is favoured.
    """
    k = np.arange(rows * columns).reshape(rows, columns)
    a, b, c, d = (q.ravel() for q in (k[:-1, :-1], k[:-1, 1:], k[1:, 1:], k[1:, :-1]))
    even = (np.add.outer(np.arange(rows - 1), np.arange(columns - 1)) % 2 == 0).ravel()[:, None]
    first = np.where(even, np.column_stack([a, c, b]), np.column_stack([a, d, b]))
    second = np.where(even, np.column_stack([a, d, c]), np.column_stack([b, d, c]))
    return np.concatenate([first, second])


def free_garment(
    vertices: Float[np.ndarray, "vertices 3"],
    faces: Int[np.ndarray, "faces 3"],
    *,
    pinned: Int[np.ndarray, " pins"] | None = None,
    fabric: Fabric = COTTON,
    name: str = "sheet",
) -> Garment:
    """Makes a garment of any mesh, not attached to the skin; pinned vertices follow the hips.

    Args:
        vertices: Positions [m].
        faces: Triangles.
        pinned: Vertices that follow the hips.
        fabric: Material.
        name: Name of the garment.
    """
    body = load_body()
    v = np.asarray(vertices, dtype=np.float64)
    held = np.zeros(len(v), bool)
    if pinned is not None:
        held[pinned] = True
    skin = np.zeros((len(v), body.weights.shape[1]), np.float32)
    skin[:, body.joint("Hips")] = 1.0
    first = np.asarray(body.rest_vertices(body.default_shape()), np.float64)[0]
    return Garment(
        make_mesh(v, faces),
        jax.device_put(held),
        jnp.zeros((len(v), 1), jnp.int32),
        jnp.ones((len(v), 1), jnp.float32),
        jax.device_put((v - first).astype(np.float32)),
        jax.device_put(skin),
        fabric,
        "top",
        name,
    )
