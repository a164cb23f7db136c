"""Real clips of every family, and every way a file can be broken."""

import csv
import pathlib
import runpy

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from physxnet_jax.data import load_action, read_protocol
from physxnet_jax.errors import MotionError
from physxnet_jax.motion import (
    LIMBS,
    clip_transforms,
    find_joint_map,
    foot_heights,
    load_motion,
    read_amc,
    read_bvh,
    resample,
    retarget,
)

_SAMPLES = runpy.run_path(str(pathlib.Path(__file__).parents[1] / "samples.py"))
BVH, ASF, AMC = (_SAMPLES[name] for name in ("BVH", "ASF", "AMC"))


@pytest.mark.nightly
def test_all_fifty_actions_load_with_the_frames_of_the_protocol(data_dir):
    actions = read_protocol(data_dir / "mocap")
    assert len(actions) == 50
    counts = {s: [a for a in actions if a.split == s] for s in ("train", "test", "extra")}
    assert [len(counts[s]) for s in ("train", "test", "extra")] == [22, 12, 16]
    assert sum(a.frames for a in counts["train"]) == 3217
    assert sum(a.frames for a in counts["test"]) == 1620
    for action in actions:
        motion = load_action(data_dir / "mocap", action)
        assert motion.num_frames == action.frames and motion.fps == 30.0
        assert np.isfinite(np.asarray(motion.rotations)).all()


@pytest.mark.parametrize(
    "name", ["amc/002_04.amc", "mb/005_03.bvh", "daz/135_04.bvh", "max/jumping_jacks.bvh"]
)
def test_retargeted_limbs_match_the_source_directions(data_dir, body, rest, name):
    path = data_dir / "mocap" / name
    source = read_bvh(path) if path.suffix == ".bvh" else read_amc(path)
    motion = retarget(source)
    _, joints = find_joint_map(source)
    positions = source.positions()[len(source.root) - motion.num_frames :]
    world, shift = clip_transforms(body, rest, motion)
    heads = np.asarray(body.joint_positions(rest)[0])
    ours = np.einsum("fjab,jb->fja", world, heads) + shift
    # DAZ conversions come from a T-pose within some frames, which no person goes.
    begin = 10 if name.startswith("daz") else 0
    positions, ours = positions[begin:], ours[begin:]
    for a, b in LIMBS.items():
        theirs = (
            positions[:, source.names.index(joints[b])]
            - positions[:, source.names.index(joints[a])]
        )
        mine = ours[:, body.joint(b)] - ours[:, body.joint(a)]
        cosine = np.einsum("ij,ij->i", theirs, mine)
        cosine /= np.linalg.norm(theirs, axis=1) * np.linalg.norm(mine, axis=1)
        assert np.degrees(np.arccos(np.clip(cosine, -1, 1))).max() < 2.0


def test_amc_and_bvh_of_one_trial_give_the_same_pose(data_dir):
    a = load_motion(data_dir / "mocap/amc/005_11.amc")
    b = load_motion(data_dir / "mocap/mb/005_11.bvh")
    # The BVH dropped its T-pose frame; both then start with the same frame.
    n = min(a.num_frames, b.num_frames)
    q, p = (np.asarray(m.rotations)[:n] for m in (a, b))
    limbs = [0, *range(4, 9), 10, 13, 15, 18, 21, 22]
    gap = np.degrees(2 * np.arccos(np.clip(np.abs((q * p).sum(axis=2)), 0, 1)))[:, limbs]
    assert gap.max() < 2.0
    assert np.abs(np.asarray(a.root)[:n] - np.asarray(b.root)[:n]).max() < 0.02


@pytest.mark.parametrize(
    "name",
    ["amc/002_05.amc", "amc/002_06.amc", "mb/005_12.bvh", "amc/002_09.amc", "max/131_01.bvh"],
)
def test_feet_stay_near_the_floor_on_standing_clips(data_dir, body, rest, name):
    height = foot_heights(body, load_motion(data_dir / "mocap" / name, fps=30.0), rest)
    assert height.min() == pytest.approx(0.0, abs=2e-3) and height.max() < 0.06


def test_source_rate_overrides_a_wrong_header(data_dir):
    with (data_dir / "mocap/CLIPS.csv").open() as file:
        rates = {r["file"]: float(r["fps"]) for r in csv.DictReader(file)}
    assert rates["daz/060_12.bvh"] == 60.0
    assert load_motion(data_dir / "mocap/daz/060_12.bvh").fps == 120.0
    assert load_motion(data_dir / "mocap/daz/060_12.bvh", source_fps=60.0).fps == 60.0


