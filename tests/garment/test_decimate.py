"""Fewer faces with the same texture: closed forms on a sheet and on a tube with a seam."""

import jax.numpy as jnp
import numpy as np
import pytest
from numpy.testing import assert_allclose

from physxnet_jax.garment import decimate, grid_faces, mesh_health, subdivide, template
from physxnet_jax.geometry import TriMesh, make_mesh

pytest.importorskip("fast_simplification")


def sheet(n: int, *, textured: bool = False) -> TriMesh:
    u = np.linspace(0.0, 1.0, n)
    x = np.stack([*np.meshgrid(u, u, indexing="ij"), np.zeros((n, n))], axis=-1).reshape(-1, 3)
    faces = grid_faces(n, n)
    if not textured:
        return make_mesh(x, faces)
    return make_mesh(x, faces, texture(x), faces)


def texture(x: np.ndarray) -> np.ndarray:
    """Coordinates that are linear in place: the closest point has them exactly."""
    return np.stack([0.3 * x[:, 0] + 0.1 * x[:, 1], 0.7 * x[:, 1]], axis=1)


def tube(around: int, along: int) -> TriMesh:
    """A sleeve whose texture is one piece that meets itself at a seam."""
    turn = np.linspace(0.0, 1.0, around + 1)
    u, v = (a.reshape(-1) for a in np.meshgrid(turn, np.linspace(0, 1, along), indexing="ij"))
    x = np.stack([0.1 * np.cos(2 * np.pi * u), v, 0.1 * np.sin(2 * np.pi * u)], axis=1)
    chart = grid_faces(around + 1, along)
    once = np.arange((around + 1) * along) % (around * along)
    return make_mesh(x[: around * along], once[chart], np.stack([u, v], axis=1), chart)


def test_decimation_reaches_the_requested_edge_length():
    coarse, origin = decimate(sheet(41), 0.1)
    h = mesh_health(coarse)
    assert 0.05 < h.median_edge < 0.2 and h.faces < 400
    assert float(jnp.abs(coarse.vertices[:, 2]).max()) < 1e-6
    assert origin.shape == (h.faces,) and coarse.uv is None
    same, origin = decimate(sheet(3), 0.1)
    assert same.faces.shape == sheet(3).faces.shape, "nothing to do"
    assert (origin == np.arange(len(same.faces))).all()


def test_face_origin_is_the_face_it_lies_on():
    fine = sheet(41)
    coarse, origin = decimate(fine, 0.1)
    x, y = np.asarray(fine.vertices), np.asarray(coarse.vertices)
    middle, of = y[np.asarray(coarse.faces)].mean(axis=1), x[np.asarray(fine.faces)][origin]
    assert np.linalg.norm(of.mean(axis=1) - middle, axis=1).max() < 1.0 / 40
    # The other side of a thin double sheet is as near, and faces the other way.
    under = np.asarray(fine.faces)[:, ::-1] + len(x)
    both = make_mesh(np.concatenate([x, x - [0.0, 0.0, 1e-4]]), np.concatenate([fine.faces, under]))
    coarse, origin = decimate(both, 0.1)
    y = np.asarray(coarse.vertices)[np.asarray(coarse.faces)]
    up = np.cross(y[:, 1] - y[:, 0], y[:, 2] - y[:, 0])[:, 2] > 0
    assert ((origin < len(fine.faces)) == up).all() and 0 < up.sum() < len(up)


def test_linear_texture_is_preserved():
    coarse, _ = decimate(sheet(41, textured=True), 0.1)
    assert coarse.uv is not None and coarse.uv_faces is not None
    corner = np.asarray(coarse.vertices)[np.asarray(coarse.faces)].reshape(-1, 3)
    seen = np.asarray(coarse.uv)[np.asarray(coarse.uv_faces)].reshape(-1, 2)
    assert_allclose(seen, texture(corner), atol=1e-5)


def test_decimated_faces_do_not_cross_a_texture_seam():
    fine = tube(60, 61)
    coarse, _ = decimate(fine, 0.04)
    assert 4 * len(coarse.faces) < len(fine.faces)
    assert coarse.uv is not None and coarse.uv_faces is not None
    uv = np.asarray(coarse.uv)[np.asarray(coarse.uv_faces)]
    corner = np.asarray(coarse.vertices)[np.asarray(coarse.faces)]
    assert np.ptp(uv[..., 0], axis=1).max() < 0.3, "across the seam it would be nearly 1"
    angle = np.arctan2(corner[..., 2], corner[..., 0]) / (2 * np.pi)
    away = (uv[..., 0] - angle + 0.5) % 1.0 - 0.5
    # What lies across the seam takes what is at it, less than an edge away.
    assert np.abs(away).max() < 0.04 / (2 * np.pi * 0.1) and np.median(np.abs(away)) < 1e-3
    assert_allclose(uv[..., 1], corner[..., 1], atol=0.04)


@pytest.mark.nightly
def test_decimated_meshes_need_no_repair():
    """Of millimetre triangles, many of which collapse onto one point."""
    fine, _ = subdivide(template("top").mesh, 0.006)
    before = mesh_health(fine)
    coarse, origin = decimate(fine, 0.008)
    found = mesh_health(coarse)
    assert len(origin) == found.faces < 0.8 * before.faces
    assert (found.coincident_vertices, found.degenerate_faces, found.duplicate_faces) == (0, 0, 0)
    assert found.unused_vertices == 0 and found.components == before.components
