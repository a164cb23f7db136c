"""A vertex that was left behind elsewhere decides nothing."""

import numpy as np
import pytest

from physxnet_jax.garment import _search, load_garment, template
from physxnet_jax.io import write_obj


def with_strays(path, where, count):
    """Trousers in metres, and some vertices far away."""
    mesh = template("bottom").mesh
    x, faces = np.asarray(mesh.vertices), np.asarray(mesh.faces)
    far = np.tile(np.float32(where), (count, 1)) + 0.01 * np.eye(3, dtype=np.float32)[:count]
    odd = [[0, 1, len(x) + k] for k in range(count)]
    write_obj(path, np.concatenate([x, far]), np.concatenate([faces, odd]))
    return x


@pytest.mark.release
@pytest.mark.parametrize(("where", "count"), [((5, 0, 0), 1), ((0, 5, 0), 3), ((0, -3, 2), 3)])
def test_strays_change_neither_unit_nor_place(where, count, tmp_path, monkeypatch):
    x = with_strays(tmp_path / "a.obj", where, count)
    garment, report = load_garment(tmp_path / "a.obj")
    found = np.asarray(garment.mesh.vertices)
    np.testing.assert_allclose(found[: len(x)], x, atol=1e-4)
    np.testing.assert_allclose(found[-1], where, atol=0.02)
    assert report.unit == "m" and f"{count} of its {len(found)} vertices lie" in report.placed[-1]
    monkeypatch.setattr(_search, "drawn_in", lambda v: v)
    mistaken = load_garment(tmp_path / "a.obj")[0]
    assert np.abs(np.asarray(mistaken.mesh.vertices)[: len(x)] - x).max() > 0.1


@pytest.mark.parametrize(("vertices", "count"), [(40, 1), (100, 3), (260, 3)])
def test_strays_of_coarse_meshes_are_found(vertices, count):
    rng = np.random.default_rng(0)
    x = rng.uniform(-0.3, 0.3, size=(vertices, 3))
    x[:count] += [5.0, 0.0, 0.0]
    np.testing.assert_array_equal(_search.strays(x), np.arange(vertices) < count)
    assert not _search.strays(x[count:]).any()


def test_no_ordinary_garment_has_strays():
    for kind in ("top", "bottom", "dress"):
        assert not _search.strays(np.asarray(template(kind).mesh.vertices)).any()
