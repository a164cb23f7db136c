"""Garments made on other bodies, in other units, axes and poses land where they belong."""

import json
import pathlib
import struct

import numpy as np
import pytest

from physxnet_jax.body import load_body
from physxnet_jax.errors import FormatError, MeshError, PhysXNetError
from physxnet_jax.garment import (
    Hints,
    align_to_template,
    load_garment,
    load_outfit,
    most_alike,
    tailor,
    template,
)
from physxnet_jax.garment._locate import NO_HINTS, _smooth_far, locate_on_body
from physxnet_jax.garment._openings import openings
from physxnet_jax.garment._poses import POSES, posed_bodies
from physxnet_jax.garment._search import UNITS, plausible_units, turns
from physxnet_jax.geometry import boundary_loops
from physxnet_jax.io import StaticMesh, write_obj

FLOOR = -0.819


def still(vertices, faces, **declared) -> StaticMesh:
    faces = np.asarray(faces)
    x = np.asarray(vertices, float)
    return StaticMesh(x, faces, None, None, None, len(faces), **declared)


def modelled(garment, pose: str):
    """Vertices of a garment on the body in another pose."""
    at = posed_bodies(load_body())[pose]
    x, w = np.asarray(garment.mesh.vertices, float), np.asarray(garment.skin, float)
    return np.einsum("vj,jab,vb->va", w, at.rotations, x) + w @ at.translations


def located(vertices, garment, hints=NO_HINTS, **declared):
    mesh = still(vertices, garment.mesh.faces, **declared)
    return locate_on_body(pathlib.Path("a.obj"), mesh, load_body(), hints)


@pytest.fixture(scope="module")
def wardrobe():
    kinds = ("tee", "shirt", "trousers", "shorts", "aline", "pencil")
    return {kind: tailor(kind) for kind in kinds}


@pytest.mark.parametrize("kind", ["tee", "shirt", "trousers", "shorts", "aline", "pencil"])
@pytest.mark.parametrize(
    ("unit", "pose", "raised", "turned"),
    [
        ("m", "T-pose", -0.25, False),
        ("cm", "T-pose", -FLOOR, False),
        ("mm", "rest", -FLOOR, False),
        ("cm", "rest", 0.0, True),
        ("m", "A-pose, arms at 25 degrees", -0.25, False),
    ],
)
@pytest.mark.sampled(10)
@pytest.mark.release
def test_frames_of_known_bodies_are_found(kind, unit, pose, raised, turned, wardrobe):
    """SMPL's origin, feet on the floor, facing backwards: within 3.5 cm of the truth."""
    garment = wardrobe[kind]
    x = (modelled(garment, pose) + [0.0, raised, 0.0]) / UNITS[unit]
    found = located(x * [-1.0, 1.0, -1.0] if turned else x, garment)
    assert found.unit == unit and found.up == "Y"
    off = np.linalg.norm(found.vertices - np.asarray(garment.mesh.vertices), axis=1)
    assert np.quantile(off, 0.95) < 0.035


@pytest.mark.release
@pytest.mark.parametrize("kind", ["shirt", "trousers"])
def test_garments_of_the_rest_pose_stay_exactly(kind, wardrobe):
    garment = wardrobe[kind]
    x = np.asarray(garment.mesh.vertices, float)
    found = located(x, garment)
    np.testing.assert_array_equal(found.vertices, x)
    assert (found.unit, found.up, found.pose, found.notes) == ("m", "Y", "rest", ())


@pytest.mark.release
def test_sleeves_follow_the_arms_out_of_a_t_pose(wardrobe):
    """Arms pass through the sleeves; the control: at rest no arm passes through them there."""
    garment = wardrobe["shirt"]
    found = located(modelled(garment, "T-pose"), garment)
    assert found.pose == "T-pose"
    limbs = {o.limbs for o in found.openings}
    assert {("left arm",), ("right arm",), ("head",), ("left leg", "right leg")} == limbs
    bodies = posed_bodies(load_body())
    loops = boundary_loops(np.asarray(garment.mesh.faces))
    x = modelled(garment, "T-pose")
    assert any(not o.limbs for o in openings(x, loops, bodies["rest"].limbs))


