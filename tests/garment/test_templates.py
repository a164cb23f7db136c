"""The three templates keep what they promise, and cutting is exact."""

import dataclasses

import jax.numpy as jnp
import numpy as np
import pytest

from physxnet_jax.errors import MeshError
from physxnet_jax.garment import TEMPLATES, build_template, clearance, stored_arrays, template
from physxnet_jax.garment._cut import cut, refine, split_quads
from physxnet_jax.geometry import boundary_loops, manifold_report, mesh_edges, self_intersections


@pytest.mark.parametrize(("name", "loops"), [("top", 4), ("bottom", 3), ("dress", 4)])
def test_templates_are_clean_and_clear_of_the_skin(body, name, loops):
    g = template(name)
    v, f = np.asarray(g.mesh.vertices), np.asarray(g.mesh.faces)
    assert 2000 <= len(v) <= 4000
    edges = mesh_edges(f).vertices
    assert np.median(np.linalg.norm(v[edges[:, 0]] - v[edges[:, 1]], axis=1)) <= 0.02
    report = manifold_report(f)
    assert report["non_manifold_edges"] == report["duplicate_faces"] == 0
    assert report["inconsistent_edges"] == 0
    assert len(boundary_loops(f)) == loops
    assert len(self_intersections(v, f)) == 0
    distance, away = clearance(body.rest_mesh(), v)
    assert distance.min() >= 0.005
    hangs = name == "dress"
    assert (np.percentile(distance, 50) if hangs else distance.max()) <= 0.02
    # Not inside out: the cloth's normals point away from the skin.
    from physxnet_jax.geometry import vertex_normals

    normals = np.asarray(vertex_normals(g.mesh.vertices, g.mesh.faces))
    assert np.mean(np.einsum("ij,ij->i", normals, away) > 0) > 0.97
    np.testing.assert_allclose(np.asarray(g.skin).sum(axis=1), 1.0, atol=1e-5)


@pytest.mark.parametrize("name", TEMPLATES)
def test_templates_follow_the_shape_parameters(body, name):
    g = template(name)
    base = body.rest_vertices(body.default_shape())
    np.testing.assert_allclose(
        np.asarray(g.rest_vertices(base)), np.asarray(g.mesh.vertices), atol=2e-6
    )
    for shape in (body.shape(weight_up=1.0), body.shape(gender=1.0)):
        worn = np.asarray(g.rest_vertices(body.rest_vertices(shape)))
        distance, _ = clearance(body.rest_mesh(shape), worn)
        assert np.mean(distance < 0) < 0.01


def test_stored_template_matches_the_built_one():
    """Same topology everywhere; relaxing crossings starts from a threshold, so other
    library versions may move a few vertices of one fold by a few millimetres."""
    built = stored_arrays(build_template("bottom"))
    for key, value in stored_arrays(template("bottom")).items():
        assert value.shape == built[key].shape
        gap = np.abs(value.astype(float) - built[key].astype(float))
        assert np.mean(gap > 2e-5) < 0.03 and gap.max() < 5e-3, key


def test_top_lies_over_trousers_at_rest():
    """Edges of the one cut no triangle of the other; pressed through it would."""
    top, trousers = template("top").mesh, template("bottom").mesh
    count = len(trousers.vertices)
    faces = np.concatenate([np.asarray(trousers.faces), np.asarray(top.faces) + count])

    def cuts(over):
        v = np.concatenate([np.asarray(trousers.vertices), over])
        pairs = self_intersections(v.astype(np.float64), faces)
        edges = mesh_edges(faces).vertices[pairs[:, 0], 0] < count
        return int(np.sum(edges != (pairs[:, 1] < len(trousers.faces))))

    x = np.asarray(top.vertices)
    assert cuts(x) == 0 and cuts(x * np.float32([0.97, 1.0, 0.9])) > 50


def test_unknown_templates_are_refused():
    from physxnet_jax.garment import load_garment

    with pytest.raises(MeshError, match="top, bottom, dress"):
        load_garment("hat")


def plane(n=6):
    x, y = np.meshgrid(np.linspace(0, 1, n), np.linspace(0, 1, n))
    points = np.column_stack([x.ravel(), y.ravel(), np.zeros(n * n)])
    k = np.arange(n * n).reshape(n, n)
    quads = np.stack([k[:-1, :-1], k[:-1, 1:], k[1:, 1:], k[1:, :-1]], axis=-1).reshape(-1, 4)
    return points, quads


def area(p, f):
    return 0.5 * np.linalg.norm(np.cross(p[f[:, 1]] - p[f[:, 0]], p[f[:, 2]] - p[f[:, 0]]), axis=1)


@pytest.mark.parametrize("level", [0.13, 0.5, 0.77])
def test_cut_keeps_the_area_below_the_level(level):
    points, quads = plane()
    rows, faces = split_quads(quads, len(points))
    part, tri, _ = cut(rows, faces, (rows @ points)[:, 1] - level)
    p = part @ points
    assert area(p, tri).sum() == pytest.approx(level, abs=1e-9)
    assert p[:, 1].max() == pytest.approx(level, abs=1e-12)
    assert area(p, tri).min() > 1e-4
    np.testing.assert_allclose(np.asarray(part.sum(axis=1)).ravel(), 1.0)


def test_refinement_keeps_the_surface_and_bounds_edge_lengths():
    points, quads = plane(4)
    rows, faces = split_quads(quads, len(points))
    rows, faces = refine(rows, faces, points, 0.12)
    p = rows @ points
    edges = mesh_edges(faces).vertices
    assert np.linalg.norm(p[edges[:, 0]] - p[edges[:, 1]], axis=1).max() <= 0.12
    assert area(p, faces).sum() == pytest.approx(1.0)
    assert manifold_report(faces)["non_manifold_edges"] == 0


def test_fabric_is_static_and_garments_are_pytrees():
    import jax

    g = template("top")
    doubled = jax.tree.map(lambda x: x, g)
    assert doubled.fabric == g.fabric and doubled.name == "top"
    assert dataclasses.replace(g, name="x").name == "x"
    assert jnp.asarray(g.pinned).dtype == bool
