"""The web viewer: what is chosen is what is computed, and a browser shows it."""

import dataclasses
import io
import pathlib
import re
import runpy
import threading
import time
import zipfile

import jax.numpy as jnp
import numpy as np
import pytest
import trimesh
from rich.console import Console

from physxnet_jax.cli import main, parse
from physxnet_jax.cli._view import view
from physxnet_jax.dressing import Inference, Simulation
from physxnet_jax.errors import FormatError, PhysXNetError
from physxnet_jax.garment import template
from physxnet_jax.io import GltfFile, read_obj, write_obj
from physxnet_jax.motion import procedural_clip, save_motion

pytest.importorskip("viser")

from physxnet_jax.viewer import Choice, Viewer, record, run_job
from physxnet_jax.viewer._controls import METHOD_LABELS, _kinds

_BROWSER = runpy.run_path(str(pathlib.Path(__file__).parents[1] / "browser.py"))
_SAMPLES = runpy.run_path(str(pathlib.Path(__file__).parents[1] / "samples.py"))
SHORT = Choice("walk", ("bottom",), method="lbs", frames=10, fps=10.0)


@pytest.fixture(scope="module")
def viewer():
    it = Viewer(SHORT, port=8123)
    it.wait()
    yield it
    it.close()


@pytest.mark.release
def test_viewer_shows_the_selected_choice(viewer):
    assert viewer.shown.choice == SHORT and viewer.shown.num_frames == 10
    viewer.controls.settings["motion"].value = "balance"
    viewer.controls.worn["top"].value = True
    viewer.controls.shapes["weight_up"].value = 0.5
    shown = viewer.wait()
    assert shown.choice.motion == "balance" and shown.choice.wear == ("bottom", "top")
    assert shown.choice.shape == (("weight_up", 0.5),)
    assert [m.name for m in shown.garments] == ["bottom", "top"]
    slim = run_job(Choice("balance", ("bottom",), method="lbs", frames=2, fps=10.0))
    assert np.ptp(shown.garments[0].positions[0][:, 0]) > np.ptp(
        slim.garments[0].positions[0][:, 0]
    )
    viewer.controls.shapes["weight_up"].value = 0.0
    viewer.controls.worn["top"].value = False
    viewer.controls.settings["motion"].value = "walk"
    assert viewer.wait().choice == SHORT


@pytest.mark.release
def test_wait_covers_selections_not_yet_requested(viewer, monkeypatch):
    """Between a tick and the answer to it lies a moment: what was shown then is stale."""
    viewer.wait()
    late = threading.Timer(1.0, Viewer.ask, (viewer,))
    monkeypatch.setattr(viewer, "ask", late.start)
    viewer.controls.worn["top"].value = True
    assert [m.name for m in viewer.wait().garments] == ["bottom", "top"]
    monkeypatch.undo()
    viewer.controls.worn["top"].value = False
    assert viewer.wait().choice == SHORT


def test_viewer_shows_the_body_without_garments(viewer):
    viewer.controls.worn["bottom"].value = False
    assert viewer.wait().garments == ()
    viewer.controls.worn["bottom"].value = True
    assert len(viewer.wait().garments) == 1


def test_errors_are_reported_and_recovered_from(viewer, tmp_path):
    viewer.add_file("../../broken.bvh", b"HELLO")
    with pytest.raises(PhysXNetError, match="HIERARCHY"):
        viewer.wait()
    assert "HIERARCHY" in viewer.controls.status.content and ".." not in str(
        viewer.controls.files["broken.bvh"]
    )
    viewer.controls.settings["motion"].value = "walk"
    assert viewer.wait().choice == SHORT
    with pytest.raises(FormatError, match="neither a motion"):
        viewer.add_file("a.exe", b"MZ")


