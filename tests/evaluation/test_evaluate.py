"""Evaluation: what is known comes out, whatever the method."""

import dataclasses

import jax.numpy as jnp
import numpy as np
import pytest

from physxnet_jax.data import Sequence
from physxnet_jax.evaluation import (
    Prediction,
    check_sequence,
    error_tables,
    evaluate,
    fold_strength,
    nearest_frame,
    pose_features,
    pose_network,
    retime,
    skinning,
    training_frames,
)
from physxnet_jax.evaluation._penetration import Penetration
from physxnet_jax.evaluation._strain import edge_strain
from physxnet_jax.garment import template
from physxnet_jax.geometry import vertex_normals
from physxnet_jax.motion import load_motion, make_motion
from physxnet_jax.simulation import Scene, prepare_scene

META = {"engine": "test", "finite": True, "worst": {"penetration_max": 0.0}}
BOTTOM = template("bottom").num_vertices


def sequence(name="walk", frames=24, offset=(0.0, 0.0, 0.0), meta=META):
    motion = load_motion("walk", fps=30.0)
    motion = dataclasses.replace(
        motion, rotations=motion.rotations[:frames], root=motion.root[:frames]
    )
    offsets = np.tile(np.float32(offset), (frames, BOTTOM, 1))
    return Sequence(name, "test", motion, {"bottom": offsets}, {"bottom": meta})


def measure(methods, sequences, done=()):
    return list(evaluate(methods, sequences, templates=("bottom",), done=done))


@pytest.mark.nightly
def test_skinning_error_equals_the_offset():
    rows = measure({"lbs": skinning()}, [sequence(), sequence("shifted", offset=(0.0, 0.01, 0.0))])
    assert [r.action for r in rows] == ["walk", "shifted"]
    assert rows[0].rmse_vertices_mm < 1e-3 and rows[0].wrinkle_deg < 0.05
    assert rows[1].rmse_vertices_mm == pytest.approx(10.0, rel=1e-3)
    assert rows[1].mse_vertices_mm2 == pytest.approx(100.0, rel=2e-3)
    assert rows[1].rmse_texels_mm == pytest.approx(10.0, rel=1e-3)
    assert rows[1].p95_mm == pytest.approx(10.0, rel=1e-3)
    # A constant offset leaves folds, acceleration and jerk as they are.
    assert rows[1].acceleration_error < 1e-2 and rows[1].wrinkle_deg < 0.05
    assert rows[1].jitter == pytest.approx(rows[1].jitter_reference, rel=1e-3)
    assert rows[0].ms_per_frame > 0 and rows[0].finite_share == 1.0
    table = error_tables(rows)
    assert "| shifted | 10.0 |" in table and "Reference: test" in table


@pytest.mark.release
def test_existing_rows_are_not_measured_again():
    asked = []

    def method(motion, name):
        asked.append(motion.num_frames)
        return skinning()(motion, name)

    first = measure({"mine": method}, [sequence()])
    assert len(asked) == 1
    assert measure({"mine": method}, [sequence()], done=first) == []
    again = measure({"mine": method}, [sequence(), sequence("b", frames=20)], done=first)
    assert [r.action for r in again] == ["b"] and asked == [24, 20]


@pytest.mark.release
def test_non_finite_frames_are_counted_and_excluded():
    def broken(motion, name):
        x = skinning()(motion, name).positions.copy()
        x[5] = np.nan
        return Prediction(x, 1.0)

    (row,) = measure({"broken": broken}, [sequence()])
    assert row.finite_share == pytest.approx(23 / 24)
    assert row.rmse_vertices_mm < 1e-3
    assert np.isnan(row.jitter) and np.isnan(row.acceleration_error), "not across the gap"
    lost = measure(
        {"nothing": lambda m, n: Prediction(broken(m, n).positions * np.nan, 1.0)}, [sequence()]
    )
    assert lost[0].finite_share == 0.0 and np.isnan(lost[0].rmse_vertices_mm)


@pytest.mark.release
def test_clips_too_short_for_jerk_are_tabulated():
    rows = measure({"lbs": skinning()}, [sequence(frames=3)])
    assert rows[0].jitter_reference == 0.0
    assert "| lbs | bottom | 0.0 |" in error_tables(rows)


def test_detached_cloth_is_not_a_reference():
    off = {**META, "worst": {"penetration_max": 0.2}}
    assert measure({"lbs": skinning()}, [sequence(meta=off)]) == []


def bent(seed=0, frames=40):
    """Offsets that the pose alone decides."""
    s = sequence(frames=frames)
    body_turn = np.asarray(s.motion.rotations)[:, 3:6, 1:].sum(axis=(1, 2))
    offsets = np.zeros((frames, BOTTOM, 3), np.float32)
    offsets[:, :, 1] = 0.02 * ((body_turn - body_turn.mean()) / body_turn.std())[:, None]
    return dataclasses.replace(s, offsets={"bottom": offsets})


@pytest.mark.release
def test_nearest_frame_reproduces_training_frames():
    known = bent()
    frames = training_frames([known], ("bottom",))
    (row,) = measure({"nearest": nearest_frame(frames)}, [known])
    assert row.rmse_vertices_mm < 0.2, "quantised twice"
    assert np.abs(known.offsets["bottom"]).max() > 0.02


