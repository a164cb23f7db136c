"""What `inspect` finds in a motion is there, and nothing is found in a good one."""

import dataclasses
import json
import pathlib
import re
import runpy

import jax.numpy as jnp
import numpy as np
import pygltflib
import pytest
from scipy.spatial.transform import Rotation

from physxnet_jax import inspect_motion
from physxnet_jax.cli import main
from physxnet_jax.cli._dress import _job
from physxnet_jax.cli._options import BodyOptions, MotionSource, Outfit
from physxnet_jax.errors import MotionError
from physxnet_jax.motion import (
    JOINT_MAPS,
    load_motion,
    procedural_clip,
    read_bvh,
    retarget,
    save_motion,
    sudden_turns,
)
from physxnet_jax.motion._inspect import _skeleton

standing_bvh = runpy.run_path(str(pathlib.Path(__file__).parents[1] / "samples.py"))["standing_bvh"]

_TESTS = pathlib.Path(__file__).parent
_write_gltf = runpy.run_path(str(_TESTS / "test_gltf_motion.py"))["write_gltf"]
# As far as a limb may turn in a frame of 60 a second, and no more.
TURN = Rotation.from_rotvec([0.0, 0.0, 0.6])
bvh = runpy.run_path(str(_TESTS / "test_skeletons.py"))["bvh"]


@pytest.fixture(scope="module")
def walk(body):
    return procedural_clip("walk", fps=30.0, body=body)


def test_clean_motion_is_reported_ready(walk):
    found = inspect_motion("walk")
    assert found.problems == found.notes == found.left_out == ()
    assert found.verdict == "ready: physxnet dress walk --wear shirt trousers -o walk.usdc"
    assert (found.frames, found.fps, found.unit) == (walk.num_frames, 30.0, "m")
    assert found.seconds == pytest.approx(walk.num_frames / 30)
    steps = np.diff(np.asarray(walk.root, np.float64), axis=0)
    assert found.travelled == pytest.approx(np.linalg.norm(steps[:, [0, 2]], axis=1).sum())
    assert found.fastest == pytest.approx(30 * np.linalg.norm(steps, axis=1).max(), rel=1e-5)
    assert 0 <= found.feet < 0.02 and found.carried == found.joints


@pytest.mark.parametrize(("scale", "unit"), [(0.01, "cm"), (1.0, "m"), (0.37, None)])
def test_unit_is_detected_from_the_leg_length(body, rest, walk, tmp_path, scale, unit):
    path = tmp_path / "walk.bvh"
    text = bvh(body, rest, walk, JOINT_MAPS["mixamo"])
    # The helper writes centimetres.
    lines = []
    for line in text.splitlines():
        head, _, numbers = line.partition("OFFSET ")
        if numbers:
            line = f"{head}OFFSET " + " ".join(
                f"{0.01 / scale * float(x):.6f}" for x in numbers.split()
            )
        lines.append(line)
    path.write_text("\n".join(lines))
    found = inspect_motion(path)
    assert found.unit == unit and found.skeleton in ("mixamo", "cmu-motionbuilder")
    assert found.reference in ("its rest pose", "the T-pose in its first frame, which is dropped")


def test_motion_faults_are_reported_with_their_frame(body, rest, walk, tmp_path):
    def seen(name, **change):
        save_motion(tmp_path / f"{name}.npz", dataclasses.replace(walk, **change))
        return inspect_motion(tmp_path / f"{name}.npz")

    root = np.asarray(walk.root)
    far = root.copy()
    far[50:] += [0.0, 0.0, 3.0]
    thrown = seen("thrown", root=jnp.asarray(far))
    assert len(thrown.problems) == 1 and "at frame 49" in thrown.problems[0]
    assert "--source-fps" in thrown.problems[0] and "fix the problems first" in thrown.verdict
    deep = root.copy()
    deep[60, 1] -= 0.5
    sunk = dataclasses.replace(walk, root=jnp.asarray(deep))
    (note,) = seen("deep", root=jnp.asarray(deep)).notes
    assert re.fullmatch(r"a foot is (49|50) cm below the floor at frame 60\.", note)
    # Files of other skeletons are put on the floor; a single frame through it doesn't count.
    (tmp_path / "deep.bvh").write_text(bvh(body, rest, sunk, JOINT_MAPS["mixamo"]))
    notes = " ".join(inspect_motion(tmp_path / "deep.bvh").notes)
    assert re.search(r"a foot is (49|50) cm below the floor at frame 60", notes)
    one = seen("one", root=walk.root[:1], rotations=walk.rotations[:1])
    assert any("a single frame" in n for n in one.notes) and one.fastest == 0


