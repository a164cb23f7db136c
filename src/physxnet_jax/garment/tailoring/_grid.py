"""Grids over charts: how they are sampled and how they go on beyond a border."""

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool

# Distance between nodes of a chart's grid [m].
SPACING = 0.015
# Nodes beyond the border of a chart, as many as a cubic spline reaches.
BEYOND = 4


def spline(origin, uv, shape: tuple[int, int]):
    """Nodes around places of a grid and their weights in a uniform cubic B-spline.

    Args:
        origin: Place of the first node, shape [2].
        uv: Places, shape [points, 2]; a NumPy array, or of JAX.
        shape: Rows and columns of the grid.

    Returns:
        Flat indices and weights, both of shape [points, 16].
    """
    xp = jnp if isinstance(uv, jax.Array) else np
    place = (uv - origin[None]) / SPACING
    limit = np.array([[shape[1] - 3, shape[0] - 3]], np.float32)
    lower = xp.clip(xp.floor(place), np.float32(1), limit)
    cell, t = lower.astype(np.int32), place - lower
    basis = xp.stack(
        [
            (1 - t) ** 3 / 6,
            (3 * t**3 - 6 * t**2 + 4) / 6,
            (-3 * t**3 + 3 * t**2 + 3 * t + 1) / 6,
            t**3 / 6,
        ],
        axis=2,
    )
    step = np.arange(-1, 3)[None]
    column = cell[:, 0, None] + step
    row = cell[:, 1, None] + step
    index = row[:, :, None] * shape[1] + column[:, None, :]
    weight = basis[:, 1, :, None] * basis[:, 0, None, :]
    return index.reshape(-1, 16), weight.reshape(-1, 16)


def extension(
    inside: Bool[np.ndarray, "rows columns"],
) -> list[tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]]:
    """How a grid goes on beyond the nodes that are known, layer by layer, on straight lines.

    Args:
        inside: Known nodes.

    Returns:
        For each layer the nodes that it adds, shape [nodes], two nodes inwards of them in each of
        eight directions, both of shape [nodes, 8], and the share of the direction. A node's value
        is the mean over directions of twice the nearer one's minus the farther one's.
    """
    rows, columns = inside.shape
    known = np.pad(inside, 2)
    number = np.pad(np.arange(rows * columns).reshape(rows, columns), 2)
    steps = [(i, j) for i in (-1, 0, 1) for j in (-1, 0, 1) if (i, j) != (0, 0)]
    layers = []
    for _ in range(BEYOND):
        at = np.argwhere(~known[2:-2, 2:-2]) + 2
        near = np.stack([number[at[:, 0] + i, at[:, 1] + j] for i, j in steps], axis=1)
        far = np.stack([number[at[:, 0] + 2 * i, at[:, 1] + 2 * j] for i, j in steps], axis=1)
        usable = np.stack(
            [
                known[at[:, 0] + i, at[:, 1] + j] & known[at[:, 0] + 2 * i, at[:, 1] + 2 * j]
                for i, j in steps
            ],
            axis=1,
        )
        some = usable.any(axis=1)
        at, near, far, usable = at[some], near[some], far[some], usable[some]
        share = usable / usable.sum(axis=1, keepdims=True)
        layers.append((number[at[:, 0], at[:, 1]], near, far, share))
        known[at[:, 0], at[:, 1]] = True
    return layers