@pytest.mark.nightly
def test_pose_network_learns_pose_dependent_offsets():
    known = bent()
    frames = training_frames([known], ("bottom",))
    rows = measure({"mlp": pose_network(frames, steps=300), "lbs": skinning()}, [known])
    assert rows[0].rmse_vertices_mm < 0.3 * rows[1].rmse_vertices_mm


def test_pose_features_are_invariant_to_position_and_heading(body, rest):
    from scipy.spatial.transform import Rotation

    from physxnet_jax.motion import clip_transforms

    m = load_motion("punch", fps=30.0)
    turn = Rotation.from_euler("Y", 2.0)
    q = np.asarray(m.rotations).copy()
    q[:, 0] = (turn * Rotation.from_quat(q[:, 0], scalar_first=True)).as_quat(scalar_first=True)
    other = make_motion(q, np.asarray(m.root) + 3.0, 30.0)
    a, b = (
        np.asarray(pose_features(jnp.asarray(clip_transforms(body, rest, x)[0]), body.parents))
        for x in (m, other)
    )
    np.testing.assert_allclose(a, b, atol=1e-5)
    assert np.abs(a[0] - a[20]).max() > 0.05


@pytest.mark.release
def test_check_detects_explosions_wrong_counts_and_stretched_cloth():
    fine = check_sequence(sequence(), 24)
    assert all(f.holds for f in fine if "inside" not in f.quantity), "skinning is calm cloth"
    far = sequence(offset=(0.0, 0.9, 0.0))
    wrong = {f.quantity for f in check_sequence(far, 25) if not f.holds}
    assert {"frames missing", "slid along the body, m"} <= wrong
    short = sequence()
    short.offsets["bottom"] = short.offsets["bottom"][:-2]
    wrong = {f.quantity for f in check_sequence(short) if not f.holds}
    assert wrong == {"frame count difference to motion"}
    still = sequence(frames=8)
    pose = make_motion(*(np.tile(x[:1], (8, *[1] * (x.ndim - 1))) for x in (
        np.asarray(still.motion.rotations), np.asarray(still.motion.root))), 30.0)  # fmt: skip
    still = dataclasses.replace(still, motion=pose)
    still.offsets["bottom"] += 1e-6 * np.sin(np.arange(8.0, dtype=np.float32))[:, None, None]
    assert all(f.holds for f in check_sequence(still) if "inside" not in f.quantity)
    torn = sequence()
    torn.offsets["bottom"][:, ::2] += 0.05
    torn.offsets["bottom"][::2, 1::2] -= 0.05
    wrong = {f.quantity for f in check_sequence(torn) if not f.holds}
    assert {"strain, 99 %", "jerk relative to skinning"} <= wrong


@pytest.mark.release
def test_strain_and_fold_strength_are_compared_with_the_reference():
    rough = sequence(frames=6)
    rough.offsets["bottom"] += np.random.default_rng(0).normal(0, 2e-3, (6, BOTTOM, 3)).astype("f4")
    (row,) = measure({"lbs": skinning()}, [rough])
    assembly = prepare_scene(Scene((template("bottom"),))).assembly
    x = skinning()(rough.motion, "bottom").positions
    y = x + rough.offsets["bottom"]
    plain, wanted = (np.quantile(np.abs(edge_strain(assembly, p)), 0.99) for p in (x, y))
    assert row.strain_p99 == pytest.approx(plain, rel=1e-3)
    assert row.strain_p99_reference == pytest.approx(wanted, rel=1e-3) and wanted > 2 * plain
    folds = [fold_strength(np.asarray(assembly.faces), p) for p in (x, y)]
    assert (
        row.fold_strength == pytest.approx(folds[0] / folds[1], rel=1e-3) and row.fold_strength < 1
    )


@pytest.mark.release
def test_pinched_cloth_is_counted_separately(monkeypatch):
    def seen(assembly, motion, positions, *, frames, bare_skin):
        inside = np.zeros((len(frames), BOTTOM), bool)
        pinched, depth = inside.copy(), np.zeros(inside.shape)
        inside[:, :200], pinched[:, :150] = True, True
        depth[:, :150], depth[:, 150:200] = 0.03, 0.002
        return Penetration(inside, depth, pinched, np.full(len(frames), np.nan))

    monkeypatch.setattr("physxnet_jax.evaluation._evaluate.penetration", seen)
    (row,) = measure({"lbs": skinning()}, [sequence(frames=6)])
    assert row.penetration_share == pytest.approx(50 / BOTTOM)
    assert row.pinched_share == pytest.approx(150 / BOTTOM)
    assert row.penetration_mm == pytest.approx(2.0)


@pytest.mark.release
def test_retime_measures_only_times():
    one = sequence(frames=6)
    rows = measure({"lbs": skinning(), "other": skinning()}, [one])
    slow = lambda motion, name: Prediction(skinning()(motion, name).positions + 1.0, 77.0)  # noqa: E731
    again = list(retime({"lbs": slow}, [one], rows, templates=("bottom",)))
    assert again == [dataclasses.replace(rows[0], ms_per_frame=77.0), rows[1]]


@pytest.mark.release
def test_check_detects_cloth_inside_the_body():
    sunk = sequence(frames=3)
    skinned = jnp.asarray(skinning()(sunk.motion, "bottom").positions)
    sunk.offsets["bottom"] -= 0.02 * np.asarray(
        vertex_normals(skinned, template("bottom").mesh.faces)
    )
    found = {f.quantity: f for f in check_sequence(sunk)}
    assert found["inside the body, share"].measured > 0.3
    assert not found["inside the body, share"].holds
