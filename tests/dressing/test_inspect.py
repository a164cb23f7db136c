"""Files that users have: wrong units, torn, inside out, in the body; seen and mended."""

import json
import pathlib

import numpy as np
import pytest

from physxnet_jax.body import load_body, t_pose
from physxnet_jax.cli import main
from physxnet_jax.dressing import dress, fit_garment, inspect_garment
from physxnet_jax.dressing._settle import settle_on_body
from physxnet_jax.errors import FormatError, MeshError
from physxnet_jax.garment import decimate, load_garment, template
from physxnet_jax.garment._align import align_to_template
from physxnet_jax.garment._load import carried, guess_template
from physxnet_jax.garment._locate import locate_on_body
from physxnet_jax.geometry import make_mesh
from physxnet_jax.io import StaticMesh, read_obj, write_obj


@pytest.fixture(scope="module")
def trousers():
    g = template("bottom")
    return np.asarray(g.mesh.vertices, float), np.asarray(g.mesh.faces)


def still(vertices, faces) -> StaticMesh:
    faces = np.asarray(faces)
    return StaticMesh(np.asarray(vertices, float), faces, None, None, None, len(faces))


def saved(folder: pathlib.Path, name: str, vertices, faces, uv=None, uv_faces=None) -> pathlib.Path:
    path = folder / name
    write_obj(path, vertices, faces, uv, uv_faces)
    return path


@pytest.mark.release
def test_clean_garment_is_reported_ready(tmp_path, trousers):
    found = inspect_garment(saved(tmp_path, "a.obj", *trousers))
    assert (found.unit, found.up, found.template) == ("m", "Y", "bottom")
    assert found.problems == () and found.command is None and found.verdict.startswith("ready")
    assert found.health.components == 1 and len(found.health.openings) == 3
    assert found.hit_rate > 0.95 and found.outward > 0.95 and found.inside < 0.02


@pytest.mark.nightly
def test_all_faults_are_reported_and_repaired(tmp_path, trousers):
    v, faces = trousers
    alone = np.arange(faces.size).reshape(-1, 3)
    torn = v[faces.ravel()]
    # Centimetres, Z up, every triangle by itself, a third of them inside out, one twice.
    turned = np.where(np.arange(len(faces))[:, None] % 3 == 0, alone[:, ::-1], alone)
    turned = np.concatenate([turned, turned[:1]])
    z_up = 100.0 * (torn * [1.0, 1.0, -1.0])[:, [0, 2, 1]]
    path = saved(tmp_path, "sick.obj", z_up, turned)
    found = inspect_garment(path)
    assert (found.unit, found.up) == ("cm", "Z")
    told = " ".join(found.problems)
    for word in ("coincide", "twice", "cloth tears"):
        assert word in told
    out = tmp_path / "well.obj"
    assert found.command == f"physxnet fit {path} -o sick_fitted.obj"
    done, after = fit_garment(path, out)
    assert after.problems == () and after.unit == "m" and after.health.components == 1
    assert any("welded" in d for d in done) and any("flipped" in d for d in done)
    mended = read_obj(out)
    assert len(mended.vertices) == len(v)
    assert path.read_text() != out.read_text(), "the file itself isn't changed"


@pytest.mark.release
def test_non_manifold_edge_is_a_note_and_not_a_problem(tmp_path, trousers):
    v, faces = trousers
    out = v[faces[5, :1]] + [[0.0, 0.0, 0.0]]
    fin = np.concatenate([v, out * [1.1, 1.0, 1.1]])
    path = saved(tmp_path, "fin.obj", fin, np.concatenate([faces, [[*faces[5, :2], len(v)]]]))
    found = inspect_garment(path)
    assert not any("winding" in p for p in found.problems)
    assert any("more than two faces" in n for n in found.notes)


