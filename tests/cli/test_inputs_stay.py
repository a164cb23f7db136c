"""Every command refuses an output that is one of its inputs."""

import os

import numpy as np
import pytest

from physxnet_jax.cli import main
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
