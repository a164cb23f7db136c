"""The web viewer: what is chosen is what is computed, and a browser shows it."""

import dataclasses
import io
import pathlib
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
from physxnet_jax.errors import FormatError, PhysXNetError
from physxnet_jax.garment import template
from physxnet_jax.io import DEFAULT, MIRROR, RELAX, read_obj, split_ways, write_obj
from physxnet_jax.motion import procedural_clip, save_motion

pytest.importorskip("viser")

from physxnet_jax.viewer import Choice, Viewer, carry_out, record

_BROWSER = runpy.run_path(str(pathlib.Path(__file__).parents[1] / "browser.py"))
SHORT = Choice("walk", ("bottom",), method="lbs", frames=10, fps=10.0)


@pytest.fixture(scope="module")
def viewer():
    it = Viewer(SHORT, port=8123)
    it.wait()
    yield it
    it.close()


def test_what_is_chosen_is_what_is_shown(viewer):
    assert viewer.shown.choice == SHORT and viewer.shown.num_frames == 10
    viewer._widgets["motion"].value = "balance"
    viewer._worn["top"].value = True
    viewer._shapes["weight_up"].value = 0.5
    shown = viewer.wait()
    assert shown.choice.motion == "balance" and shown.choice.wear == ("bottom", "top")
    assert shown.choice.shape == (("weight_up", 0.5),)
    assert [m.name for m in shown.garments] == ["bottom", "top"]
    slim = carry_out(Choice("balance", ("bottom",), method="lbs", frames=2, fps=10.0))
    assert np.ptp(shown.garments[0].positions[0][:, 0]) > np.ptp(
        slim.garments[0].positions[0][:, 0]
    )
    viewer._shapes["weight_up"].value = 0.0
    viewer._worn["top"].value = False
    viewer._widgets["motion"].value = "walk"
    assert viewer.wait().choice == SHORT


def test_what_is_ticked_is_waited_for_before_anybody_asked(viewer, monkeypatch):
    """Between a tick and the answer to it lies a moment: what was shown then is stale."""
    viewer.wait()
    late = threading.Timer(1.0, Viewer.ask, (viewer,))
    monkeypatch.setattr(viewer, "ask", late.start)
    viewer._worn["top"].value = True
    assert [m.name for m in viewer.wait().garments] == ["bottom", "top"]
    monkeypatch.undo()
    viewer._worn["top"].value = False
    assert viewer.wait().choice == SHORT


def test_a_clip_without_clothes_is_a_body(viewer):
    viewer._worn["bottom"].value = False
    assert viewer.wait().garments == ()
    viewer._worn["bottom"].value = True
    assert len(viewer.wait().garments) == 1


def test_an_error_is_told_and_passes(viewer, tmp_path):
    viewer.add_file("../../broken.bvh", b"HELLO")
    with pytest.raises(PhysXNetError, match="HIERARCHY"):
        viewer.wait()
    assert "HIERARCHY" in viewer._status.content and ".." not in str(viewer._files["broken.bvh"])
    viewer._widgets["motion"].value = "walk"
    assert viewer.wait().choice == SHORT
    with pytest.raises(FormatError, match="not a motion"):
        viewer.add_file("a.exe", b"MZ")


def test_garments_are_put_on_in_the_order_in_which_they_were_named(tmp_path, monkeypatch):
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
    monkeypatch.setattr("physxnet_jax.viewer._web.carry_out", nothing)
    it = Viewer(dataclasses.replace(SHORT, wear=named), port=8131)
    try:
        assert it.chosen().wear == named and len(it._worn) == 5
        it._worn["dress"].value = True
        assert it.chosen().wear == (*named, "dress")
        it._worn["top"].value = False
        assert it.chosen().wear == (there[1], there[0], "dress")
    finally:
        it.close()


def test_what_a_file_says_is_text_on_the_page(viewer):
    viewer.add_file("a.bvh", b"<iframe srcdoc='x'>*b*")
    with pytest.raises(PhysXNetError):
        viewer.wait()
    assert "<iframe" not in viewer._status.content and "&lt;iframe" in viewer._status.content
    assert "\\*b\\*" in viewer._status.content
    viewer._widgets["motion"].value = "walk"
    viewer.wait()


def test_what_cannot_be_carried_out_is_refused_before_anything_listens():
    with pytest.raises(PhysXNetError, match="at least one"):
        Viewer(dataclasses.replace(SHORT, frames=0))
    with pytest.raises(PhysXNetError, match="No weights"):
        Viewer(dataclasses.replace(SHORT, method="network", weights="none"))


def test_on_another_shape_clothes_and_body_stand_on_one_floor(tmp_path):
    """The clip is cut before its lowest point: clothes and body are lowered alike."""
    still = procedural_clip("balance", fps=30.0)
    root = np.asarray(still.root).copy()
    root[:4, 1] += 0.2
    save_motion(tmp_path / "hop.npz", dataclasses.replace(still, root=jnp.asarray(root)))
    path = str(tmp_path / "hop.npz")
    choice = Choice(path, ("bottom",), method="lbs", frames=4, shape=(("height_up", 0.8),))
    shown = carry_out(choice)
    body, trousers = (m.positions for m in shown.meshes())
    assert abs(body[..., 1].min()) < 0.01
    # The hem hangs at the ankles, not a hop above or below them.
    assert 0.0 < trousers[..., 1].min() - body[..., 1].min() < 0.15


def test_what_is_taken_away_is_what_is_shown(viewer, tmp_path):
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
    viewer._worn["mine.glb"].value = False
    viewer.wait()


