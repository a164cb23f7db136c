"""Quads and materials of a garment's file come out as they went in."""

import dataclasses

import numpy as np
import pytest
from scipy.spatial import KDTree

from physxnet_jax import dress, fit_garment, template
from physxnet_jax.garment import load_garment
from physxnet_jax.geometry import Material, Polygons
from physxnet_jax.io import AnimatedMesh, read_mesh, read_obj, write_clip, write_obj

COLOURS = {"Denim blue": (0.1, 0.2, 0.6), "Red": (0.8, 0.1, 0.1)}


@pytest.fixture
def quilted(tmp_path):
    """The template `top` as quads where two triangles share an edge, in two materials."""
    mesh = template("top").mesh
    faces, uv_faces = np.asarray(mesh.faces), np.asarray(mesh.uv_faces)
    polygons, free = [], set(range(len(faces)))
    by_edge = {}
    for k, f in enumerate(faces.tolist()):
        for c in range(3):
            by_edge[f[c], f[(c + 1) % 3]] = k, c
    for k, f in enumerate(faces.tolist()):
        if k not in free:
            continue
        other, c = by_edge.get((f[0], f[2]), (None, 0))
        free.discard(k)
        if other in free:
            free.discard(other)
            far = (c + 2) % 3
            corners = [*f, faces[other, far]]
            rows = [*uv_faces[k], uv_faces[other, far]]
        else:
            corners, rows = f, uv_faces[k]
        polygons.append(" ".join(f"{a + 1}/{t + 1}" for a, t in zip(corners, rows)))
    half = len(polygons) // 2
    lines = ["mtllib cloth.mtl"]
    lines += [f"v {x} {y} {z}" for x, y, z in np.asarray(mesh.vertices)]
    lines += [f"vt {u} {v}" for u, v in np.asarray(mesh.uv)]
    lines += ["usemtl Denim blue", *(f"f {p}" for p in polygons[:half])]
    lines += ["usemtl Red", *(f"f {p}" for p in polygons[half:])]
    (tmp_path / "quilted.obj").write_text("\n".join(lines) + "\n")
    told = [f"newmtl {n}\nKd {r} {g} {b}" for n, (r, g, b) in COLOURS.items()]
    (tmp_path / "cloth.mtl").write_text("\n".join(told) + "\n")
    return tmp_path / "quilted.obj"


def rings(p):
    """Each polygon from its smallest corner on, with its material."""
    out = []
    for a, n, m in zip(p.starts, p.counts, p.material):
        ring = p.corners[a : a + n].tolist()
        k = ring.index(min(ring))
        out.append((*ring[k:], *ring[:k], p.materials[m].name.replace(" ", "_")))
    return sorted(out)


def worn(path):
    garment, _ = load_garment(path)
    x = np.asarray(garment.mesh.vertices)
    faces, uv = np.asarray(garment.mesh.faces), np.asarray(garment.mesh.uv)
    clip = np.stack([x, x + np.float32(0.01)])
    uv_faces = np.asarray(garment.mesh.uv_faces)
    return AnimatedMesh("quilted", clip, faces, uv, uv_faces, polygons=garment.polygons)


def test_obj_quads_and_materials_are_read(quilted):
    mesh = read_obj(quilted)
    p = mesh.polygons
    assert p is not None and mesh.count == len(p.counts) < len(mesh.faces)
    assert {m.name: m.colour for m in p.materials} == COLOURS
    assert (np.bincount(p.of_triangle) == p.counts - 2).all() and set(p.counts) == {3, 4}
    # Each triangle has its corners from its polygon.
    of = [set(p.corners[a : a + n]) for a, n in zip(p.starts, p.counts)]
    assert all(set(f) <= of[k] for f, k in zip(mesh.faces.tolist(), p.of_triangle))


