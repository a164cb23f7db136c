"""Methods by name: what the words behind a network's name do."""

from types import SimpleNamespace

import numpy as np
import pytest

from physxnet_jax.body import load_body
from physxnet_jax.data import mirrored_offsets
from physxnet_jax.dressing import Rung, method_by_name
from physxnet_jax.errors import MissingDependencyError, WeightsError
from physxnet_jax.evaluation import ENGINES, edge_strain
from physxnet_jax.garment import template
from physxnet_jax.io import load_predictor, read_card, weights_size
from physxnet_jax.models import RELAXATION, relax_cloth
from physxnet_jax.motion import Motion, load_motion, mirrored
from physxnet_jax.simulation import Scene, prepare_scene


def test_a_name_with_mirror_answers_the_mirrored_person_with_the_mirrored_cloth():
    walk = load_motion("punch", fps=30.0)
    walk = Motion(walk.rotations[40:48], walk.root[40:48], walk.fps, walk.name)
    twin = mirrored(load_body(), walk)
    skinned = [method_by_name("lbs")(m, "top").positions for m in (walk, twin)]
    away = {}
    for name in ("nano", "nano+mirror"):
        method = method_by_name(name)
        one, two = (method(m, "top").positions - s for m, s in zip((walk, twin), skinned))
        away[name] = np.linalg.norm(one - mirrored_offsets("top", two), axis=-1).mean()
    # What is left is sampling: the meshes of both halves aren't the same.
    assert away["nano+mirror"] < 0.3e-3 < 2e-3 < away["nano"]


def test_an_engine_is_asked_as_any_other_way(monkeypatch):
    """A stand-in: the template skinned, the first frame slow to come."""
    asked = []

    def stand_in(scene, motion):
        (garment,) = scene.garments
        asked.append((garment.name, motion.num_frames))
        cloth = method_by_name("lbs")(motion, garment.name).positions
        return SimpleNamespace(
            positions=(cloth,), diagnostics={"milliseconds": np.array([900.0, 5.0, 7.0])}
        )

    monkeypatch.setitem(ENGINES, "blender", stand_in)
    walk = load_motion("walk", fps=30.0)
    walk = Motion(walk.rotations[:3], walk.root[:3], walk.fps, walk.name)
    answer = method_by_name("blender")(walk, "bottom")
    assert asked == [("bottom", 3)] and answer.ms_per_frame == 6.0
    np.testing.assert_array_equal(answer.positions, method_by_name("lbs")(walk, "bottom").positions)
    monkeypatch.undo()
    monkeypatch.setenv("PHYSXNET_BLENDER", "/nowhere/blender")
    with pytest.raises(MissingDependencyError, match="PHYSXNET_BLENDER"):
        method_by_name("blender")(walk, "bottom")


@pytest.mark.parametrize("name", ["top", "dress"])
def test_a_name_with_relax_brings_edges_back_and_leaves_cloth_where_it_is(name):
    punch = load_motion("punch", fps=30.0)
    punch = Motion(punch.rotations[40:48], punch.root[40:48], punch.fps, punch.name)
    assembly = prepare_scene(Scene((template(name),))).assembly
    answers = {n: method_by_name(n)(punch, name).positions for n in ("nano", "nano+relax")}
    before, after = (np.abs(edge_strain(assembly, x)) for x in answers.values())
    # What is far from its length, the more so.
    for share, most in ((0.5, 0.7), (0.9, 0.6), (0.99, 0.6)):
        assert np.quantile(after, share) < most * np.quantile(before, share)
    moved = np.linalg.norm(np.subtract(*answers.values()), axis=2)
    assert 0.5e-3 < moved.mean() < 6e-3 and moved.max() < 0.06


def test_the_card_is_that_of_the_weights():
    for way in ("+mirror", "+relax", "+mirror+relax"):
        assert read_card(f"nano{way}") == read_card("nano")
        assert weights_size(f"nano{way}") == weights_size("nano")
    assert load_predictor("nano+mirror").mirrored and not load_predictor("nano").mirrored
    assert load_predictor("nano+relax").relaxation == RELAXATION
    both = load_predictor("nano+relax+mirror")
    assert both.mirrored and both.relaxation and not load_predictor("nano").relaxation
    options = Rung("nano+mirror+relax+push", {}, {}).options
    assert options == {"method": "network", "weights": "nano+mirror+relax", "push_out": True}
    names = ("nano", "nano+mirror", "nano+relax", "nano+mirror+push")
    assert len({Rung(n, {}, {}).identity for n in names}) == len(names)
    with pytest.raises(ValueError, match="0 steps or more"):
        relax_cloth(both, -1)
    with pytest.raises(WeightsError, match="No weights 'nana"):
        load_predictor("nana+mirror")
