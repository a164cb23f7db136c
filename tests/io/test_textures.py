"""Images of a garment's materials come out with it, and only those beside its file."""

import base64
import dataclasses
import io
import json
import pathlib

import numpy as np
import pytest

from physxnet_jax import fit_garment, inspect_garment, template
from physxnet_jax.garment import load_garment
from physxnet_jax.geometry import Texture, make_texture
from physxnet_jax.io import AnimatedMesh, read_mesh, read_obj, write_clip
from physxnet_jax.io._texture import texture_beside, write_textures
from physxnet_jax.io._uv_transform import make_uv_transform

imageio = pytest.importorskip("imageio.v2")


def picture(colour, kind="png", *, corner=True):
    """An image of one colour with a white corner at its top left."""
    pixels = np.full((8, 8, 3), colour, np.uint8)
    if corner:
        pixels[:2, :2] = 255
    file = io.BytesIO()
    imageio.imwrite(file, pixels, format=kind)
    return file.getvalue()


RED, BLUE = picture((200, 20, 20)), picture((20, 20, 200), "jpg")


@pytest.fixture
def painted(tmp_path):
    """The template `top`, one half with a PNG, the other with a JPEG called a PNG."""
    mesh = template("top").mesh
    faces, uv_faces = np.asarray(mesh.faces) + 1, np.asarray(mesh.uv_faces) + 1
    corners = [" ".join(f"{a}/{t}" for a, t in zip(f, g)) for f, g in zip(faces, uv_faces)]
    half = len(corners) // 2
    lines = ["mtllib looks.mtl"]
    lines += [f"v {x} {y} {z}" for x, y, z in np.asarray(mesh.vertices)]
    lines += [f"vt {u} {v}" for u, v in np.asarray(mesh.uv)]
    lines += ["usemtl one", *(f"f {c}" for c in corners[:half])]
    lines += ["usemtl two", *(f"f {c}" for c in corners[half:])]
    folder = tmp_path / "garment"
    (folder / "textures").mkdir(parents=True)
    (folder / "painted.obj").write_text("\n".join(lines) + "\n")
    (folder / "looks.mtl").write_text(
        "newmtl one\nKd 0.8 0.8 0.8\nmap_Kd -s 1 1 1 -clamp off red cloth.png\n"
        "newmtl two\nmap_Kd C:\\work\\textures\\blue.png\nKd 0.5 0.5 0.5\n"
    )
    (folder / "red cloth.png").write_bytes(RED)
    (folder / "textures" / "blue.png").write_bytes(BLUE)
    return folder / "painted.obj"


def worn(path) -> AnimatedMesh:
    garment, _ = load_garment(path)
    g = garment.mesh
    x = np.asarray(g.vertices)
    return AnimatedMesh(
        "painted",
        np.stack([x, x + np.float32(0.01)]),
        np.asarray(g.faces),
        np.asarray(g.uv),
        np.asarray(g.uv_faces),
        polygons=garment.polygons,
    )


def images(mesh):
    assert mesh.polygons is not None
    return [None if m.texture is None else m.texture.data for m in mesh.polygons.materials]


def test_obj_images_of_materials_are_read(painted):
    p = read_obj(painted).polygons
    assert p is not None and images(read_obj(painted)) == [RED, BLUE]
    assert [m.texture and m.texture.name for m in p.materials] == ["red cloth.png", "blue.png"]
    # The grey beside an image is none that programs multiply by.
    assert [m.colour for m in p.materials] == [None, None]


@pytest.mark.release
@pytest.mark.parametrize("suffix", [".usda", ".usdc", ".obj", ".pc2", ".glb"])
def test_images_survive_writing(painted, tmp_path, suffix):
    mesh = worn(painted)
    assert mesh.polygons is not None
    out = tmp_path / "out"
    written = write_clip(out / f"clip{suffix}", [mesh], 30.0)
    assert set(written) == set(out.iterdir())
    name = {".obj": "clip_painted_0001.obj", ".pc2": "clip_painted.obj"}.get(
        suffix, f"clip{suffix}"
    )
    back = read_mesh(out / name)
    assert images(back) == [RED, BLUE] and back.polygons is not None
    assert back.polygons.material.tolist() == mesh.polygons.material.tolist()
    for m in back.polygons.materials:
        assert m.colour is None or m.colour == (1.0, 1.0, 1.0)
    # Of each corner what it had, so that the image lies as it lay.
    assert back.uv is not None and mesh.uv is not None
    np.testing.assert_allclose(back.uv[back.uv_faces], mesh.uv[mesh.uv_faces], atol=1e-5)


