"""Interpolation in closed form, built-in clips, checks of arrays."""

import dataclasses

import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings, strategies as st
from scipy.spatial.transform import Rotation

from physxnet_jax.body import bone_directions
from physxnet_jax.errors import MotionError
from physxnet_jax.geometry import quaternion_multiply, slerp
from physxnet_jax.motion import (
    CLIPS,
    _procedural,
    body_animation,
    clip_transforms,
    foot_heights,
    load_motion,
    make_motion,
    resample,
    save_motion,
    sudden_turns,
)


@settings(max_examples=50, deadline=None)
@given(
    st.tuples(*[st.floats(-3, 3)] * 3),
    st.tuples(*[st.floats(-3, 3)] * 3),
    st.floats(0, 1),
    st.booleans(),
)
def test_slerp_takes_the_shortest_path_at_constant_speed(a, b, t, flip):
    ra, rb = Rotation.from_rotvec(a), Rotation.from_rotvec(b)
    qa, qb = ra.as_quat(scalar_first=True), rb.as_quat(scalar_first=True)
    q = slerp(qa, -qb if flip else qb, np.array([t]))
    way = (ra.inv() * rb).as_rotvec()
    if np.linalg.norm(way) > 3.1:
        return
    expected = ra * Rotation.from_rotvec(t * way)
    gap = (expected.inv() * Rotation.from_quat(q, scalar_first=True)).magnitude()
    assert gap < 1e-3


def turning(frames, fps):
    q = Rotation.from_rotvec(np.outer(np.arange(frames) / fps, [0, 1.5, 0]))
    rotations = np.zeros((frames, 31, 4))
    rotations[..., 0] = 1
    rotations[:, 0] = q.as_quat(scalar_first=True)
    return make_motion(rotations, np.outer(np.arange(frames) / fps, [1.0, 0, 0]), fps)


@pytest.mark.parametrize("fps", [24.0, 30.0, 60.0, 240.0])
def test_uniform_rotation_resamples_exactly(fps):
    out = resample(turning(121, 120.0), fps)
    assert out.num_frames == int(fps) + 1
    expected = Rotation.from_rotvec(np.outer(np.arange(out.num_frames) / fps, [0, 1.5, 0]))
    got = Rotation.from_quat(np.asarray(out.rotations)[:, 0], scalar_first=True)
    assert (expected.inv() * got).magnitude().max() < 1e-3
    np.testing.assert_allclose(np.asarray(out.root)[-1], [1, 0, 0], atol=1e-5)


@pytest.mark.release
@pytest.mark.parametrize("name", list(CLIPS))
def test_built_in_clips_stand_on_the_floor_and_move_smoothly(name, body, rest):
    clip = load_motion(name, fps=30.0)
    assert clip.num_frames == 120
    height = foot_heights(body, clip, rest)
    assert height.min() > -1e-3
    if name == "jump":
        assert 0.25 < height.max() < 0.45
    else:
        assert height.max() < 1e-2
    vertices = np.asarray(body_animation(body, clip))
    speed = np.linalg.norm(np.diff(vertices, axis=0), axis=2) * 30
    assert 0.3 < speed.max() < 12.0


def hips(clip):
    """Greatest acceleration of the hips along the floor and up [m/s^2]."""
    root = np.asarray(clip.root, dtype=np.float64)
    a = np.diff(root, 2, axis=0) * clip.fps**2
    return np.linalg.norm(a[:, [0, 2]], axis=1).max(), np.abs(a[:, 1]).max()


@pytest.mark.parametrize("name", [n for n in CLIPS if n != "jump"])
@pytest.mark.parametrize("fps", [30.0, 60.0])
def test_hip_acceleration_is_bounded_in_built_in_clips(name, fps):
    along, up = hips(load_motion(name, fps=fps))
    assert along < 8.0 and up < 13.0


def test_hip_acceleration_exceeds_the_bound_without_smoothing(monkeypatch):
    monkeypatch.setattr(_procedural, "_SIGMA_XZ", 1e-3)
    monkeypatch.setattr(_procedural, "_SIGMA_Y", 1e-3)
    along, up = hips(load_motion("walk", fps=30.0))
    assert along > 20.0 and up > 15.0