def test_unreferenced_vertices_are_pinned_to_the_skin(tmp_path, trousers):
    v, faces = trousers
    loose = np.concatenate([v, v[:1] + [[0.0, 0.0, 0.02]]])
    garment, _ = load_garment(saved(tmp_path, "a.obj", loose, faces))
    whole, _ = load_garment(saved(tmp_path, "b.obj", v, faces))
    assert bool(garment.pinned[-1])
    np.testing.assert_array_equal(garment.pinned[:-1], whole.pinned)


def test_template_of_a_file_can_be_specified(tmp_path):
    g = template("dress")
    path = saved(tmp_path, "coat.obj", np.asarray(g.mesh.vertices), np.asarray(g.mesh.faces))
    assert load_garment(path)[0].template == "dress"
    coat, report = load_garment(f"{path}:as=top")
    assert coat.template == report.template == "top" and coat.name == "coat"
    with pytest.raises(MeshError, match=r"coat\.obj=hat"):
        load_garment(f"{path}=hat")


@pytest.mark.release
def test_dressed_cloth_is_unchanged_by_fitting(tmp_path, trousers):
    v, faces = trousers
    path = saved(tmp_path, "inch.obj", v / 0.0254, faces)
    fit_garment(path, tmp_path / "m.obj")
    worn = dress("walk", [str(tmp_path / "m.obj")], method="lbs", frames=3, include_body=False)
    same = dress("walk", [str(path)], method="lbs", frames=3, include_body=False)
    np.testing.assert_allclose(worn.garments[0].positions, same.garments[0].positions, atol=2e-4)


@pytest.mark.release
def test_distance_to_each_template_is_reported(tmp_path, trousers, capsys):
    path = saved(tmp_path, "a.obj", *trousers)
    found = inspect_garment(path)
    assert found.apart["bottom"] < 1e-4 and found.apart["dress"] > 0.02
    assert found.apart["top"] > 0.1 and min(found.apart, key=found.apart.__getitem__) == "bottom"
    main(["inspect", str(path)])
    assert "bottom 0 mm" in capsys.readouterr().out


@pytest.mark.release
def test_fitting_moves_cloth_out_of_the_body(tmp_path, trousers):
    v, faces = trousers
    thin = v * [0.9, 1.0, 0.9]
    found = inspect_garment(saved(tmp_path, "thin.obj", thin, faces))
    assert found.inside > 0.05 and "in the body" in " ".join(found.problems)
    _, after = fit_garment(tmp_path / "thin.obj", tmp_path / "out.obj")
    assert after.inside < 0.25 * found.inside


@pytest.mark.nightly
def test_misplaced_mesh_is_aligned_to_the_template(tmp_path, trousers):
    v, faces = trousers
    path = saved(tmp_path, "far.obj", 7.3 * v + [40.0, -3.0, 9.0], faces)
    found = inspect_garment(path)
    assert found.unit is None and "--like bottom" in str(found.command)
    with pytest.raises(MeshError, match="no unit"):
        fit_garment(path, tmp_path / "out.obj")
    done, after = fit_garment(path, tmp_path / "out.obj", like="bottom")
    assert "scaled by 0.137" in done[0] and after.template == "bottom"
    mended = read_obj(tmp_path / "out.obj").vertices
    assert np.percentile(np.linalg.norm(mended - v, axis=1), 90) < 0.005


@pytest.mark.release
def test_fitting_applies_the_requested_edge_lengths(tmp_path, trousers):
    pytest.importorskip("fast_simplification")
    path = saved(tmp_path, "a.obj", *trousers)
    done, found = fit_garment(path, tmp_path / "b.obj", coarser=0.04, edge_length=0.05)
    assert "decimated 5,366 faces" in done[1] and "split" in done[2]
    assert found.health.faces < 0.6 * len(trousers[1])
    # Vertices that are moved out of the body afterwards stretch edges a little.
    assert found.health.longest_edge < 0.055 and found.health.components == 1


