"""Every command refuses an output that is one of its inputs."""

import os
import shutil

import numpy as np
import pytest
from PIL import Image

from physxnet_jax.cli import main
from physxnet_jax.dressing import load_scene
from physxnet_jax.errors import FormatError
from physxnet_jax.files import check_replaceable, keep_inputs
from physxnet_jax.garment import template
from physxnet_jax.io import write_obj
from physxnet_jax.motion import procedural_clip, save_motion


@pytest.fixture
def inputs(tmp_path):
    """A motion, a garment, a scene that names both, a person as a skinned mesh, and links."""
    save_motion(tmp_path / "walk.npz", procedural_clip("walk", fps=30.0))
    mesh = template("bottom").mesh
    write_obj(tmp_path / "pants.obj", np.asarray(mesh.vertices), np.asarray(mesh.faces))
    (tmp_path / "scene.toml").write_text(
        'motion = "walk.npz"\n[[garments]]\nfile = "pants.obj:fabric=wool"\n'
    )
    (tmp_path / "person.glb").write_bytes(b"glTF")
    (tmp_path / "link.npz").symlink_to(tmp_path / "walk.npz")
    os.link(tmp_path / "walk.npz", tmp_path / "hard.npz")
    return tmp_path


@pytest.mark.release
@pytest.mark.parametrize(
    "words",
    [
        "dress walk.npz -o walk.npz",
        "dress walk.npz --wear bottom -o link.npz",
        "dress link.npz --wear bottom -o walk.npz",
        "dress walk.npz --wear bottom -o hard.npz",
        "dress walk.npz --wear bottom -o sub/../walk.npz",
        "dress walk --character person.glb -o person.glb",
        "dress walk --made-on person.glb -o person.glb",
        "dress walk --wear person.glb#top:fabric=wool -o person.glb",
        "dress walk --wear bottom:made_on=person.glb -o person.glb",
        "simulate walk.npz --wear bottom -o walk.npz",
        "simulate scene.toml -o walk.npz",
        "effects walk --wear pants.obj --write-scene pants.obj",
        "fit pants.obj -o pants.obj",
    ],
)
def test_inputs_are_refused_as_outputs(inputs, words, monkeypatch, capsys):
    monkeypatch.chdir(inputs)
    (inputs / "sub").mkdir()
    before = {p.name: p.read_bytes() for p in inputs.iterdir() if p.is_file()}
    code = main(words.split())
    assert code == 2
    said = " ".join(capsys.readouterr().err.split())
    assert "this is an input" in said or "overwrite its source" in said, said
    assert {p.name: p.read_bytes() for p in inputs.iterdir() if p.is_file()} == before


def files_of(folder):
    return {p.name: p.read_bytes() for p in folder.iterdir() if p.is_file()}


@pytest.fixture
def textured(tmp_path, monkeypatch):
    """A garment with materials and an image, as files that the garment alone names."""
    monkeypatch.chdir(tmp_path)
    mesh = template("bottom").mesh
    image = Image.new("RGB", (4, 4), (200, 30, 30))
    image.save("coat.png")
    (tmp_path / "coat.mtl").write_text("newmtl a\nmap_Kd coat.png\n")
    write_obj("plain.obj", np.asarray(mesh.vertices), np.asarray(mesh.faces))
    text = (tmp_path / "plain.obj").read_text()
    uv = "vt 0 0\nvt 1 0\nvt 0 1\nusemtl a\n"
    faces = [f"f {a}/1 {b}/2 {c}/3" for a, b, c in np.asarray(mesh.faces) + 1]
    points = "\n".join(line for line in text.splitlines() if line.startswith("v "))
    (tmp_path / "coat.obj").write_text(f"mtllib coat.mtl\n{points}\n{uv}" + "\n".join(faces) + "\n")
    return tmp_path


@pytest.mark.release
@pytest.mark.parametrize(
    ("words", "says"),
    [
        # Files that other files name.
        ("dress walk --wear coat.obj --preview coat.png", "this is an input"),
        # Frames that a longer clip left: one is the garment, one is read-only.
        ("dress walk --wear bottom run_bottom_0002.obj -o run.obj", "this is an input"),
        ("dress walk --wear bottom -o kept.obj", "read-only"),
        ("dress person.pc2 --animated-body --wear top -o person.mdd", "this is an input"),
    ],
)
def test_files_that_no_word_names_stay(textured, words, says, capsys):
    for name in ("run_bottom_0002.obj", "kept_bottom_0002.obj"):
        shutil.copy("plain.obj", name)
    os.chmod("kept_bottom_0002.obj", 0o444)
    if words.startswith("dress person"):
        write = ["dress", "walk", "--wear", "top", "--method", "lbs", "--frames", "3"]
        assert main([*write, "-o", "me.pc2", "--quiet"]) == 0
        os.replace("me_body.pc2", "person.pc2")
        os.replace("me_body.obj", "person.obj")
        os.link("person.obj", "person_body.obj")
    before = files_of(textured)
    code = main([*words.split(), "--method", "lbs", "--frames", "2", "--quiet"])
    said = " ".join(capsys.readouterr().err.split())
    assert code == 2 and says in said, said
    assert before.items() <= files_of(textured).items()


def test_what_scenes_name_stays_in_commands_alone(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    save_motion(tmp_path / "walk.npz", procedural_clip("walk", fps=30.0))
    mesh = template("bottom").mesh
    write_obj("pants.obj", np.asarray(mesh.vertices), np.asarray(mesh.faces))
    (tmp_path / "cloth.toml").write_text("density = 0.3\n")
    (tmp_path / "sub").mkdir()
    (tmp_path / "scene.toml").write_text(
        'motion = "walk.npz"\nframes = 2\ngarments = ["bottom:fabric=cloth.toml"]\n'
    )
    monkeypatch.chdir(tmp_path / "sub")
    # Of the scene's folder, not of the one where the command runs.
    assert load_scene("../scene.toml").scene.garments[0].fabric.density == pytest.approx(0.3)
    with keep_inputs():
        load_scene("../scene.toml")
        for name in ("walk.npz", "cloth.toml", "scene.toml"):
            with pytest.raises(FormatError, match="this is an input"):
                check_replaceable(tmp_path / name)
    # A program may write what it has read.
    load_scene("../scene.toml")
    check_replaceable(tmp_path / "walk.npz")