def test_limb_flips_are_reported_with_joint_and_frame(walk, body, tmp_path):
    turns = np.asarray(walk.rotations).copy()
    j = body.joint("LeftUpLeg")
    w, x, y, z = turns[70:, j].T
    # Half a turn about its own axis.
    turns[70:, j] = np.stack([-y, -z, w, x], axis=1)
    save_motion(tmp_path / "a.npz", dataclasses.replace(walk, rotations=jnp.asarray(turns)))
    (problem,) = inspect_motion(tmp_path / "a.npz").problems
    assert problem.startswith("LeftUpLeg turns by 1") and "from frame 69 to 70" in problem


def test_limb_flips_at_the_dressing_rate_are_reported_for_faster_files(walk, body, tmp_path):
    """Two frames of 60 a second are one of 30: half of the turn in each."""
    fast = load_motion("walk", fps=60.0)
    j = body.joint("LeftArm")
    turns = np.asarray(fast.rotations).copy()
    turns[70:, j] = (Rotation.from_quat(turns[70:, j], scalar_first=True) * TURN**2).as_quat(
        scalar_first=True
    )
    turns[69, j] = (Rotation.from_quat(turns[69, j], scalar_first=True) * TURN).as_quat(
        scalar_first=True
    )
    path = tmp_path / "a.npz"
    save_motion(path, dataclasses.replace(fast, rotations=jnp.asarray(turns, jnp.float32)))
    (problem,) = inspect_motion(path).problems
    assert "LeftArm turns by" in problem and problem.endswith("(at 30 frames per second).")
    assert sudden_turns(body, load_motion(path)) is None


def test_rest_and_motion_axis_mismatch_is_corrected_or_reported(body, rest, walk, tmp_path):
    """A rest pose along Z beside frames along Y is turned alone; the other way is told of."""
    y, z = walk, Rotation.from_euler("X", 90.0, degrees=True)
    path = tmp_path / "a.bvh"
    path.write_text(bvh(body, rest, y, JOINT_MAPS["mixamo"]))
    usual = load_motion(path)
    source = read_bvh(path)
    for rest_turned, frames_turned in ((True, False), (False, True)):
        turn, still = z.as_matrix(), np.eye(3)
        a, b = (turn if rest_turned else still), (turn if frames_turned else still)
        changed = dataclasses.replace(
            source,
            offsets=source.offsets @ a.T,
            rotations=b @ source.rotations @ a.T,
            root=source.root @ b.T,
        )
        clip = retarget(changed, body)
        note = _skeleton(changed, None, body, rest).lies
        if rest_turned:
            np.testing.assert_allclose(clip.rotations, usual.rotations, atol=1e-4)
            np.testing.assert_allclose(clip.root, usual.root, atol=1e-4)
        assert note == frames_turned


def test_custom_joint_map_is_part_of_the_suggested_command(body, rest, walk, tmp_path):
    names = {b: f"own {k}" for k, b in enumerate(JOINT_MAPS["mixamo"])}
    path, table = tmp_path / "my walk.bvh", tmp_path / "names.toml"
    path.write_text(bvh(body, rest, walk, {b: n.replace(" ", "") for b, n in names.items()}))
    with pytest.raises(MotionError, match="unknown joints"):
        inspect_motion(path)
    table.write_text("\n".join(f'{b} = "{n.replace(" ", "")}"' for b, n in names.items()))
    found = inspect_motion(path, joint_map=table, source_fps=60)
    assert found.skeleton == "custom map" and found.fps == 60
    assert found.carried == len(names) and found.joints == len(names)
    assert f"--joint-map {table} --source-fps 60" in found.command and "'my walk.usdc'" in (
        found.command
    )
    assert any("60 frames per second are resampled to 30" in n for n in found.notes)