@pytest.mark.release
@pytest.mark.parametrize("name", ["walk", "jump", "spin", "side step", "turn"])
def test_built_in_clips_are_the_same_at_every_rate(name):
    """`walk` at 240 frames a second covers the ground that it covers at 10."""
    slow = load_motion(name, fps=10.0)
    for fps in (30.0, 60.0, 90.0, 240.0):
        fast, at = load_motion(name, fps=fps), slice(None, None, round(fps / 10.0))
        path, expected = (np.asarray(x - x[:1]) for x in (fast.root[at], slow.root))
        np.testing.assert_allclose(path, expected, atol=1e-5)
        # The floor is where the lowest of the sampled frames is.
        assert abs(fast.root[0, 1] - slow.root[0, 1]) < 4e-3
        np.testing.assert_allclose(fast.rotations[at], slow.rotations, atol=1e-6)


def test_walk_always_moves_forward():
    ahead = np.diff(np.asarray(load_motion("walk", fps=30.0).root)[:, 2]) * 30.0
    assert 0.4 < ahead.min() and ahead.max() < 1.6


def test_motion_round_trips_through_npz(tmp_path):
    motion = turning(10, 30.0)
    save_motion(tmp_path / "m.npz", motion)
    again = load_motion(tmp_path / "m.npz")
    np.testing.assert_array_equal(np.asarray(again.rotations), np.asarray(motion.rotations))
    assert again.fps == 30.0 and not list(tmp_path.glob("*.part"))


def test_rates_that_need_too_many_frames_are_refused():
    slow = dataclasses.replace(turning(5, 30.0), fps=1e-8)
    with pytest.raises(MotionError, match="true rate"):
        resample(slow, 30.0)
    assert load_motion("walk", fps=0.1).num_frames == 1


@pytest.mark.parametrize(
    ("spoil", "says"),
    [
        (lambda r, p: (r[..., :3], p, 30.0), "expected"),
        (lambda r, p: (r, p, 0.0), "positive"),
        (lambda r, p: (np.where(np.arange(4) == 1, np.nan, r), p, 30.0), "frame 0, joint 0"),
        (lambda r, p: (0 * r, p, 30.0), "zero quaternion"),
        (lambda r, p: (r[:0], p[:0], 30.0), "at least one frame"),
    ],
)
def test_invalid_motion_arrays_are_refused(spoil, says):
    r = np.zeros((3, 31, 4))
    r[..., 0] = 1
    with pytest.raises(MotionError, match=says):
        make_motion(*spoil(r, np.zeros((3, 3))))


def test_sudden_limb_turns_are_reported(body):
    for name in CLIPS:
        assert sudden_turns(body, load_motion(name, fps=30)) is None, name
    walk = load_motion("walk", fps=60)
    turn = jnp.asarray([np.cos(0.75), 0.0, np.sin(0.75), 0.0], jnp.float32)  # 86 degrees
    leg = body.joint("RightUpLeg")
    q = walk.rotations.at[20, leg].set(quaternion_multiply(walk.rotations[20, leg], turn))
    told = sudden_turns(body, dataclasses.replace(walk, rotations=q))
    assert told is not None and "RightUpLeg turns by 8" in told and "another frame" in told
    assert "from frame 19 to 20" in told or "from frame 20 to 21" in told
    hand = body.joint("RightHand")
    q = walk.rotations.at[20, hand].set(quaternion_multiply(walk.rotations[20, hand], turn))
    assert sudden_turns(body, dataclasses.replace(walk, rotations=q)) is None
    # At ten frames a second a limb may turn three times as far between two.
    slow = load_motion("punch", fps=10)
    assert sudden_turns(body, slow) is None