@pytest.mark.release
@pytest.mark.parametrize("kind", ["tee", "shirt"])
def test_the_low_side_of_a_neckline_is_the_front(kind, wardrobe):
    """Also against the distance from the skin: deepened, the shirt fits either way."""
    garment = wardrobe[kind]
    x = np.asarray(garment.mesh.vertices, float) * [1.3, 1.0, 1.0]
    thick = x + np.where(x[:, 2:] < 0.02, [[0.0, 0.0, -0.05]], 0.0)
    mesh = still(100 * thick, garment.mesh.faces)
    for found in (
        located(100 * thick, garment),
        align_to_template(mesh, template("top"), load_body())[0],
    ):
        assert not any("turned" in n for n in found.notes)
    # The control: worn backwards it is turned.
    back = located(100 * thick * [-1.0, 1.0, -1.0], garment)
    assert any("turned by 180" in n for n in back.notes)


@pytest.mark.release
def test_shorts_aligned_with_trousers_stay_short(wardrobe):
    garment = wardrobe["shorts"]
    x = 100 * (np.asarray(garment.mesh.vertices, float) + [0.0, 0.4, 0.1])
    mesh = still(x, garment.mesh.faces)
    found, description, _ = align_to_template(mesh, template("bottom"), load_body())
    assert found.unit == "cm" and "scaled by 0.01," in description and "Y up" in description
    height = np.ptp(np.asarray(garment.mesh.vertices)[:, 1])
    assert np.ptp(found.vertices[:, 1]) == pytest.approx(height, rel=1e-3)
    assert found.vertices[:, 1].max() == pytest.approx(0.1, abs=0.06)


@pytest.mark.release
def test_the_most_alike_template_is_the_one_with_the_best_place(wardrobe):
    """Found once for all templates, it is what each search for itself finds."""
    garment = wardrobe["shorts"]
    x = 100 * (np.asarray(garment.mesh.vertices, float) + [0.0, 0.4, 0.1])
    mesh = still(x, garment.mesh.faces)
    templates = [template(t) for t in ("top", "bottom", "dress")]
    name, placed, described = most_alike(mesh, templates, load_body())
    each = {t.template: align_to_template(mesh, t, load_body()) for t in templates}
    costs = {t: cost for t, (_, _, cost) in each.items()}
    assert costs[name] == min(costs.values()) < max(costs.values())
    np.testing.assert_array_equal(placed.vertices, each[name][0].vertices)
    assert described == each[name][1]


def test_where_the_skin_is_far_weights_are_smoothed_and_nowhere_else():
    rng = np.random.default_rng(0)
    k = np.arange(30)
    faces = np.stack([k, k + 1, (k + 2)], axis=1)
    weights = np.zeros((32, 6), np.float32)
    weights[:, [1, 4]] = rng.dirichlet([1.0, 1.0], 32)
    distance = np.where(np.arange(32) < 16, 0.0, 0.1)
    found = _smooth_far(weights, faces, distance)
    np.testing.assert_allclose(found[:16], weights[:16], atol=1e-6)
    np.testing.assert_allclose(found.sum(axis=1), 1.0, atol=1e-12)
    assert not found[:, [0, 2, 3, 5]].any(), "joints that nothing hangs on"
    rough = [np.abs(np.diff(w[16:, 1])).max() for w in (weights, found)]
    assert rough[1] < 0.2 * rough[0]
    # The control: near the skin everywhere, nothing changes.
    np.testing.assert_allclose(_smooth_far(weights, faces, 0.0 * distance), weights, atol=1e-6)


def cape():
    """A cape in metres, as it hangs from the shoulders."""
    skin = np.asarray(load_body().rest_mesh().vertices)
    back = skin[(np.abs(skin[:, 0]) < 0.03) & (np.abs(skin[:, 1] - 0.4) < 0.02), 2].min()
    u, t = (a.ravel() for a in np.meshgrid(np.linspace(-0.17, 0.17, 12), np.linspace(0, 1, 20)))
    x = np.stack([u * (1 + t), 0.45 - 0.9 * t, back - 0.012 - 0.1 * t - 0.3 * u**2], axis=1)
    k = np.arange(19 * 12).reshape(19, 12)[:, :-1].ravel()
    return x, np.concatenate([np.stack([k, k + 1, k + 13], 1), np.stack([k, k + 13, k + 12], 1)])