@pytest.mark.nightly
def test_uploaded_fabric_is_worn(viewer, tmp_path):
    viewer.controls.settings["method"].value = METHOD_LABELS["simulate"]
    viewer.controls.settings["frames"].value = 2
    light = viewer.wait().garments[0].positions
    viewer.add_file("lead.toml", b'base = "wool"\ndensity = 5.0\nstretch = 200.0\n')
    menu = viewer.controls.settings["fabric"]
    assert menu.value == "lead.toml"
    shown = viewer.wait()
    assert pathlib.Path(shown.choice.fabric).name == "lead.toml"
    assert np.abs(shown.garments[0].positions - light).max() > 1e-3
    with pytest.raises(FormatError, match=r"tin\.toml: a fabric has no 'weight'"):
        viewer.add_file("tin.toml", b"weight = 1.0\n")
    for _ in range(2):
        with pytest.raises(FormatError):
            viewer.add_file("tin.toml", b"weight = 1.0\n")
    assert "tin.toml" not in menu.options
    viewer.add_file("tin.toml", b"density = 1.0\n")
    assert menu.value == "tin.toml"
    menu.value = menu.options[0]
    viewer.controls.settings["method"].value = METHOD_LABELS["lbs"]
    viewer.controls.settings["frames"].value = SHORT.frames
    assert viewer.wait().choice == SHORT


def test_kinds_of_uploads_are_told_apart(tmp_path, body):
    _SAMPLES["rigged_person"](tmp_path / "hero.vrm", body)
    (tmp_path / "hero.vrm").rename(tmp_path / "person.glb")
    assert _kinds(tmp_path / "person.glb") == ("person",)
    top = template("top").mesh
    write_obj(tmp_path / "coat.obj", np.asarray(top.vertices), np.asarray(top.faces))
    content = trimesh.load_mesh(tmp_path / "coat.obj").export(file_type="glb")
    (tmp_path / "coat.glb").write_bytes(content)
    assert _kinds(tmp_path / "coat.glb") == ("garment",)
    assert _kinds(tmp_path / "coat.obj") == ("garment",)
    (tmp_path / "coat.glb").rename(tmp_path / "coat.vrm")
    with pytest.raises(FormatError, match="no person with a known skeleton"):
        _kinds(tmp_path / "coat.vrm")


@pytest.mark.release
def test_uploaded_character_is_dressed_and_exported_with_its_skin(viewer, tmp_path, body):
    _SAMPLES["rigged_person"](tmp_path / "hero.vrm", body, body.shape(weight_up=0.6))
    viewer.add_file("hero.vrm", (tmp_path / "hero.vrm").read_bytes())
    assert viewer.controls.settings["person"].value == "hero.vrm"
    shown = viewer.wait()
    assert shown.character is not None and [m.name for m in shown.garments] == ["bottom"]
    assert shown.meshes()[0] is shown.character.mesh and shown.maps(0) == {}
    assert shown.num_frames == len(shown.garments[0].positions) == SHORT.frames
    name, content = viewer.export(".glb")
    (tmp_path / name).write_bytes(content)
    assert GltfFile(tmp_path / name).document.skins
    # Another method goes on with the same fit.
    viewer.controls.settings["compare"].value = True
    again = viewer.wait()
    assert again.character is shown.character and set(again.distances) == {"bottom"}
    viewer.controls.settings["compare"].value = False
    viewer.controls.settings["person"].value = viewer.controls.settings["person"].options[0]
    assert viewer.wait().character is None


def test_garments_keep_the_order_in_which_they_were_named(tmp_path, monkeypatch):
    """Of two of one kind the first named is beneath, as `dress` has it; both of one name show."""
    there, top = [], template("top").mesh
    for folder in ("a", "b"):
        (tmp_path / folder).mkdir()
        there.append(str(tmp_path / folder / "vest.obj"))
        write_obj(there[-1], np.asarray(top.vertices), np.asarray(top.faces))
    named = (there[1], "top", there[0])

    def nothing(*_, **__):
        raise PhysXNetError("nothing")

    # What is chosen is asked here, not what comes of it.
    monkeypatch.setattr("physxnet_jax.viewer._web.run_job", nothing)
    it = Viewer(dataclasses.replace(SHORT, wear=named), port=8131)
    try:
        assert it.chosen().wear == named and len(it.controls.worn) == 5
        it.controls.worn["dress"].value = True
        assert it.chosen().wear == (*named, "dress")
        it.controls.worn["top"].value = False
        assert it.chosen().wear == (there[1], there[0], "dress")
    finally:
        it.close()


def test_file_contents_in_errors_are_escaped(viewer):
    viewer.add_file("a.bvh", b"<iframe srcdoc='x'>*b*")
    with pytest.raises(PhysXNetError):
        viewer.wait()
    assert (
        "<iframe" not in viewer.controls.status.content
        and "&lt;iframe" in viewer.controls.status.content
    )
    assert "\\*b\\*" in viewer.controls.status.content
    viewer.controls.settings["motion"].value = "walk"
    viewer.wait()