@pytest.mark.release
@pytest.mark.parametrize("suffix", [".usdc", ".obj", ".pc2", ".glb"])
def test_polygons_and_materials_survive_writing(quilted, tmp_path, suffix):
    mesh = worn(quilted)
    written = write_clip(tmp_path / f"clip{suffix}", [mesh], 30.0)
    assert all(w.is_file() for w in written)
    name = {".obj": "clip_quilted_0001.obj", ".pc2": "clip_quilted.obj"}.get(
        suffix, f"clip{suffix}"
    )
    back = read_mesh(tmp_path / name).polygons
    assert back is not None and mesh.polygons is not None
    if suffix == ".glb":
        # It knows triangles alone; their materials are kept.
        of_face = mesh.polygons.material[mesh.polygons.of_triangle]
        assert np.bincount(back.material).tolist() == np.bincount(of_face).tolist()
    else:
        assert rings(back) == rings(mesh.polygons)
        assert (back.counts == 4).sum() == (mesh.polygons.counts == 4).sum() > 0
    for m in back.materials:
        assert m.colour == pytest.approx(COLOURS[m.name.replace("_", " ")], abs=1e-6)
    if suffix != ".pc2":
        bare = dataclasses.replace(mesh, polygons=None)
        (path, *_) = write_clip(tmp_path / f"bare{suffix}", [bare], 30.0)
        plain = read_mesh(path).polygons
        assert plain is not None and set(plain.counts) == {3}


def test_texture_coordinates_stay_with_their_corners(quilted, tmp_path):
    mesh = worn(quilted)
    write_clip(tmp_path / "a.usdc", [mesh], 30.0)
    write_clip(tmp_path / "a.obj", [mesh], 30.0)
    assert (
        mesh.polygons is not None and mesh.polygons.uv_corners is not None and mesh.uv is not None
    )
    wanted = mesh.uv[mesh.polygons.uv_corners]
    for name in ("a.usdc", "a_quilted_0000.obj"):
        back = read_mesh(tmp_path / name)
        assert back.polygons is not None and back.uv is not None
        np.testing.assert_array_equal(back.polygons.corners, mesh.polygons.corners)
        np.testing.assert_allclose(back.uv[back.polygons.uv_corners], wanted, atol=1e-5)


@pytest.mark.nightly
def test_fitting_keeps_polygons_and_materials(quilted, tmp_path):
    done, _ = fit_garment(quilted, tmp_path / "fitted.obj")
    before, after = read_obj(quilted).polygons, read_obj(tmp_path / "fitted.obj").polygons
    assert before is not None and after is not None and rings(after) == rings(before)
    assert after.materials == before.materials and "triangles" not in " ".join(done)
    # Finer it has other faces, each of the material of what it was cut from.
    done, _ = fit_garment(quilted, tmp_path / "finer.obj", edge_length=0.015)
    mesh, coarse = read_obj(tmp_path / "finer.obj"), read_obj(tmp_path / "fitted.obj")
    finer = mesh.polygons
    assert finer is not None and set(finer.counts) == {3}
    assert done[-1] == "polygons are triangles now."
    assert finer.materials == before.materials and len(mesh.faces) > 2 * len(coarse.faces)
    middle, whole = (m.vertices[m.faces].mean(axis=1) for m in (mesh, coarse))
    of_face = after.material[after.of_triangle]
    nearest = of_face[KDTree(whole).query(middle)[1]]
    assert np.mean(finer.material == nearest) > 0.9


@pytest.mark.nightly
def test_decimation_keeps_materials_and_texture(quilted, tmp_path):
    pytest.importorskip("fast_simplification")
    done, _ = fit_garment(quilted, tmp_path / "fitted.obj")
    done, _ = fit_garment(quilted, tmp_path / "coarse.obj", coarser=0.03)
    assert "polygons are triangles now." in done
    whole, mesh = read_obj(tmp_path / "fitted.obj"), read_obj(tmp_path / "coarse.obj")
    before, p = whole.polygons, mesh.polygons
    assert before is not None and p is not None and p.materials == before.materials
    assert len(mesh.faces) < 0.8 * len(whole.faces)
    middle, fine = (m.vertices[m.faces].mean(axis=1) for m in (mesh, whole))
    nearest = before.material[before.of_triangle][KDTree(fine).query(middle)[1]]
    assert np.mean(p.material == nearest) > 0.9 and len(set(p.material)) > 1
    assert mesh.uv is not None and whole.uv is not None
    assert mesh.uv_faces is not None and whole.uv_faces is not None
    old, new = whole.uv[whole.uv_faces].mean(axis=1), mesh.uv[mesh.uv_faces].mean(axis=1)
    gap = np.linalg.norm(new - old[KDTree(fine).query(middle)[1]], axis=1)
    assert np.median(gap) < 0.02 * np.ptp(whole.uv, axis=0).max()