def test_small_bvh_is_read_exactly(tmp_path):
    path = tmp_path / "a.bvh"
    path.write_text(BVH)
    clip = read_bvh(path)
    assert clip.names == ("Hips", "Knee") and clip.fps == 120
    np.testing.assert_allclose(clip.root, [[0, 1, 0], [0, 1, 0]])
    expected = Rotation.from_euler("ZYX", [0, 0, 90], degrees=True)
    np.testing.assert_allclose(clip.rotations[1, 0], expected.as_matrix(), atol=1e-12)
    np.testing.assert_allclose(clip.positions()[1, 1], [0, 1, -1], atol=1e-12)


def test_largest_of_several_skeletons_is_read(tmp_path):
    """A prop before the person, a camera after: neither moves him."""
    head, frames = BVH.split("MOTION")
    prop = head.split("JOINT")[0].partition("\n")[2].replace("Hips", "Prop") + "}\n"
    other = prop.replace("Prop", "Hips")
    rows = frames.strip().splitlines()
    rows[2:] = [f"{'7 ' * 6}{row} {'8 ' * 6}" for row in rows[2:]]
    path = tmp_path / "a.bvh"
    path.write_text(
        "HIERARCHY\n" + prop + head.partition("\n")[2] + other + "MOTION\n" + "\n".join(rows)
    )
    clip = read_bvh(path)
    path.write_text(BVH)
    alone = read_bvh(path)
    assert clip.names == alone.names and clip.parents == alone.parents
    for a, b in ((clip.positions(), alone.positions()), (clip.rotations, alone.rotations)):
        np.testing.assert_array_equal(a, b)


def test_duplicate_joint_names_are_numbered(tmp_path):
    knee = BVH[BVH.index("  JOINT Knee") : BVH.index("}\nMOTION")]
    text = BVH.replace(knee, knee.replace("Knee", "Knee_2") + 2 * knee)
    path = tmp_path / "a.bvh"
    path.write_text(
        "".join(f"{x} 1 2 3 4 5 6\n" if x[0] == "0" else f"{x}\n" for x in text.split("\n") if x)
    )
    assert read_bvh(path).names == ("Hips", "Knee_2", "Knee", "Knee_3")


@pytest.mark.parametrize(
    ("change", "line", "says"),
    [
        (lambda s: "", None, "empty"),
        (lambda s: "\0\1\2" + s, None, "binary"),
        (lambda s: s.replace("HIERARCHY", "HELLO"), 1, "HIERARCHY"),
        (lambda s: s[: s.index("MOTION")], 15, "truncated"),
        (lambda s: s.rsplit("\n", 2)[0] + "\n", 19, "truncated"),
        (lambda s: s.replace("0 1 0 0 0 90 10 0 0", "0 1 0 0 0 90 10 0"), 20, "values"),
        (lambda s: s.replace("90 10", "nan 10"), 20, "not finite"),
        (lambda s: s.replace("90 10", "x 10"), 20, "not a number"),
        (lambda s: s.replace("CHANNELS 3", "CHANNELS 4"), 9, "CHANNELS declares"),
        (lambda s: s.replace("CHANNELS 3", "CHANNELS \u00b2"), 9, "CHANNELS declares"),
        (lambda s: s.replace("Frames: 2", "Frames: " + 5000 * "9"), 17, "number of frames"),
        (
            lambda s: s.replace(
                "Zrotation Yrotation Xrotation\n    End", "Wrotation Yrotation Xrotation\n    End"
            ),
            9,
            "unknown",
        ),
        (lambda s: s.replace("Frames: 2", "Frames: many"), 17, "number of frames"),
        (lambda s: s.replace("Frame Time: 0.0083333", "Frame Time: 0"), 18, "positive"),
        (lambda s: s.replace("    End Site", "    }}\n    End Site"), None, "'}"),
        (lambda s: s.replace("OFFSET 0 -1 0", "OFFSET 0 -1", 1), 8, "3"),
        (lambda s: s.replace("JOINT Knee", "ROOT Knee"), 6, "inside a joint"),
        (lambda s: s.replace("ROOT Hips", "JOINT Hips"), 2, "outside any joint"),
    ],
)
def test_broken_bvh_errors_name_the_file_line_and_fix(tmp_path, change, line, says):
    path = tmp_path / "broken.bvh"
    path.write_text(change(BVH), encoding="utf-8")
    with pytest.raises(MotionError, match=says) as error:
        read_bvh(path)
    text = str(error.value)
    assert text.startswith(str(path)) and text.count(". ") >= 1
    if line is not None:
        assert text.startswith(f"{path}:{line}:")