def test_invalid_choices_are_refused_before_the_server_starts():
    with pytest.raises(PhysXNetError, match="at least one"):
        Viewer(dataclasses.replace(SHORT, frames=0))
    with pytest.raises(PhysXNetError, match="No weights"):
        Viewer(dataclasses.replace(SHORT, method="network", inference=Inference(weights="none")))


def test_garments_and_body_share_the_floor_for_other_shapes(tmp_path):
    """The clip is cut before its lowest point: clothes and body are lowered alike."""
    still = procedural_clip("balance", fps=30.0)
    root = np.asarray(still.root).copy()
    root[:4, 1] += 0.2
    save_motion(tmp_path / "hop.npz", dataclasses.replace(still, root=jnp.asarray(root)))
    path = str(tmp_path / "hop.npz")
    choice = Choice(path, ("bottom",), method="lbs", frames=4, shape=(("height_up", 0.8),))
    shown = run_job(choice)
    body, trousers = (m.positions for m in shown.meshes())
    assert abs(body[..., 1].min()) < 0.01
    # The hem hangs at the ankles, not a hop above or below them.
    assert 0.0 < trousers[..., 1].min() - body[..., 1].min() < 0.15


@pytest.mark.release
def test_viewer_export_matches_the_shown_clip(viewer, tmp_path):
    shown = viewer.wait()
    name, content = viewer.export(".npz")
    assert name == "walk.npz"
    with np.load(io.BytesIO(content)) as data:
        np.testing.assert_array_equal(data["bottom_positions"], shown.garments[0].positions)
        assert data["body_positions"].shape == (10, 13380, 3)
    name, content = viewer.export(".pc2")
    with zipfile.ZipFile(io.BytesIO(content)) as archive:
        assert name == "walk.zip" and len(archive.namelist()) == 4
        (obj,) = (n for n in archive.namelist() if n.endswith("bottom.obj"))
        (tmp_path / "bottom.obj").write_bytes(archive.read(obj))
    assert len(read_obj(tmp_path / "bottom.obj").vertices) == 2726
    # A glTF in which nothing moves isn't taken for a motion.
    viewer.add_file("mine.glb", trimesh.load_mesh(tmp_path / "bottom.obj").export(file_type="glb"))
    assert [m.name for m in viewer.wait().garments] == ["bottom", "mine"]
    viewer.controls.worn["mine.glb"].value = False
    viewer.wait()


def test_page_skinning_matches_the_body(viewer, body):
    """Bones sent to the page move vertices as skinning does, but for the weights beyond four."""
    shown = viewer.wait()
    vertices = shown.meshes()[0].positions[5]
    weights = np.asarray(body.weights[: len(vertices)])
    x = np.asarray(shown.rest[: len(vertices)])
    order = np.argsort(-weights, axis=1)[:, :4]
    four = np.take_along_axis(weights, order, axis=1)
    four /= four.sum(axis=1, keepdims=True)
    moved = np.einsum("jab,vb->vja", shown.world[5], x) + shown.shift[5]
    seen = (np.take_along_axis(moved, order[:, :, None], axis=1) * four[:, :, None]).sum(axis=1)
    assert np.linalg.norm(seen - vertices, axis=1).max() < 0.01


@pytest.mark.release
def test_comparison_reports_distances_to_the_simulation():
    shown = run_job(Choice("balance", ("bottom",), method="lbs", frames=3, compare=True))
    d = shown.distances["bottom"]
    gap = shown.garments[0].positions - shown.reference[0].positions
    np.testing.assert_allclose(d, np.linalg.norm(gap, axis=2))
    assert 0 < d.mean() < 0.05 and "mm RMSE from the simulation" in shown.summary


@pytest.mark.nightly
def test_maps_display_velocity_and_acceleration():
    shown = run_job(Choice("punch", ("top",), inference=Inference(weights="paper"), frames=20))
    maps = shown.maps(10)
    assert {"velocity", "acceleration", "top"} == set(maps)
    still = run_job(Choice("balance", (), inference=Inference(weights="paper"), frames=1)).maps(0)
    grey = [np.abs(m["velocity"].astype(int) - 127).max() for m in (maps, still)]
    covered = (still["velocity"] != 255).any(axis=2)
    assert grey[0] > 100 and np.abs(still["velocity"][covered].astype(int) - 127).max() <= 1
    assert maps["top"].shape == (64, 64, 3)


