"""Overlapping patches: a partition of unity along the mesh, not through the air."""

import numpy as np
import pytest

from physxnet_jax.garment import square_sheet
from physxnet_jax.geometry import pad_rows, patch_shares


@pytest.mark.parametrize("spacing", [0.05, 0.1, 0.3])
def test_patches_cover_a_sheet_evenly(spacing):
    mesh = square_sheet(21, 0.4).mesh
    x, faces = np.asarray(mesh.vertices, np.float64), np.asarray(mesh.faces)
    shares = patch_shares(x, faces, spacing).toarray()
    np.testing.assert_allclose(shares.sum(axis=1), 1.0, atol=1e-6)
    assert (shares >= 0.0).all() and ((shares > 0.0).sum(axis=1) <= 4).all()
    middles = shares.T @ x / shares.sum(axis=0)[:, None]
    gap = np.linalg.norm(x[:, None] - middles[None], axis=2).min(axis=1)
    assert gap.max() < 1.2 * spacing
    assert 0.4**2 / spacing**2 / 3 < shares.shape[1] < 4 * (0.4 / spacing + 1) ** 2


def test_sheets_that_face_each_other_share_no_patch():
    one = square_sheet(9, 0.3).mesh
    x, faces = np.asarray(one.vertices, np.float64), np.asarray(one.faces)
    both = np.concatenate([x, x + [0.0, 0.001, 0.0]])
    shares = patch_shares(both, np.concatenate([faces, faces + len(x)]), 0.1)
    index, weight = pad_rows(shares)
    first, second = (
        set(index[rows][weight[rows] > 0]) for rows in (slice(len(x)), slice(len(x), None))
    )
    assert not first & second and len(first) == len(second)