@pytest.mark.parametrize(
    ("change", "says"),
    [
        (lambda s: "", "empty"),
        (lambda s: "\0" + s, "binary"),
        (lambda s: s[: s.rindex("lfemur")], "lacks 'lfemur'"),
        (lambda s: s.replace("lfemur 20", "lfemur 20 30"), "channels"),
        (lambda s: s.replace("lfemur 20", "ltail 20"), "unknown bone"),
        (lambda s: s.replace("lfemur 20", "lfemur inf"), "not finite"),
        (lambda s: s.replace("lfemur 10\n2", "lfemur 10\nlfemur 11\n2"), "twice"),
        (lambda s: "root 0 0 0 0 0 0\n", "before the first frame"),
        (lambda s: ":DEGREES\n", "no frame"),
    ],
)
def test_broken_amc_files_are_refused(tmp_path, change, says):
    (tmp_path / "01.asf").write_text(ASF)
    path = tmp_path / "01_02.amc"
    path.write_text(change(AMC))
    with pytest.raises(MotionError, match=says) as error:
        read_amc(path)
    assert str(path) in str(error.value)


def test_missing_asf_error_names_the_expected_file(tmp_path):
    path = tmp_path / "01_02.amc"
    path.write_text(AMC)
    with pytest.raises(MotionError, match=r"01\.asf"):
        read_amc(path)
    (tmp_path / "01.asf").write_text(ASF)
    assert read_amc(path).names == ("root", "lfemur")


def test_unknown_joints_and_files_are_reported(tmp_path):
    path = tmp_path / "a.bvh"
    path.write_text(BVH)
    with pytest.raises(MotionError, match="unknown joints"):
        load_motion(path)
    with pytest.raises(MotionError, match="built-in clip"):
        load_motion("wlak")
    with pytest.raises(MotionError, match="no such file"):
        load_motion(tmp_path / "none.bvh")
    (tmp_path / "x.npz").write_bytes(b"PK\3\4 broken")
    with pytest.raises(MotionError, match="motion archive"):
        load_motion(tmp_path / "x.npz")


def test_resampling_keeps_duration(data_dir):
    motion = load_motion(data_dir / "mocap/amc/002_04.amc")
    slow = resample(motion, 24.0)
    assert abs((slow.num_frames - 1) / 24 - (motion.num_frames - 1) / motion.fps) < 1 / 24


def test_bvh_blank_lines_and_tabs_are_accepted(tmp_path):
    plain, odd = tmp_path / "a.bvh", tmp_path / "b.bvh"
    plain.write_text(BVH)
    odd.write_text("\n \n" + BVH.replace("Frame Time:", "Frame\tTime: ").replace("\n", "\r\n"))
    np.testing.assert_array_equal(read_bvh(odd).rotations, read_bvh(plain).rotations)
    odd.write_text("\n\nHALLO\n")
    with pytest.raises(MotionError, match=r"b\.bvh:3.*'HALLO' where HIERARCHY"):
        read_bvh(odd)


def test_source_rate_is_refused_for_built_in_clips():
    with pytest.raises(MotionError, match="'walk' is computed at any rate"):
        load_motion("walk", fps=30.0, source_fps=60.0)


def test_asf_in_radians_matches_asf_in_degrees(tmp_path):
    (tmp_path / "01.asf").write_text(ASF)
    (tmp_path / "01_02.amc").write_text(AMC)
    wanted = read_amc(tmp_path / "01_02.amc")
    ten, twenty = np.radians([10.0, 20.0])
    text = ASF.replace("angle deg", "angle rad").replace("axis 0 0 20", f"axis 0 0 {twenty:.9f}")
    (tmp_path / "01.asf").write_text(text)
    moved = AMC.replace("lfemur 10", f"lfemur {ten:.9f}").replace(
        "lfemur 20", f"lfemur {twenty:.9f}"
    )
    (tmp_path / "01_02.amc").write_text(moved)
    seen = read_amc(tmp_path / "01_02.amc")
    np.testing.assert_allclose(seen.rotations, wanted.rotations, atol=1e-7)
    assert np.abs(wanted.rotations[0, 1] - wanted.rotations[1, 1]).max() > 0.1