@pytest.mark.nightly
def test_live_cloth_matches_the_clip_from_any_frame(viewer, apart):
    nano = Inference(weights="nano")
    choice = Choice(
        "walk", ("bottom",), method="network", inference=nano, frames=12, fps=30.0, live=True
    )
    shown = run_job(choice)
    assert shown.live is not None and np.isnan(shown.live.milliseconds)
    clip = shown.garments[0].positions
    for frame in (0, 1, 2, 9, 10, 4, 4):
        live = shown.live.frame(frame)["bottom"]
        assert apart(live, clip[frame]) < 1e-5, frame
    assert apart(live, clip[9]) > 0.01, "the clip moves"
    assert 0 < shown.live.milliseconds < np.inf
    # Guided cloth has a past: frame after frame it is the clip's, elsewhere it starts anew.
    guided = run_job(dataclasses.replace(choice, method="guided"))
    clip = guided.garments[0].positions
    for frame in (0, 1, 2):
        live = guided.live.frame(frame)["bottom"]
        assert apart(live, clip[frame]) < 2e-4, frame
        assert apart(live, clip[frame + 1]) > 2e-3, "the control: the frame after"
    assert np.isfinite(guided.live.frame(9)["bottom"]).all()
    # What only the network can answer isn't asked of skinning.
    assert run_job(dataclasses.replace(SHORT, live=True)).live is None


def test_checkboxes_switch_post_processing(viewer):
    w = viewer.controls.settings
    assert viewer.chosen().inference == SHORT.inference == Inference()
    w["tta"].value, w["strain"].value = True, False
    chosen = viewer.chosen().inference
    assert chosen.tta and chosen.strain_iterations == 0
    w["tta"].value, w["strain"].value = False, True
    assert viewer.wait().choice == SHORT


@pytest.mark.release
def test_viewer_shows_live_cloth_and_its_time(viewer):
    viewer.controls.playing.value = False
    settings = viewer.controls.settings
    settings["weights"].value, settings["method"].value = "nano", METHOD_LABELS["network"]
    viewer.controls.settings["live"].value = True
    shown = viewer.wait()
    assert shown.choice.live and viewer.controls.pace.visible
    asked = []
    frame = shown.live.frame
    shown.live.frame = lambda index: asked.append(index) or frame(index)
    for index in (9, 5, 0):
        viewer.controls.frame.value = index
    assert asked == [9, 5, 0] and "ms a frame, live" in viewer.controls.pace.content
    assert "nan" not in viewer.controls.pace.content
    viewer.controls.settings["live"].value = False
    viewer.controls.settings["method"].value = METHOD_LABELS["lbs"]
    viewer.controls.settings["weights"].value = SHORT.inference.weights
    assert viewer.wait().choice == SHORT and not viewer.controls.pace.visible
    viewer.controls.playing.value = True


def test_recorded_page_is_a_single_complete_file(tmp_path):
    path = tmp_path / "walk.html"
    record(path, SHORT)
    text = path.read_text(encoding="utf-8")
    assert "__VISER_EMBED_DATA__" in text and len(text) > 1e6
    policy = re.search(r'<head><meta http-equiv="Content-Security-Policy" content="([^"]*)">', text)
    assert policy is not None and "default-src 'none'" in policy[1]
    assert not re.search(r"http|\*|'self'", policy[1])
    assert [p.name for p in tmp_path.iterdir()] == ["walk.html"]