@pytest.mark.nightly
def test_inspect_and_fit_commands_print_the_report(tmp_path, trousers, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    good, bad = (
        saved(tmp_path, "good.obj", *trousers),
        saved(tmp_path, "bad.obj", trousers[0], trousers[1][:, ::-1]),
    )
    assert main(["inspect", str(good)]) == 0
    assert "ready" in capsys.readouterr().out
    assert main(["inspect", str(good), str(bad), "--json"]) == 1
    rows = json.loads(capsys.readouterr().out)
    assert [r["command"] is None for r in rows] == [True, False]
    assert "point inwards" in " ".join(rows[1]["problems"])
    # The command it names does what it says.
    assert main([*rows[1]["command"].split()[1:]]) == 0
    assert "flipped 5,376 faces" in capsys.readouterr().out.replace(
        f"{len(trousers[1]):,}", "5,376"
    )
    assert main(["inspect", str(tmp_path / "bad_fitted.obj")]) == 0
    capsys.readouterr()
    assert main(["inspect", str(tmp_path / "none.obj")]) == 2
    assert "no such file" in capsys.readouterr().err
    assert main(["fit", str(good), "-o", str(tmp_path / "a.stl")]) == 2


@pytest.mark.parametrize("text", ["", "v 0 0 0\n", "v 0 0 0\nv 1 0 0\nv 0 1 nan\nf 1 2 3\n"])
def test_broken_files_are_refused(tmp_path, text):
    path = tmp_path / "x.obj"
    path.write_text(text)
    with pytest.raises(FormatError):
        inspect_garment(path)
    with pytest.raises(FormatError):
        fit_garment(path, tmp_path / "out.obj")
    assert not (tmp_path / "out.obj").exists()


@pytest.mark.release
def test_real_garment_report_is_correct(data_dir):
    """Decimetres; torn nowhere, but some of it lies in our body."""
    found = inspect_garment(data_dir / "garments" / "tee.obj")
    assert (found.unit, found.up, found.template) == ("dm", "Y", "top")
    assert found.health.components == 1 and len(found.health.openings) == 4
    assert found.outward > 0.9 and found.hit_rate > 0.8


@pytest.mark.release
def test_fitted_real_dress_is_reported_ready(data_dir, tmp_path):
    """Close to the body and split finely: none of it may end where it has to be lifted again."""
    done, found = fit_garment(
        data_dir / "garments" / "F_Dress_01.obj", tmp_path / "dress.obj", edge_length=0.02
    )
    assert any("lifted" in line for line in done)
    assert found.problems == () and found.template == "dress" and found.inside == 0.0


@pytest.mark.sampled(1)
@pytest.mark.release
@pytest.mark.parametrize("name", ["top", "bottom", "dress"])
def test_alignment_recovers_any_axis_and_heading(name):
    """Of a mesh that is the template, turned: to where the template's vertices are."""
    garment = template(name)
    there = np.asarray(garment.mesh.vertices, np.float64)
    x, y, z = there.T
    lying = {
        "Y up": (x, y, z),
        "Y up, turned by 90": (-z, y, x),
        "Y up, turned by 180": (-x, y, -z),
        "Z up": (x, -z, y),
        "Z up, turned by 180": (-x, z, y),
        "X up": (y, -x, z),
    }
    for how, axes in lying.items():
        moved = still(100.0 * np.stack(axes, axis=1) + 40.0, garment.mesh.faces)
        placement, told, off = align_to_template(moved, garment, load_body())
        assert np.abs(placement.vertices - there).max() < 1e-6, f"{how}: {told}"
        assert how[:4] in told and ("turned" in told) == ("turned" in how) and off < 0.2


@pytest.mark.nightly
def test_floating_garment_is_settled_on_the_body(tmp_path, capsys):
    """A sleeveless top with a wide neck, placed too high, rests on the shoulders in the end."""
    g = template("top")
    v, faces = np.asarray(g.mesh.vertices), np.asarray(g.mesh.faces)
    neck = (np.abs(v[:, 0]) < 0.1) & (v[:, 1] > v[:, 1].max() - 0.12)
    gone = neck | (np.abs(v[:, 0]) > 0.19)
    faces = faces[~gone[faces].any(axis=1)]
    used, faces = np.unique(faces, return_inverse=True)
    v, faces = v[used], faces.reshape(-1, 3)
    path = saved(tmp_path, "high.obj", v + [0.0, 0.04, 0.0], faces)
    found = inspect_garment(path)
    assert found.hangs > 0.02 and any("holds it up" in p for p in found.problems)
    assert (
        "--drape" in found.command
        and inspect_garment(saved(tmp_path, "a.obj", v, faces)).hangs < 0.015
    )
    worn = dress("walk", [path, "bottom"], method="lbs", frames=2)
    assert len(worn.notes) == 1 and "off the skin" in worn.notes[0] and path.name in worn.notes[0]
    out = tmp_path / "low.obj"
    assert main(["fit", str(path), "--drape", "--edge-length", "20", "-o", str(out)]) == 0
    assert "settled it on the body" in capsys.readouterr().out
    assert not dress("walk", [out], method="lbs", frames=2).notes
    after = inspect_garment(out)
    assert after.hangs < 0.01 and after.inside < 0.02
    before, lain = (load_garment(p)[0].mesh for p in (path, out))
    a, b = faces[:, 0], faces[:, 1]
    lengths = [
        np.linalg.norm(np.asarray(m.vertices)[a] - np.asarray(m.vertices)[b], axis=1)
        for m in (before, lain)
    ]
    assert np.median(np.abs(lengths[1] / lengths[0] - 1)) < 0.03


@pytest.mark.release
def test_garment_that_falls_off_is_refused(tmp_path):
    """A ring about the chest, too wide to rest on anything."""
    around = np.linspace(0.0, 2 * np.pi, 40, endpoint=False)
    ring = np.stack([0.45 * np.sin(around), 0 * around, 0.45 * np.cos(around)], axis=1)
    v = np.concatenate([ring + [0.0, h, 0.0] for h in (0.2, 0.25, 0.3)])
    n = np.arange(40)
    quads = [
        (k * 40 + n, k * 40 + (n + 1) % 40, (k + 1) * 40 + (n + 1) % 40, (k + 1) * 40 + n)
        for k in (0, 1)
    ]
    faces = np.concatenate(
        [np.stack(c, axis=1) for a, b, c_, d in quads for c in ((a, b, c_), (a, c_, d))]
    )
    hoop = carried(make_mesh(v, faces), "top", "hoop", load_body())
    with pytest.raises(MeshError, match="hoop: falls off"):
        settle_on_body(hoop)


@pytest.mark.parametrize("name", ["top", "bottom", "dress"])
def test_template_report_matches_the_report_of_its_file(tmp_path, name):
    g = template(name)
    path = saved(tmp_path, "a.obj", np.asarray(g.mesh.vertices), np.asarray(g.mesh.faces))
    named, read = (load_garment(what)[1] for what in (name, path))
    assert (named.vertices, named.faces, named.topology) == (
        read.vertices,
        read.faces,
        read.topology,
    )
    for field in ("distance", "hangs", "longest_edge", "inside"):
        assert getattr(named, field) == pytest.approx(getattr(read, field), abs=1e-6), field
    assert named.warning is None and read.warning is None and named.distance > 0.005


def test_garments_with_two_legs_are_classified_as_trousers(data_dir, trousers):
    """Overalls and tights with feet: two tubes, though they reach to the neck or have no opening."""
    raw = read_obj(data_dir / "garments/helper_tights.obj")
    v = locate_on_body(data_dir / "tights.obj", raw, load_body()).vertices
    assert guess_template(v, raw.faces) == "bottom"
    low = (v[raw.faces, 1] < 0.1).all(axis=1)
    assert guess_template(v, raw.faces[low]) == "bottom"
    # The controls: a dress, trousers, a top.
    for name in ("dress", "bottom", "top"):
        mesh = template(name).mesh
        assert guess_template(np.asarray(mesh.vertices), np.asarray(mesh.faces)) == name


@pytest.mark.nightly
@pytest.mark.parametrize("what", ["backwards", "too high"])
def test_displaced_top_is_aligned_to_its_template(tmp_path, what):
    """Lifted out where it lies it would be ruined: it is moved to where it belongs."""
    mesh = template("top").mesh
    v = np.asarray(mesh.vertices, float)
    turned = v * [-1.0, 1.0, -1.0] if what == "backwards" else v + [0.0, 0.13, 0.0]
    path = saved(tmp_path, "a.obj", turned, np.asarray(mesh.faces))
    found = inspect_garment(path)
    word = {"backwards": "turned by 180 degrees", "too high": "moved to where it fits"}[what]
    assert any(word in note for note in found.notes) and not found.problems
    placed = np.asarray(load_garment(path)[0].mesh.vertices)
    assert np.quantile(np.linalg.norm(placed - v, axis=1), 0.95) < 0.015
    # The control: deep in the body where it belongs it isn't.
    thin = saved(tmp_path, "c.obj", v * [0.97, 1.0, 0.9], np.asarray(mesh.faces))
    assert "--like" not in (inspect_garment(thin).command or "")


@pytest.mark.nightly
@pytest.mark.parametrize("name", ["top", "bottom", "dress"])
@pytest.mark.parametrize("change", ["backwards", "aside", "too small", "on the floor"])
def test_displaced_garments_are_aligned_to_their_template(name, change, tmp_path, body):
    mesh = template(name).mesh
    floor = float(np.asarray(body.rest_mesh().vertices)[:, 1].min())
    x = np.asarray(mesh.vertices)
    x = {
        "backwards": x * [-1, 1, -1],
        "aside": x + [0.2, 0, 0],
        "too small": x * 0.8,
        "on the floor": x - [0, floor, 0],
    }[change]
    path = tmp_path / "a.obj"
    write_obj(path, x, np.asarray(mesh.faces))
    found = inspect_garment(path)
    if change != "too small":
        assert found.template == name and found.notes and found.inside < 0.05
        # Fitted trousers lie on the skin: a centimetre is enough to put some of them into it.
        assert not found.problems or (name, change) == ("bottom", "aside")
        placed = np.asarray(load_garment(path)[0].mesh.vertices)
        away = np.linalg.norm(placed - np.asarray(mesh.vertices), axis=1)
        assert np.quantile(away, 0.95) < 0.02
        return
    # Refused or called ill-fitting, with the command that makes it fit.
    said = " ".join(found.problems)
    assert f"--like {name}" in found.command and ("elsewhere" in said or "no unit" in said)
    done, after = fit_garment(path, tmp_path / "b.obj", like=name)
    assert after.inside < 0.02 and after.template == name and done


@pytest.mark.release
def test_objects_of_a_file_are_separate_garments(tmp_path):
    lines, first = [], 1
    for name in ("top", "bottom"):
        mesh = template(name).mesh
        lines += [f"o my {name}", *(f"v {a} {b} {c}" for a, b, c in np.asarray(mesh.vertices))]
        lines += ["f " + " ".join(str(k + first) for k in f) for f in np.asarray(mesh.faces)]
        first += len(mesh.vertices)
    path = tmp_path / "outfit.obj"
    path.write_text("\n".join(lines) + "\n")
    found = inspect_garment(path)
    assert "several garments" in found.problems[0] and found.verdict.startswith("inspect each")
    assert all(f"outfit.obj#my {name}'" in found.command for name in ("top", "bottom"))
    for name in ("top", "bottom"):
        garment, _ = load_garment(f"{path}#my {name}")
        np.testing.assert_array_equal(garment.mesh.faces, template(name).mesh.faces)
        assert garment.template == name and garment.name == f"outfit_my {name}"
    with pytest.raises(FormatError, match="no mesh 'hat'; there is my bottom, my top"):
        load_garment(f"{path}#hat")
    # Groups where there are no objects; one piece in two groups is one garment.
    text = path.read_text().replace("o my", "g my")
    path.write_text(text)
    assert load_garment(f"{path}#my top")[0].num_vertices == template("top").num_vertices
    path.write_text(text.replace("g my top", "g cloth").replace("g my bottom", "g cloth"))
    assert not any("several" in p for p in inspect_garment(path).problems)


@pytest.mark.release
@pytest.mark.parametrize("name", ["top", "bottom"])
def test_garments_in_t_pose_are_moved_to_the_rest_pose(name, tmp_path, body, rest):
    g = template(name)
    pose = body.transforms(rest, t_pose(body), body.joint_positions(rest)[0][0])
    r, t = (np.asarray(x, float) for x in pose)
    w, x = np.asarray(g.skin, float), np.asarray(g.mesh.vertices, float)
    posed = np.einsum("vj,jab,vb->va", w, r, x) + w @ t
    path = saved(tmp_path, "t.obj", 100 * posed, np.asarray(g.mesh.faces))
    worn, report = load_garment(path)
    assert report.pose == "T-pose" and report.unit == "cm" and worn.template == name
    off = np.linalg.norm(np.asarray(worn.mesh.vertices) - x, axis=1)
    assert (
        np.quantile(off, 0.95) < 3e-3
        and np.quantile(np.linalg.norm(posed - x, axis=1), 0.95) > 0.05
    )
    assert any("T-pose" in note for note in inspect_garment(path).notes)
    done, _ = fit_garment(path, tmp_path / "rest.obj")
    assert any("T-pose" in d for d in done)
    assert load_garment(tmp_path / "rest.obj")[1].pose == "rest"
    # The control: what lies on the body at rest stays as it is.
    plain = load_garment(saved(tmp_path, "a.obj", x, np.asarray(g.mesh.faces)))
    assert plain[1].pose == "rest" and np.abs(np.asarray(plain[0].mesh.vertices) - x).max() < 2e-3


@pytest.mark.release
def test_real_garments_are_detected_in_the_rest_pose(data_dir):
    found = {p.stem: load_garment(p)[1].pose for p in (data_dir / "garments").glob("*.obj")}
    assert len(found) == 8 and set(found.values()) == {"rest"}


@pytest.mark.nightly
def test_edge_length_limit_holds_after_collision_resolution(tmp_path):
    coarse, _ = decimate(template("top").mesh, 0.07)
    path = saved(tmp_path, "a.obj", np.asarray(coarse.vertices), np.asarray(coarse.faces))
    assert "--edge-length 20" in inspect_garment(path).command
    _, after = fit_garment(path, tmp_path / "b.obj", edge_length=0.02)
    assert after.health.longest_edge < 0.025 and after.command is None


@pytest.mark.release
def test_cape_in_metres_is_loaded_unchanged(tmp_path, body):
    skin = np.asarray(body.rest_mesh().vertices)
    back = skin[(np.abs(skin[:, 0]) < 0.03) & (np.abs(skin[:, 1] - 0.4) < 0.02), 2].min()
    u, t = (a.ravel() for a in np.meshgrid(np.linspace(-0.2, 0.2, 21), np.linspace(0, 1, 41)))
    far = np.where(t < 0.15, 0.0, t - 0.15)
    cape = np.stack([u * (1 + t), 0.42 - t, back - 0.012 - 0.6 * far], axis=1)
    k = np.arange(40 * 21).reshape(40, 21)[:, :-1].ravel()
    faces = np.concatenate([np.stack([k, k + 1, k + 22], 1), np.stack([k, k + 22, k + 21], 1)])
    garment, report = load_garment(saved(tmp_path, "cape.obj", cape, faces))
    assert report.unit == "m" and report.pose == "rest"
    assert np.abs(np.asarray(garment.mesh.vertices) - cape).max() < 0.01
    # The control: as far off, and nothing of it touches the body.
    with pytest.raises(MeshError, match="no unit and up axis"):
        load_garment(saved(tmp_path, "far.obj", cape - [0.0, 0.0, 0.2], faces))
    # What hangs on by a sleeve is put in its place.
    top = template("top").mesh
    x = np.asarray(top.vertices) + np.float32([0.5, 0.0, 0.0])
    found = inspect_garment(saved(tmp_path, "top.obj", x, np.asarray(top.faces)))
    assert found.command is None and any("moved to where it fits" in n for n in found.notes)