def test_other_readers_find_the_images(painted, tmp_path):
    trimesh, usd = pytest.importorskip("trimesh"), pytest.importorskip("pxr.Usd")
    shade = pytest.importorskip("pxr.UsdShade")
    mesh = worn(painted)
    write_clip(tmp_path / "a.glb", [mesh], 30.0)
    write_clip(tmp_path / "a.usdc", [mesh], 30.0)
    write_clip(tmp_path / "a.pc2", [mesh], 30.0)
    scene = trimesh.load(tmp_path / "a.glb")
    seen = [
        np.asarray(g.visual.material.baseColorTexture.convert("RGB"))[4, 4]
        for g in scene.geometry.values()
    ]
    np.testing.assert_allclose(sorted(map(tuple, seen)), [(20, 20, 200), (200, 20, 20)], atol=30)
    parts = trimesh.load(tmp_path / "a_painted.obj", process=False, split_object=False)
    geometry = parts.geometry.values() if hasattr(parts, "geometry") else [parts]
    assert all(g.visual.material.image is not None for g in geometry)
    stage = usd.Stage.Open(str(tmp_path / "a.usdc"))
    files = [
        shade.Shader(prim).GetInput("file").Get().resolvedPath
        for prim in stage.Traverse()
        if prim.GetName() == "image"
    ]
    assert sorted(pathlib.Path(f).read_bytes() for f in files) == sorted([RED, BLUE])


def test_html_page_embeds_the_images(painted, tmp_path):
    write_clip(tmp_path / "a.html", [worn(painted)], 30.0)
    text = (tmp_path / "a.html").read_text(encoding="utf-8")
    told = json.loads(text.split('type="application/json">')[1].split("</script>")[0])
    model = base64.b64decode(told["model"])
    assert RED in model and BLUE in model
    assert [p.name for p in tmp_path.iterdir() if p.is_file()] == ["a.html"]


def test_image_shared_by_two_materials_is_written_once(painted, tmp_path):
    mesh = worn(painted)
    assert mesh.polygons is not None
    one, two = mesh.polygons.materials
    shared = dataclasses.replace(two, texture=one.texture)
    p = dataclasses.replace(mesh.polygons, materials=(one, shared))
    write_clip(tmp_path / "a.usdc", [dataclasses.replace(mesh, polygons=p)], 30.0)
    assert len(list(tmp_path.glob("a_*.png"))) == 1
    # Two of one name are two.
    both = [make_texture("x/cloth.png", RED), make_texture("cloth.png", BLUE + b"."), None]
    also = make_texture("cloth.tif", picture((1, 2, 3)))
    places = write_textures(tmp_path / "b.obj", [*both, also])
    assert sorted(p.name for p in places.values()) == [
        "b_cloth.jpg",
        "b_cloth.png",
        "b_cloth_2.png",
    ]


def test_texture_tint_round_trips(painted, tmp_path):
    mesh = worn(painted)
    assert mesh.polygons is not None
    tint = (0.5, 0.25, 1.0)
    materials = tuple(dataclasses.replace(m, colour=tint) for m in mesh.polygons.materials)
    p = dataclasses.replace(mesh.polygons, materials=materials)
    for name in ("a.usdc", "a.glb"):
        write_clip(tmp_path / name, [dataclasses.replace(mesh, polygons=p)], 30.0)
        back = read_mesh(tmp_path / name)
        assert back.polygons is not None and images(back) == [RED, BLUE]
        assert all(m.colour == pytest.approx(tint) for m in back.polygons.materials)