def glb(path, x, faces):
    """A glTF of one mesh, written by hand."""
    binary = x.astype("<f4").tobytes() + faces.astype("<u4").tobytes()
    views = [
        {"buffer": 0, "byteOffset": 0, "byteLength": 12 * len(x)},
        {"buffer": 0, "byteOffset": 12 * len(x), "byteLength": 12 * len(faces)},
    ]
    accessors = [
        {
            "bufferView": 0,
            "componentType": 5126,
            "count": len(x),
            "type": "VEC3",
            "min": x.min(axis=0).tolist(),
            "max": x.max(axis=0).tolist(),
        },
        {"bufferView": 1, "componentType": 5125, "count": 3 * len(faces), "type": "SCALAR"},
    ]
    document = {
        "asset": {"version": "2.0"},
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [{"mesh": 0, "name": "cape"}],
        "meshes": [{"primitives": [{"attributes": {"POSITION": 0}, "indices": 1}]}],
        "accessors": accessors,
        "bufferViews": views,
        "buffers": [{"byteLength": len(binary)}],
    }
    text = json.dumps(document).encode()
    text += b" " * (-len(text) % 4)
    chunks = struct.pack("<II", len(text), 0x4E4F534A) + text
    chunks += struct.pack("<II", len(binary), 0x004E4942) + binary
    path.write_bytes(struct.pack("<4sII", b"glTF", 2, 12 + len(chunks)) + chunks)


@pytest.mark.parametrize("suffix", [".obj", ".glb"])
def test_capes_stay_in_metres(suffix, tmp_path):
    """Read as decimetres it would lie, 9 cm high, between the feet."""
    x, faces = cape()
    path = tmp_path / f"cape{suffix}"
    (glb if suffix == ".glb" else write_obj)(path, x, faces)
    garment, report = load_garment(path)
    assert (report.unit, report.up, report.pose) == ("m", "Y", "rest")
    assert np.ptp(np.asarray(garment.mesh.vertices)[:, 1]) == pytest.approx(0.9, abs=0.02)


def test_declared_units_count_first(wardrobe):
    """Unless they are impossible, which is said."""
    garment = wardrobe["tee"]
    x = np.asarray(garment.mesh.vertices, float)
    assert located(x, garment, unit="m", up="y").notes == ()
    wrong = located(100 * x, garment, unit="m", up="y")
    assert wrong.unit == "cm" and "declares m" in wrong.notes[0]


def test_hints_overrule_what_would_be_found(wardrobe):
    garment = wardrobe["aline"]
    x = np.asarray(garment.mesh.vertices, float)
    lying = np.stack([x[:, 0], -x[:, 2], x[:, 1]], axis=1)
    found = located(lying, garment, Hints(up="z", front="-y"))
    np.testing.assert_allclose(found.vertices, x, atol=1e-9)
    assert found.up == "Z" and not found.notes
    assert located(x / 0.0254, garment, Hints(unit="inch")).unit == "inch"
    back = located(x, garment, Hints(front="-z"))
    assert any("turned by 180" in n for n in back.notes)
    with pytest.raises(MeshError, match="no unit"):
        located(x, garment, Hints(unit="mm"))


def test_words_carry_unit_and_axes(tmp_path, wardrobe):
    garment = wardrobe["tee"]
    x, faces = np.asarray(garment.mesh.vertices), np.asarray(garment.mesh.faces)
    path = tmp_path / "tee.obj"
    write_obj(path, 100 * np.stack([x[:, 0], -x[:, 2], x[:, 1]], axis=1), faces)
    worn, report = load_garment(f"{path}:unit=cm,up=z,front=-y")
    assert (report.unit, report.up) == ("cm", "Z")
    assert np.abs(np.asarray(worn.mesh.vertices) - x).max() < 0.005
    for wrong in ("unit=ell", "up=w", "up=y,front=-y"):
        with pytest.raises(PhysXNetError):
            load_garment(f"{path}:{wrong}")


@pytest.mark.parametrize("parts", [1, 4])
def test_sewing_patterns_are_refused_by_name(parts):
    """Flat panels beside each other; the control: the same sheets bent round the body."""
    u, v = (a.ravel() for a in np.meshgrid(np.linspace(0, 0.5, 9), np.linspace(0, 0.6, 9)))
    k = np.arange(8 * 9).reshape(8, 9)[:, :-1].ravel()
    sheet = np.concatenate([np.stack([k, k + 1, k + 10], 1), np.stack([k, k + 10, k + 9], 1)])
    panels = [np.stack([u + 0.6 * n, v, 0 * u], axis=1) for n in range(parts)]
    faces = np.concatenate([sheet + 81 * n for n in range(parts)])
    mesh = still(np.concatenate(panels) + [0.0, 3.0, 5.0], faces)
    word = "flat panels" if parts > 1 else "flat sheet"
    with pytest.raises(MeshError, match=word):
        locate_on_body(pathlib.Path("p.obj"), mesh, load_body())


