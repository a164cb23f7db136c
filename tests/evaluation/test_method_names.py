"""Methods by name: what the words behind a network's name do."""

from types import SimpleNamespace

import numpy as np
import pytest

from physxnet_jax.body import load_body
from physxnet_jax.data import mirrored_offsets
from physxnet_jax.dressing import EXTERNAL_ENGINES, Inference, dress
from physxnet_jax.errors import MissingDependencyError, PhysXNetError, WeightsError
from physxnet_jax.evaluation import (
    MethodProfile,
    edge_strain,
    method_by_name,
    method_name,
    parse_method,
)
from physxnet_jax.garment import template
from physxnet_jax.motion import Motion, load_motion, mirrored
from physxnet_jax.simulation import Scene, prepare_scene


@pytest.mark.nightly
def test_mirror_suffix_makes_predictions_mirror_symmetric():
    walk = load_motion("punch", fps=30.0)
    walk = Motion(walk.rotations[40:48], walk.root[40:48], walk.fps, walk.name)
    twin = mirrored(load_body(), walk)
    skinned = [method_by_name("lbs")(m, "top").positions for m in (walk, twin)]
    away = {}
    for name in ("paper", "paper+mirror", "nano", "nano+mirror"):
        method = method_by_name(name)
        one, two = (method(m, "top").positions - s for m, s in zip((walk, twin), skinned))
        away[name] = np.linalg.norm(one - mirrored_offsets(template("top"), two), axis=-1).mean()
    # What is left is sampling: the meshes of both halves aren't the same, and finer maps hold more
    # that differs from texel to texel.
    assert away["paper+mirror"] < 0.3e-3 < 2e-3 < away["paper"]
    assert away["nano+mirror"] < 1e-3 < 5e-3 < away["nano"]


def test_external_engines_are_methods_like_any_other(monkeypatch):
    """A stand-in: the template skinned, the first frame slow to come."""
    asked = []

    def stand_in(scene, motion):
        (garment,) = scene.garments
        asked.append((garment.name, motion.num_frames))
        cloth = method_by_name("lbs")(motion, garment.name).positions
        return SimpleNamespace(
            positions=(cloth,), diagnostics={"milliseconds": np.array([900.0, 5.0, 7.0])}
        )

    monkeypatch.setitem(EXTERNAL_ENGINES, "blender", stand_in)
    walk = load_motion("walk", fps=30.0)
    walk = Motion(walk.rotations[:3], walk.root[:3], walk.fps, walk.name)
    answer = method_by_name("blender")(walk, "bottom")
    assert asked == [("bottom", 3)] and answer.ms_per_frame == 6.0
    np.testing.assert_array_equal(answer.positions, method_by_name("lbs")(walk, "bottom").positions)
    monkeypatch.undo()
    monkeypatch.setenv("PHYSXNET_BLENDER", "/nowhere/blender")
    with pytest.raises(MissingDependencyError, match="PHYSXNET_BLENDER"):
        method_by_name("blender")(walk, "bottom")


@pytest.mark.nightly
@pytest.mark.parametrize("name", ["top", "dress"])
def test_strain_limiting_suffix_reduces_strain_with_small_displacements(name):
    punch = load_motion("punch", fps=30.0)
    punch = Motion(punch.rotations[40:48], punch.root[40:48], punch.fps, punch.name)
    assembly = prepare_scene(Scene((template(name),))).assembly
    answers = {n: method_by_name(n)(punch, name).positions for n in ("nano", "nano+relax")}
    before, after = (np.abs(edge_strain(assembly, answers[n])) for n in ("nano", "nano+relax"))
    # What is far from its length, the more so.
    for share, most in ((0.5, 0.7), (0.9, 0.6), (0.99, 0.6)):
        assert np.quantile(after, share) < most * np.quantile(before, share)
    # A network that learned a garment leaves little to be moved.
    known = {"top": "shirt", "dress": "aline"}[name]
    one, two = (
        dress(punch, known, method="network", inference=parse_method(n), include_body=False)
        for n in ("small", "small+relax")
    )
    moved = np.linalg.norm(one.meshes[0].positions - two.meshes[0].positions, axis=2)
    assert 0.5e-3 < moved.mean() < 6e-3 and moved.max() < 0.06


def test_method_suffixes_round_trip_through_options():
    assert parse_method("nano") == Inference(weights="nano", strain_iterations=0, collisions=False)
    both = parse_method("nano+mirror+relax+push")
    assert both == Inference(weights="nano", tta=True)
    for name in ("nano", "nano+mirror", "nano+relax", "nano+mirror+relax+push", "base+push"):
        assert method_name(parse_method(name)) == name
    options = MethodProfile("nano+mirror+relax+push", {}, {}, {}).options
    assert options == {"method": "network", "inference": both}
    names = ("nano", "nano+mirror", "nano+relax", "nano+mirror+push")
    assert len({MethodProfile(n, {}, {}, {}).identity for n in names}) == len(names)


def test_wrong_options_are_refused():
    for count in (-1, True):
        with pytest.raises(PhysXNetError, match="strain_iterations"):
            Inference(strain_iterations=count)
    with pytest.raises(WeightsError, match="No weights 'nana"):
        method_by_name("nana+mirror")