def test_real_clip_reports_are_correct(data_dir):
    mocap = data_dir / "mocap"
    found = inspect_motion(mocap / "mb" / "005_06.bvh")
    assert "RightUpLeg turns by" in found.problems[0] and found.skeleton == "cmu-motionbuilder"
    asf = inspect_motion(mocap / "amc" / "001_01.amc")
    assert asf.unit == "5.6 cm (CMU)" and asf.skeleton == "cmu-asf" and not asf.problems
    slow = next((mocap / "daz").glob("060_*.bvh"))
    said = inspect_motion(slow)
    assert any("--source-fps 60" in n for n in said.notes) and said.unit == "cm"
    assert "ToeBase" in " ".join(said.left_out)
    told = inspect_motion(slow, source_fps=60)
    assert not any("--source-fps 60" in n for n in told.notes) and told.fps == 60
    assert told.frames == load_motion(slow, source_fps=60).num_frames


def test_inspect_command_accepts_motions_and_garments(body, rest, walk, tmp_path, capsys):
    short = dataclasses.replace(walk, root=walk.root[:8], rotations=walk.rotations[:8])
    save_motion(tmp_path / "walk.npz", short)
    _write_gltf(tmp_path / "walk.glb", body, rest, short)
    assert main(["inspect", "walk", str(tmp_path / "walk.npz"), "--json"]) == 0
    a, b = json.loads(capsys.readouterr().out)
    assert a["frames"] == 120 and b["frames"] == 8 and b["verdict"].startswith("ready")
    # A glTF without a mesh is a motion, one with a mesh is a garment unless told otherwise.
    document = pygltflib.GLTF2().load(str(tmp_path / "walk.glb"))
    assert document is not None and document.animations
    bare = not document.meshes
    words = ["inspect", str(tmp_path / "walk.glb"), *([] if bare else ["--motion"])]
    assert main(words) == 0
    said = capsys.readouterr().out
    assert "8 at 30 a second" in said and "ready: physxnet dress" in said
    document.meshes = [pygltflib.Mesh(name="m")]
    document.save(str(tmp_path / "both.glb"))
    assert main(["inspect", str(tmp_path / "both.glb")]) == 2
    assert "no mesh in it" in capsys.readouterr().err
    assert main(["inspect", "--motion", str(tmp_path / "both.glb")]) == 0
    assert "8 at 30 a second" in capsys.readouterr().out


def test_motion_problems_set_the_exit_code(walk, tmp_path, capsys):
    far = np.asarray(walk.root).copy()
    far[50:] += [0.0, 0.0, 3.0]
    save_motion(tmp_path / "a.npz", dataclasses.replace(walk, root=jnp.asarray(far)))
    assert main(["inspect", str(tmp_path / "a.npz")]) == 1
    assert "wrong: its hips move at" in capsys.readouterr().out


def test_motion_options_are_refused_for_a_garment(capsys):
    assert main(["inspect", "shirt.obj", "--source-fps", "60"]) == 2
    assert "--source-fps is for motions" in " ".join(capsys.readouterr().err.split())


def test_rates_that_cmu_declares_twice_too_high_are_noted(tmp_path):
    """Dressing says it as inspecting does; not where a rate is given, nor of other skeletons."""
    theirs = re.sub(
        r"(ROOT|JOINT) (\w+)",
        lambda k: f"{k[1]} {JOINT_MAPS['cmu-daz'].get(k[2], k[2])}",
        standing_bvh(),
    )

    def notes(name, text, rate, **source):
        file = tmp_path / name
        file.write_text(text.replace("0.0333333", f"{1.0 / rate:.8f}"))
        options = (Outfit(), BodyOptions(), {"method": "network"}, lambda *_: None)
        said = _job(str(file), MotionSource(**source), *options).notes
        inspected = inspect_motion(file, **source).notes
        assert len(said) == sum("--source-fps 60" in n for n in inspected)
        return len(said)

    for name in ("060_10.bvh", "61_01_walk.bvh"):
        assert notes(name, theirs, 120.0) == 1
    assert notes("060_10.bvh", theirs, 120.0, source_fps=60.0) == 0
    assert notes("060_10.bvh", theirs, 60.0) == 0
    assert notes("06_10.bvh", theirs, 120.0) == 0
    assert notes("060_10.bvh", standing_bvh(), 120.0) == 0