def test_built_in_clips_start_with_straight_legs_for_other_shapes(body):
    """Built-in clips begin on straight legs, whatever way a shape's bones lean at rest."""
    shape = body.shape(gender=1.0, weight_up=1.0, height_up=0.8)
    clip = load_motion("stretch", fps=10.0, shape=shape)
    world, _ = clip_transforms(body, body.rest_vertices(shape), clip)
    ours, usual = bone_directions(body, shape), bone_directions(body)
    legs = [body.joint(s + n) for s in ("Left", "Right") for n in ("UpLeg", "Leg")]
    for j in legs:
        np.testing.assert_allclose(world[0, j] @ ours[j], [0.0, -1.0, 0.0], atol=1e-3)
    # The control: they lean another way than those of the default shape.
    assert np.abs(ours - usual)[legs].max() > 5e-3


def test_saved_motion_stands_on_the_floor_for_other_shapes(body, tmp_path):
    save_motion(tmp_path / "w.npz", load_motion("walk", fps=10))
    usual = load_motion(tmp_path / "w.npz")
    for shape in (body.shape(height_up=1.0), body.shape(height_down=1.0)):
        rest = body.rest_vertices(shape)
        assert abs(foot_heights(body, usual, rest).min()) > 0.02, "as it is it sinks, or floats"
        clip = load_motion(tmp_path / "w.npz", shape=shape)
        assert abs(foot_heights(body, clip, rest).min()) < 1e-5
        np.testing.assert_array_equal(clip.root[:, ::2], usual.root[:, ::2])


def amass(path, pose, way, *, height=0.0, steps=60):
    """Somebody in this pose who goes this way [m], so far above the plane of z = 0."""
    t = np.linspace(0.0, 1.0, steps)[:, None]
    poses = np.zeros((steps, 66))
    poses[:, :3] = pose.as_rotvec()
    np.savez(path, poses=poses, trans=way * t + [0, 0, height], mocap_framerate=60.0)
    return path


@pytest.mark.parametrize("degrees", [0.0, 90.0, 180.0, 270.0])
def test_crawling_amass_motion_stays_prone_for_any_heading(body, rest, tmp_path, degrees):
    """Z is up there: prone, with the head along the floor."""
    heading = Rotation.from_euler("z", degrees, degrees=True)
    prone = heading * Rotation.from_euler("x", 170.0, degrees=True)
    ahead = prone.apply([0.0, 1.0, 0.0])
    clip = load_motion(amass(tmp_path / "a.npz", prone, 0.5 * ahead * [1, 1, 0], height=0.2))
    world, _ = clip_transforms(body, rest, clip)
    np.testing.assert_allclose(
        world[0, 0] @ [0.0, 1.0, 0.0], ahead[[0, 2, 1]] * [1, 1, -1], atol=0.02
    )
    assert np.ptp(np.asarray(clip.root)[:, 1]) < 0.15


def test_amass_files_with_y_up_are_detected(body, rest, tmp_path):
    """Standing, walking, and on the stairs: no floor along Z is taken for one."""
    upright = Rotation.identity()
    for way in ([0.0, 0, 0], [0.0, 0, 1.5], [1.0, 0.6, 0.4]):
        clip = load_motion(amass(tmp_path / "a.npz", upright, np.array(way)))
        world, _ = clip_transforms(body, rest, clip)
        assert world[0, 0, 1, 1] > 0.98, way


@pytest.mark.parametrize(
    ("name", "told", "says"),
    [
        ("walk", {"joint_map": {"Hips": "pelvis"}}, "has the body's"),
        ("walk", {"joint_map": "none.toml"}, "has the body's"),
        ("walk", {"skeleton": "none.asf"}, "for .amc files"),
        ("own.npz", {"joint_map": {"Hips": "pelvis"}}, "has the body's"),
        ("own.npz", {"skeleton": "none.asf"}, "for .amc files"),
    ],
)
def test_options_unused_by_a_motion_are_refused(tmp_path, name, told, says):
    if name.endswith(".npz"):
        save_motion(tmp_path / name, load_motion("walk", fps=5))
        name = tmp_path / name
    with pytest.raises(MotionError, match=says):
        load_motion(name, **told)