@pytest.mark.release
def test_fitting_keeps_images_at_any_resolution(painted, tmp_path):
    for name, edge in (("a.obj", None), ("b.obj", 0.02)):
        fit_garment(painted, tmp_path / name, edge_length=edge)
        assert images(read_obj(tmp_path / name)) == [RED, BLUE]


def test_mesh_without_texture_coordinates_has_only_a_colour(painted):
    mesh = worn(painted)
    bare = dataclasses.replace(mesh, uv=None, uv_faces=None)
    assert [look.texture for look in bare.looks] == [None, None]
    assert {look.colour for look in bare.looks} == {mesh.colour}
    assert all(look.texture is not None and look.colour == (1, 1, 1) for look in mesh.looks)


@pytest.mark.release
def test_outside_damaged_or_missing_images_are_reported_and_not_read(painted):
    folder = painted.parent
    (folder.parent / "secret.png").write_bytes(RED)
    (folder / "note.png").write_text("no image")
    for name in ("../secret.png", "/etc/hostname", "note.png", "none.png", "a\0b", "textures"):
        found = texture_beside(painted, name)
        assert found.data is None and "/" not in found.name
    assert texture_beside(painted, "./red cloth.png").data == RED
    assert not any("images" in n for n in inspect_garment(painted).notes)
    (folder / "red cloth.png").write_bytes(b"GIF89a")
    notes = " ".join(inspect_garment(painted).notes)
    assert "images that can't be used: red cloth.png" in notes and "blue" not in notes


def test_equal_images_compare_equal_and_different_ones_do_not(painted):
    a, b = worn(painted).polygons, worn(painted).polygons
    assert a == b and hash(a) == hash(b) and a is not None
    one, two = a.materials
    other = dataclasses.replace(one, texture=Texture("red cloth.png", RED + b"."))
    assert dataclasses.replace(a, materials=(other, two)) != a


def test_rendered_frame_shows_the_images(painted):
    pytest.importorskip("pyvista")
    from physxnet_jax.viewer import render_frame

    mesh = worn(painted)

    assert mesh.polygons is not None

    def seen(mesh):
        return np.moveaxis(render_frame([mesh], size=(320, 352)).astype(int), -1, 0)

    r, g, b = seen(mesh)
    assert ((r > 2 * g) & (r > 2 * b)).sum() > 1000 and ((b > 2 * g) & (b > 2 * r)).sum() > 1000
    # The image's white corner is at its top left, where the chart has the right shoulder.
    plain = make_texture("plain.png", picture((200, 20, 20), corner=False))
    materials = tuple(dataclasses.replace(m, texture=plain) for m in mesh.polygons.materials)
    p = dataclasses.replace(mesh.polygons, materials=materials)
    pr, pg, pb = seen(dataclasses.replace(mesh, polygons=p))
    whole = (pr > 2 * pg) & (pr > 2 * pb)
    white = np.argwhere(whole & (g > 100))
    shoulder = white < np.argwhere(whole).mean(axis=0)
    assert len(white) > 100 and shoulder.all(axis=1).mean() > 0.8
    r, g, b = seen(dataclasses.replace(mesh, polygons=None))
    assert not ((r > 2 * g) & (r > 2 * b)).any()


def test_gltf_images_are_read_from_every_storage(painted, tmp_path):
    pygltflib = pytest.importorskip("pygltflib")
    write_clip(tmp_path / "a.glb", [worn(painted)], 30.0)

    def changed(name, change):
        document = pygltflib.GLTF2().load_binary(str(tmp_path / "a.glb"))
        change(document)
        document.save_binary(str(tmp_path / name))
        return images(read_mesh(tmp_path / name))

    def as_uri(uri):
        def change(document):
            document.images[0].bufferView = None
            document.images[0].uri = uri

        return change

    data = "data:image/png;base64," + base64.b64encode(RED).decode()
    (tmp_path / "beside it.png").write_bytes(RED)
    (painted.parent / "elsewhere.png").write_bytes(RED)
    assert changed("b.glb", as_uri(data)) == [RED, BLUE]
    assert changed("c.glb", as_uri("beside%20it.png")) == [RED, BLUE]
    (tmp_path / "sub").mkdir()
    assert changed("sub/d.glb", as_uri("../beside%20it.png")) == [None, BLUE]
    assert changed("e.glb", as_uri("missing.png")) == [None, BLUE]

    def second(document):
        document.materials[0].pbrMetallicRoughness.baseColorTexture.texCoord = 1

    assert changed("f.glb", second) == [None, BLUE], "there is no second set"