def test_the_skinned_body_on_the_page_is_the_body(viewer, body):
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


def test_beside_the_simulation_distances_are_told():
    shown = carry_out(Choice("balance", ("bottom",), method="lbs", frames=3, compare=True))
    d = shown.distances["bottom"]
    gap = shown.garments[0].positions - shown.reference[0].positions
    np.testing.assert_allclose(d, np.linalg.norm(gap, axis=2))
    assert 0 < d.mean() < 0.05 and "mm RMSE from the simulation" in shown.told


def test_maps_show_the_motion():
    shown = carry_out(Choice("punch", ("top",), weights="nano", frames=20))
    maps = shown.maps(10, ("top",))
    assert {"velocity", "acceleration", "top"} == set(maps)
    still = carry_out(Choice("balance", (), weights="nano", frames=1)).maps(0, ("top",))
    grey = [np.abs(m["velocity"].astype(int) - 127).max() for m in (maps, still)]
    covered = (still["velocity"] != 255).any(axis=2)
    assert grey[0] > 100 and np.abs(still["velocity"][covered].astype(int) - 127).max() <= 1
    assert maps["top"].shape == (64, 64, 3)


def test_live_clothes_are_those_of_the_clip_wherever_it_is_entered(viewer):
    choice = Choice("walk", ("bottom",), weights="nano", frames=12, live=True)
    shown = carry_out(choice)
    assert shown.live is not None and np.isnan(shown.live.milliseconds)
    clip = shown.garments[0].positions
    for frame in (0, 1, 2, 9, 10, 4, 4):
        live = shown.live.frame(frame)["bottom"]
        assert np.abs(live - clip[frame]).max() < 1e-5, frame
    assert np.abs(live - clip[9]).max() > 0.01, "the clip moves"
    assert 0 < shown.live.milliseconds < np.inf
    # What only the network can answer isn't asked of skinning.
    assert carry_out(dataclasses.replace(SHORT, live=True)).live is None


def test_ticks_are_words_behind_the_networks_name(viewer):
    w = viewer._widgets
    assert viewer.chosen().weights == SHORT.weights == DEFAULT
    w[MIRROR].value, w[RELAX].value = True, False
    assert viewer.chosen().weights == f"{split_ways(DEFAULT)[0]}{MIRROR}"
    w[MIRROR].value, w[RELAX].value = False, True
    assert viewer.wait().choice == SHORT


def test_live_clothes_are_what_the_page_shows_with_their_time(viewer):
    viewer._playing.value = False
    viewer._widgets["weights"].value, viewer._widgets["method"].value = "nano", "network"
    viewer._widgets["live"].value = True
    shown = viewer.wait()
    assert shown.choice.live and viewer._pace.visible
    asked = []
    frame = shown.live.frame
    shown.live.frame = lambda index: asked.append(index) or frame(index)
    for index in (9, 5, 0):
        viewer._frame.value = index
    assert asked == [9, 5, 0] and "ms a frame, live" in viewer._pace.content
    assert "nan" not in viewer._pace.content
    viewer._widgets["live"].value = False
    viewer._widgets["method"].value = "lbs"
    viewer._widgets["weights"].value = split_ways(SHORT.weights)[0]
    assert viewer.wait().choice == SHORT and not viewer._pace.visible
    viewer._playing.value = True


def test_a_page_is_written_whole(tmp_path):
    path = tmp_path / "walk.html"
    record(path, SHORT)
    text = path.read_text(encoding="utf-8")
    assert "__VISER_EMBED_DATA__" in text and len(text) > 1e6
    assert [p.name for p in tmp_path.iterdir()] == ["walk.html"]


def test_the_command_serves_until_it_is_ended_and_writes_pages(tmp_path, capsys, monkeypatch):
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
    assert opened == ["http://127.0.0.1:8300"]
    assert opened[0] in console.file.getvalue()
    monkeypatch.setenv("SSH_CONNECTION", "here")
    assert view(parse([*words, "--port", "8300"]), console, over=over) == 0
    assert len(opened) == 1 and "ssh -L 8300:localhost:8300" in console.file.getvalue()


def test_the_command_chooses_all_that_the_page_does(tmp_path, monkeypatch):
    chosen = []
    monkeypatch.setattr("physxnet_jax.cli._view.Viewer", lambda c, **_: chosen.append(c) or 1 / 0)
    words = ["view", "punch", "--shape", "weight_up=0.5", "--wind", "0", "1", "4"]
    words += ["--fabric", "silk", "--accuracy", "draft", "--self-contact", "--no-push-out"]
    words += ["--live"]
    with pytest.raises(ZeroDivisionError):
        view(parse(words), Console(file=io.StringIO()))
    assert chosen == [
        Choice(
            motion="punch",
            shape=(("weight_up", 0.5),),
            wind=(0.0, 1.0, 4.0),
            fabric="silk",
            accuracy="draft",
            self_contact=True,
            push_out=False,
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


@pytest.fixture
def page(viewer, tmp_path):
    it = _BROWSER["Page"](viewer.url, tmp_path / "profile")
    yield it
    it.close()


@pytest.mark.browser
@pytest.mark.skipif(_BROWSER["BROWSER"] is None, reason="no Chromium installed")
def test_a_garment_ticked_in_a_browser_appears(viewer, page, tmp_path):
    viewer.wait()
    viewer._playing.value = False
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
    viewer._worn["dress"].value = False
    viewer.wait()