@pytest.mark.release
def test_welding_and_flipping_keep_polygons(quilted, tmp_path):
    mesh = read_obj(quilted)
    assert mesh.polygons is not None
    count = len(mesh.polygons.counts)
    # Every polygon with vertices of its own, and the wrong way round.
    torn = dataclasses.replace(
        mesh.polygons.reversed(range(count)),
        corners=np.arange(len(mesh.polygons.corners), dtype=np.int32),
    )
    corners = mesh.polygons.reversed(range(count)).corners
    path = tmp_path / "torn.obj"
    write_obj(path, mesh.vertices[corners], mesh.faces, mesh.uv, mesh.uv_faces, polygons=torn)
    done, _ = fit_garment(path, tmp_path / "mended.obj")
    after = read_obj(tmp_path / "mended.obj")
    assert any("welded" in d for d in done) and any(
        "flipped" in d or "turned" in d or "orient" in d for d in done
    )
    assert after.polygons is not None and len(after.polygons.counts) == count
    assert len(after.vertices) == len(mesh.vertices)
    back = [
        tuple(np.round(after.vertices[after.polygons.corners[a]], 4)) for a in after.polygons.starts
    ]
    assert len(set(back)) > count // 4


def test_invalid_or_outside_material_files_give_no_colour(quilted):
    text = quilted.read_text()
    for told in ("Kd 1", "Kd nan 0 0\nKd a b c", "\udcff".encode("utf-8", "surrogateescape")):
        data = told if isinstance(told, bytes) else told.encode()
        quilted.with_name("cloth.mtl").write_bytes(b"Kd 1 1 1\nnewmtl Red\n" + data)
        p = read_obj(quilted).polygons
        assert p is not None and [m.colour for m in p.materials] == [None, None]
    # A name that leads elsewhere is looked for beside the mesh.
    secret = quilted.parent.parent / "secret.mtl"
    secret.write_text("newmtl Red\nKd 1 1 1\n")
    quilted.write_text(text.replace("cloth.mtl", "../secret.mtl"))
    p = read_obj(quilted).polygons
    assert p is not None and p.materials[1].colour is None


@pytest.mark.release
def test_a_lost_image_is_a_note(quilted, tmp_path):
    materials = tmp_path / "cloth.mtl"
    known = dress("walk", [quilted], method="lbs", frames=1)
    materials.write_text(materials.read_text() + "map_Kd lost.png\n")
    clip = dress("walk", [quilted], method="lbs", frames=1)
    new = set(clip.notes) - set(known.notes)
    assert len(new) == 1 and "colours are shown without lost.png" in new.pop()
    for suffix in ("obj", "glb", "usdc"):
        assert write_clip(tmp_path / f"a.{suffix}", clip.meshes, 30.0)


def test_faces_without_a_material_stay_without_one(quilted, tmp_path):
    mesh = worn(quilted)
    assert mesh.polygons is not None
    bare = mesh.polygons.material.copy()
    bare[len(bare) // 3 : len(bare) // 2] = -1
    mesh = dataclasses.replace(mesh, polygons=dataclasses.replace(mesh.polygons, material=bare))
    write_clip(tmp_path / "a.obj", [mesh], 30.0)
    back = read_obj(tmp_path / "a_quilted_0000.obj").polygons
    assert back is not None
    names = [back.materials[k].name for k in back.material]
    wanted = ["default" if k < 0 else mesh.polygons.materials[k].name for k in bare]
    assert names == wanted and len(set(names)) == 3


def test_materials_of_one_name_keep_their_colours_and_lines_stay_whole(tmp_path):
    """Names from other formats may repeat, and may hold line ends."""
    mesh = template("bottom").mesh
    x, faces = np.asarray(mesh.vertices), np.asarray(mesh.faces)
    names, colours = ("mat", "mat", "red\nv 0 0 0\nf 1 2 3"), ((1, 0, 0), (0, 0, 1), (0, 1, 0))
    drawn = Polygons(
        np.full(len(faces), 3, np.int32),
        faces.reshape(-1),
        None,
        (np.arange(len(faces)) % 3).astype(np.int32),
        tuple(Material(n, tuple(map(float, c))) for n, c in zip(names, colours, strict=True)),
    )
    clip = [AnimatedMesh("a", x[None].astype(np.float32), faces.astype(np.int32), polygons=drawn)]
    write_clip(tmp_path / "c.obj", clip, 30.0)
    again = read_obj(tmp_path / "c_a_0000.obj")
    assert len(again.vertices) == len(x) and len(again.faces) == len(faces)
    kept = again.polygons
    found = [kept.materials[k].colour for k in kept.material[:3]]
    np.testing.assert_allclose(found, colours, atol=1e-6)