def seen_at(mesh, material, of):
    """Coordinates at the corners of a material, and what another file has there."""
    p, q = mesh.polygons, of.polygons
    rows, told = (x.uv_corners[np.repeat(x.material, x.counts) == material] for x in (p, q))
    triangles = mesh.uv_faces[p.material[p.of_triangle] == material]
    assert set(triangles.ravel()) == set(rows), "triangles look where polygons do"
    return mesh.uv[rows], of.uv[told]


# The quarter turns of implementations: (u, v) of glTF, v downwards, is looked up at (v, -u).
MOVES = {
    "scaled": ({"scale": [2, 3]}, lambda u, v: (2 * u, 3 * v)),
    "moved": ({"offset": [0.25, 0.5]}, lambda u, v: (u + 0.25, v + 0.5)),
    "turned": ({"rotation": np.pi / 2}, lambda u, v: (v, -u)),
    "all": (
        {"scale": [2, 3], "offset": [0.25, 0.5], "rotation": np.pi / 2},
        lambda u, v: (3 * v + 0.25, -2 * u + 0.5),
    ),
}


@pytest.mark.parametrize("name", MOVES)
def test_gltf_texture_transforms_are_applied(painted, tmp_path, name):
    pygltflib = pytest.importorskip("pygltflib")
    write_clip(tmp_path / "a.glb", [worn(painted)], 30.0)
    told, where = MOVES[name]
    document = pygltflib.GLTF2().load_binary(str(tmp_path / "a.glb"))
    texture = document.materials[1].pbrMetallicRoughness.baseColorTexture
    texture.extensions = {"KHR_texture_transform": told}
    document.save_binary(str(tmp_path / "b.glb"))
    before, after = read_mesh(tmp_path / "a.glb"), read_mesh(tmp_path / "b.glb")
    assert images(after) == [RED, BLUE]
    for material in (0, 1):
        seen, (u, v) = (x.T for x in seen_at(after, material, before))
        # Here v is upwards.
        a, b = where(u, 1 - v) if material else (u, 1 - v)
        np.testing.assert_allclose(seen, [a, 1 - b], atol=1e-5)


def test_gltf_second_texture_coordinate_set_is_read(painted, tmp_path):
    pygltflib = pytest.importorskip("pygltflib")
    write_clip(tmp_path / "a.glb", [worn(painted)], 30.0)
    document = pygltflib.GLTF2().load_binary(str(tmp_path / "a.glb"))
    document.materials[0].pbrMetallicRoughness.baseColorTexture.texCoord = 1
    for primitive in document.meshes[0].primitives:
        primitive.attributes.TEXCOORD_1 = primitive.attributes.TEXCOORD_0
    document.save_binary(str(tmp_path / "b.glb"))
    assert images(read_mesh(tmp_path / "b.glb")) == [RED, BLUE]


def test_obj_texture_transforms_are_applied(painted, tmp_path):
    before = read_obj(painted)
    library = painted.with_name("looks.mtl")
    text = library.read_text()
    library.write_text(text.replace("-s 1 1 1", "-s 2 3 1 -o 0.25 0.5"))
    after = read_obj(painted)
    assert images(after) == [RED, BLUE]
    for material in (0, 1):
        seen, was = seen_at(after, material, before)
        wanted = was * [2, 3] + [0.25, 0.5] if material == 0 else was
        np.testing.assert_allclose(seen, wanted, atol=1e-6)
    # Written again they need no options.
    write_clip(tmp_path / "a.obj", [worn(painted)], 30.0)
    assert "-s" not in next(tmp_path.glob("*.mtl")).read_text()
    for broken in ("-s nan 1", "-s 1e300 1", "-s inf 1", "-s 1 inf", "-o inf inf"):
        library.write_text(text.replace("-s 1 1 1", broken))
        np.testing.assert_array_equal(read_obj(painted).uv, before.uv)


