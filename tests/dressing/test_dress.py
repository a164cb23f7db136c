"""Dressing: methods agree where they must, and nothing inside the body is left."""

import dataclasses

import numpy as np
import pytest

from physxnet_jax.dressing import Inference, Simulation, dress, infer_block, run_simulation
from physxnet_jax.errors import PhysXNetError
from physxnet_jax.evaluation import PEER_CASES, network, surface_faults
from physxnet_jax.garment import refine_garment, template
from physxnet_jax.models import load_predictor
from physxnet_jax.motion import animate, load_motion
from physxnet_jax.simulation import Scene, prepare_scene


@pytest.mark.release
def test_lbs_is_linear_blend_skinning(body, rest):
    motion = load_motion("punch", fps=30.0)
    clip = dress("punch", ["top"], method="lbs", frames=18, inference=Inference(collisions=False))
    g = template("top")
    expected = animate(body, rest, g.rest_vertices(rest), g.skin, motion)
    np.testing.assert_allclose(clip.garments[0].positions, np.asarray(expected)[:18], atol=1e-5)
    assert clip.hit_rate["top"] is None and clip.num_frames == 18


@pytest.mark.nightly
def test_network_cloth_differs_from_skinning_and_stays_near_the_body():
    # Weights that learned these fitted garments.
    fitted = Inference(weights="paper")
    a = dress("walk", ["bottom", "dress"], method="network", inference=fitted, frames=20)
    b = dress("walk", ["bottom", "dress"], method="lbs", frames=20)
    for x, y in zip(a.garments, b.garments):
        gap = np.linalg.norm(x.positions - y.positions, axis=2)
        assert np.isfinite(gap).all() and 1e-3 < gap.mean() < 0.1 and gap.max() < 0.5
    assert a.hit_rate["bottom"] > 0.95 and a.fallbacks["bottom"] is not None
    assert all(v < 0.02 for v in a.inside.values())
    # A hem swings with the steps; leaps of centimetres between frames told of jerked hips.
    hem = np.argsort(a.garments[1].positions[0, :, 1])[:40]
    hips = np.asarray(load_motion("walk", fps=30.0).root)[:20, 1]
    height = a.garments[1].positions[:, hem, 1].mean(axis=1) - hips
    assert np.abs(np.diff(height)).max() < 0.025 and np.ptp(height) > 0.02
    assert {s.name for s in a.stages} >= {"motion", "binding", "network", "body"}


@pytest.mark.release
def test_clips_of_other_lengths_are_not_recompiled():
    dress("walk", ["bottom"], method="lbs", frames=3)
    programs = infer_block._cache_size()
    dress("punch", ["bottom"], method="lbs", frames=40)
    assert infer_block._cache_size() == programs
    dress("walk", ["bottom"], method="lbs", frames=3, inference=Inference(collisions=False))
    assert infer_block._cache_size() == programs + 1, "another program is one more"


@pytest.mark.nightly
def test_refined_garments_return_on_their_own_vertices_without_skin_through_them():
    """A tube with edges of 10 cm; the control doesn't keep its own triangles off the skin."""
    case = PEER_CASES["edges_of_ten_centimetres"]
    (tunic,), motion = case.garments(), case.motion()
    finer = refine_garment(tunic, 0.03)
    looked = np.asarray([0, 20, 39])
    shares = []
    for worn in (tunic, dataclasses.replace(finer, coarse_faces=None)):
        simulation = Simulation(refine=0.03 if worn is tunic else None)
        out = run_simulation(Scene((worn,)), motion, simulation)
        x = out.positions[0]
        assert x.shape == (40, worn.num_vertices, 3)
        own = prepare_scene(Scene((tunic,))).assembly
        faults = surface_faults(own, motion, x[:, : tunic.num_vertices], frames=looked)
        shares.append(faults.visible_skin)
    assert shares[0] < 2e-3 < 5e-3 < shares[1], shares


@pytest.mark.release
def test_simulated_cloth_is_finite_and_pinned_at_the_waist():
    # One garment needn't be a list.
    clip = dress("balance", template("bottom"), method="simulate", frames=4)
    assert np.isfinite(clip.garments[0].positions).all()
    waist = np.asarray(template("bottom").pinned)
    lbs = dress(
        "balance", ["bottom"], method="lbs", frames=4, inference=Inference(collisions=False)
    )
    gap = clip.garments[0].positions[:, waist] - lbs.garments[0].positions[:, waist]
    assert np.abs(gap).max() < 1e-4


@pytest.mark.nightly
def test_trousers_change_only_where_a_top_covers_them():
    both = dress("walk", ["top", "bottom"], method="network", frames=16)
    alone = dress("walk", ["bottom"], method="network", frames=16)
    rest_height = np.asarray(template("bottom").mesh.vertices)[:, 1]
    covered = rest_height > float(np.asarray(template("top").mesh.vertices)[:, 1].min())
    a, b = both.garments[1].positions, alone.garments[0].positions
    gap = np.linalg.norm(a - b, axis=2)
    assert gap[:, covered].max() > 2e-3
    assert gap[:, rest_height < -0.4].max() < 1e-4


@pytest.mark.nightly
def test_duplicate_garment_names_are_made_unique(tmp_path):
    named = dataclasses.replace(template("bottom"), name="body")
    clip = dress("walk", [named, "bottom", "bottom"], method="lbs", frames=2)
    assert [m.name for m in clip.meshes] == ["body", "body_2", "bottom", "bottom_2"]


def test_empty_outfits_and_zero_frames_are_refused():
    with pytest.raises(PhysXNetError, match="at least one garment"):
        dress("walk", [], method="lbs", frames=2)
    with pytest.raises(PhysXNetError, match="at least one"):
        dress("walk", method="lbs", frames=0)


@pytest.mark.sampled(1)
@pytest.mark.release
@pytest.mark.parametrize("push", [False, True])
def test_evaluation_matches_dress(push):
    predictor = load_predictor()
    inference = Inference(weights=predictor, collisions=push)
    method = network(inference)
    motion = load_motion("punch", fps=30.0)
    short = dataclasses.replace(motion, rotations=motion.rotations[:20], root=motion.root[:20])
    clip = dress(short, ["top"], method="network", include_body=False, inference=inference)
    measured = method(short, "top").positions
    # Before the first frame somebody who is measured stood still, as in the simulation.
    lead = predictor.config.inputs.window - 1
    np.testing.assert_allclose(measured[lead:], clip.garments[0].positions[lead:], atol=2e-5)
    assert np.abs(measured[:lead] - clip.garments[0].positions[:lead]).max() < 0.05


@pytest.mark.sampled(1)
@pytest.mark.release
@pytest.mark.parametrize("start", [0.1, 1.0])
def test_partial_motion_matches_the_whole_motion(start):
    """What was before its first frame is the motion's own, not made up."""
    first = round(30 * start)
    bare = {"method": "network", "inference": Inference(collisions=False)}
    (whole,) = dress("punch", ["top"], frames=first + 4, **bare).garments
    (part,) = dress("punch", ["top"], start=start, frames=4, **bare).garments
    np.testing.assert_allclose(part.positions, whole.positions[first:], atol=1e-5)
    # The control: the same frames as a motion of their own.
    clip = load_motion("punch", fps=30.0)
    alone = dataclasses.replace(clip, rotations=clip.rotations[first:], root=clip.root[first:])
    (other,) = dress(alone, ["top"], frames=4, **bare).garments
    assert np.abs(other.positions - whole.positions[first:]).max() > 1e-3