def test_view_command_writes_pages_and_serves_until_stopped(tmp_path, capsys, monkeypatch):
    path = tmp_path / "walk.html"
    words = ["view", "walk", "--wear", "bottom", "--method", "lbs", "--frames", "3", "--fps", "10"]
    assert main([*words, "--html", str(path)]) == 0
    assert "wrote" in capsys.readouterr().out and path.stat().st_size > 1e6
    assert main([*words, "--html", str(tmp_path / "walk.txt")]) == 2
    over = threading.Event()
    over.set()
    opened = []
    monkeypatch.setattr("webbrowser.open", opened.append)
    monkeypatch.delenv("SSH_CONNECTION", raising=False)
    console = Console(file=io.StringIO(), width=200)
    assert view(parse([*words, "--port", "8300"]), console, over=over) == 0
    assert len(opened) == 1 and re.fullmatch(
        r"http://127\.0\.0\.1:8300/\?token=[\w-]{22}", opened[0]
    )
    assert "other machines" not in console.file.getvalue()
    assert opened[0] in console.file.getvalue()
    monkeypatch.setenv("SSH_CONNECTION", "here")
    assert view(parse([*words, "--port", "8300"]), console, over=over) == 0
    assert len(opened) == 1 and "ssh -L 8300:localhost:8300" in console.file.getvalue()


def test_view_command_supports_all_page_options(tmp_path, monkeypatch):
    chosen = []
    monkeypatch.setattr("physxnet_jax.cli._view.Viewer", lambda c, **_: chosen.append(c) or 1 / 0)
    words = ["view", "punch", "--shape", "weight_up=0.5", "--wind", "0", "1", "4"]
    words += ["--fabric", "silk", "--accuracy", "draft", "--self-contact", "--no-collisions"]
    words += ["--live"]
    with pytest.raises(ZeroDivisionError):
        view(parse(words), Console(file=io.StringIO()))
    assert chosen == [
        Choice(
            motion="punch",
            shape=(("weight_up", 0.5),),
            simulation=Simulation(accuracy="draft", wind=(0.0, 1.0, 4.0), self_contact=True),
            fabric="silk",
            inference=Inference(collisions=False),
            live=True,
        )
    ]
    assert main(["view", "--live", "--html", str(tmp_path / "a.html")]) == 2
    assert main(["view", "--live", "--method", "lbs"]) == 2
    assert main(["view", "--compare", "--method", "simulate"]) == 2
    assert main(["view", "--html", "/proc/a.html"]) == 2
    assert main(["view", "--shape", "weight_up"]) == 2
    assert main(["view", "--shape", "girth=1", "--html", str(tmp_path / "a.html")]) == 2
    assert main(["view", "--fabric", "tin", "--html", str(tmp_path / "a.html")]) == 2
    hero = str(tmp_path / "hero.vrm")
    assert main(["view", "--character", hero, "--shape", "gender=1"]) == 2
    assert main(["view", "--character", hero, "--html", str(tmp_path / "a.html")]) == 2


@pytest.fixture
def page(viewer, tmp_path):
    it = _BROWSER["Page"](viewer.url, tmp_path / "profile")
    yield it
    it.close()


@pytest.mark.release
@pytest.mark.browser
@pytest.mark.skipif(_BROWSER["BROWSER"] is None, reason="no Chromium installed")
def test_garment_selected_in_a_browser_appears(viewer, page, tmp_path):
    viewer.wait()
    viewer.controls.playing.value = False
    page.until("document.body.innerText.includes('bottom')")
    page.until("document.querySelector('canvas') !== null")

    def picture(enough):
        end = time.monotonic() + 90
        while True:
            time.sleep(2)
            seen = page.picture()[:, :500]
            if enough(seen) or time.monotonic() > end:
                return seen

    def changed(one, other):
        return float((np.abs(one - other).max(axis=2) > 40).mean())

    # Not one colour: a body, trousers and a floor are there.
    picture(lambda seen: seen.std() > 10)
    before = picture(lambda seen: changed(seen, page.picture()[:, :500]) < 1e-4)
    assert before.std() > 10
    box = (
        "[...document.querySelectorAll('input[type=checkbox]')].find(b => {let p = b; for (let k ="
        " 0; k < 6 && p; k++) {p = p.parentElement; if (p && p.innerText.trim() == 'dress') return"
        " true} return false})"
    )
    page.until(f"({box}) !== undefined")
    page.run(f"({box}).click()")
    end = time.monotonic() + 60
    while "dress" not in viewer.chosen().wear and time.monotonic() < end:
        time.sleep(0.2)
    shown = viewer.wait()
    assert [m.name for m in shown.garments] == ["bottom", "dress"]
    after = picture(lambda seen: changed(seen, before) > 3e-3)
    assert changed(after, before) > 3e-3, "the picture of the person has changed"
    viewer.controls.worn["dress"].value = False
    viewer.wait()