def test_sizes_decide_between_units():
    assert list(plausible_units(2.1)) == ["m"], "a wide robe isn't one of 21 cm"
    assert list(plausible_units(170.0)) == ["cm"] and list(plausible_units(900.0)) == ["mm"]
    assert set(plausible_units(0.12)) == {"m"}, "a bow tie"
    assert not plausible_units(1e5)


def test_turns_are_rotations_that_put_the_axes_up_and_forward():
    for turn in turns(None, None, every=True):
        np.testing.assert_allclose(turn.matrix @ turn.matrix.T, np.eye(3), atol=1e-12)
        assert np.linalg.det(turn.matrix) == pytest.approx(1.0)
    (turn,) = turns("z", "x")
    np.testing.assert_allclose(turn.matrix @ [0, 0, 1], [0, 1, 0], atol=1e-12)
    np.testing.assert_allclose(turn.matrix @ [1, 0, 0], [0, 0, 1], atol=1e-12)


@pytest.mark.parametrize("count", [20, 2000])
def test_limbs_pass_through_rings_about_them(count):
    """A ring about a limb's line, and one beside it."""
    bodies = posed_bodies(load_body())
    assert set(bodies) == set(POSES)
    for posed in bodies.values():
        for limb, line in posed.limbs.items():
            middle, along = 0.5 * (line[-3] + line[-2]), line[-2] - line[-3]
            along = along / np.linalg.norm(along)
            side = np.cross(along, [0.3, 0.2, 0.9])
            side /= np.linalg.norm(side)
            angle = np.linspace(0, 2 * np.pi, count, endpoint=False)[:, None]
            ring = 0.06 * (np.cos(angle) * side + np.sin(angle) * np.cross(along, side))
            loops = [np.arange(count, dtype=np.int32)]
            (around,) = openings(middle + ring, loops, posed.limbs)
            assert around.limbs == (limb,)
            (beside,) = openings(middle + ring + 0.5 * side, loops, posed.limbs)
            assert limb not in beside.limbs


def outfit(path, **meshes):
    """An OBJ of several objects: vertices and triangles by name."""
    lines, first = [], 1
    for name, (x, faces) in meshes.items():
        lines += [f"o {name}", *(f"v {a} {b} {c}" for a, b, c in x)]
        lines += ["f " + " ".join(str(k + first) for k in f) for f in faces]
        first += len(x)
    path.write_text("\n".join(lines) + "\n")
    return path


@pytest.mark.release
def test_outfits_are_split_and_their_buttons_ride_along(tmp_path, wardrobe):
    """A shirt with a button and trousers, displaced together; the control: a shirt in two parts."""
    shirt, trousers = (
        (np.asarray(wardrobe[k].mesh.vertices, float), np.asarray(wardrobe[k].mesh.faces))
        for k in ("tee", "trousers")
    )
    front = shirt[0][np.argmax(shirt[0][:, 2])]
    button = front + 0.01 * np.array([[0, 0, 0.5], [1, 0, 0.5], [0, 1, 0.5]]), np.array([[0, 1, 2]])
    moved = {
        name: (100 * (x + [0.0, -FLOOR, 0.0]), f)
        for name, (x, f) in {"tee": shirt, "button": button, "jeans": trousers}.items()
    }
    found = load_outfit(outfit(tmp_path / "a.obj", **moved))
    assert [g.template for g, _ in found] == ["bottom", "top"]
    assert found[0][0].num_vertices == len(trousers[0])
    assert found[1][0].num_vertices == len(shirt[0]) + 3
    assert np.abs(np.asarray(found[0][0].mesh.vertices) - trousers[0]).max() < 0.01
    named = load_garment(f"{tmp_path / 'a.obj'}#button+tee")[0]
    assert named.num_vertices == len(shirt[0]) + 3
    left = (shirt[0][shirt[1], 0] > 0).all(axis=1)
    halves = {"left": (shirt[0], shirt[1][left]), "right": (shirt[0], shirt[1][~left])}
    assert len(load_outfit(outfit(tmp_path / "b.obj", **halves))) == 1
    with pytest.raises(FormatError, match="no mesh 'hat'"):
        load_garment(f"{tmp_path / 'a.obj'}#hat")