@pytest.mark.parametrize("number", [np.nan, np.inf, -np.inf, 1e7, 10**400, "x", None, [1.0]])
def test_non_finite_texture_transforms_are_ignored(number):
    assert make_uv_transform((2.0, 1.0)) is not None
    assert make_uv_transform((number, 1.0)) is None
    assert make_uv_transform((1.0, number), turned=1.0) is None
    assert make_uv_transform(offset=(0.0, number)) is None
    assert make_uv_transform(turned=number) is None


def test_usd_texture_transforms_are_applied(painted, tmp_path):
    pytest.importorskip("pxr")
    from pxr import Gf, Sdf, Usd, UsdShade

    write_clip(tmp_path / "a.usda", [worn(painted)], 30.0)
    before = read_mesh(tmp_path / "a.usda")
    stage = Usd.Stage.Open(str(tmp_path / "a.usda"))
    (image, *_) = (
        s
        for prim in stage.Traverse()
        if (s := UsdShade.Shader(prim)) and s.GetIdAttr().Get() == "UsdUVTexture"
    )
    st = image.GetInput("st")
    source = UsdShade.ConnectableAPI.GetConnectedSource(st)[0]
    move = UsdShade.Shader.Define(stage, image.GetPrim().GetParent().GetPath().AppendChild("move"))
    move.CreateIdAttr("UsdTransform2d")
    move.CreateInput("in", Sdf.ValueTypeNames.Float2).ConnectToSource(
        UsdShade.Shader(source.GetPrim()).ConnectableAPI(), "result"
    )
    move.CreateInput("scale", Sdf.ValueTypeNames.Float2).Set(Gf.Vec2f(2, 3))
    move.CreateInput("rotation", Sdf.ValueTypeNames.Float).Set(90.0)
    move.CreateInput("translation", Sdf.ValueTypeNames.Float2).Set(Gf.Vec2f(0.25, 0.5))
    move.CreateOutput("result", Sdf.ValueTypeNames.Float2)
    st.ConnectToSource(move.ConnectableAPI(), "result")
    stage.GetRootLayer().Export(str(tmp_path / "b.usda"))
    for image_file in tmp_path.glob("a_*.*g"):
        image_file.with_name(image_file.name.replace("a_", "b_", 1)).write_bytes(
            image_file.read_bytes()
        )
    after = read_mesh(tmp_path / "b.usda")
    assert images(after) == [RED, BLUE]
    for material in (0, 1):
        seen, (u, v) = (x.T for x in seen_at(after, material, before))
        wanted = (0.25 - 3 * v, 0.5 + 2 * u) if material == 0 else (u, v)
        np.testing.assert_allclose(seen, wanted, atol=1e-5)


def test_usd_textures_of_other_exporters_are_read(painted, tmp_path):
    """Texture coordinates of another name, an image in a folder, and one for each tile."""
    pytest.importorskip("pxr")
    write_clip(tmp_path / "a.usda", [worn(painted)], 30.0)
    text = (tmp_path / "a.usda").read_text()
    (tmp_path / "textures").mkdir()
    (tmp_path / "textures" / "cloth.png").write_bytes(RED)
    other = text.replace("primvars:st", "primvars:UVMap").replace(
        "@./a_red_cloth.png@", "@./textures/cloth.png@"
    )
    assert other != text
    (tmp_path / "b.usda").write_text(other)
    back = read_mesh(tmp_path / "b.usda")
    assert back.uv is not None and images(back) == [RED, BLUE]
    (tmp_path / "c.usda").write_text(text.replace("a_red_cloth", "a_<UDIM>"))
    assert images(read_mesh(tmp_path / "c.usda")) == [None, BLUE]
