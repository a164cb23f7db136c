"""Skeletons of other makers: a known motion told in their names and axes comes back."""

import pathlib
import re
import runpy

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from physxnet_jax.body import t_pose
from physxnet_jax.errors import MotionError
from physxnet_jax.motion import (
    JOINT_MAPS,
    LIMBS,
    clip_transforms,
    find_joint_map,
    foot_heights,
    load_motion,
    make_motion,
    procedural_clip,
    read_bvh,
    read_joint_map,
    stand_on_floor,
)

X_ALONG_BONE = "lafan"
_SAMPLES = runpy.run_path(str(pathlib.Path(__file__).parents[1] / "samples.py"))
limbs_apart = _SAMPLES["limbs_apart"]


def bvh(body, rest, motion, names, frames=None, turn=None, prefix="", moving=False):
    """The motion as a BVH of the given joint names.

    Args:
        frames: Body joint to the fixed rotation of its local axes; none by default.
        turn: Rotation of the whole world (Z up, say).
        moving: Every joint has six channels, with its offset in them.
    """
    world, shift = (np.asarray(x, np.float64) for x in clip_transforms(body, rest, motion))
    heads = np.asarray(body.joint_positions(rest)[0], np.float64)
    at = np.einsum("fjab,jb->fja", world, heads) + shift
    turn = np.eye(3) if turn is None else turn
    inside = {} if frames is None else frames
    axes = {b: inside.get(b, np.eye(3)) for b in names}
    chosen = [b for b in body.joint_names if b in names]
    parent = {}
    for b in chosen:
        j = body.parents[body.joint_names.index(b)]
        while j >= 0 and body.joint_names[j] not in names:
            j = body.parents[j]
        parent[b] = body.joint_names[j] if j >= 0 else None
    index = body.joint_names.index
    turned = {b: turn @ world[:, index(b)] @ turn.T @ axes[b] for b in chosen}
    lines, columns = ["HIERARCHY"], []

    def put(b, depth):
        mother = parent[b]
        offset = np.zeros(3)
        if mother is not None:
            offset = axes[mother].T @ turn @ (heads[index(b)] - heads[index(mother)])
        pad = "  " * depth
        six = mother is None or moving
        lines.append(f"{pad}{'ROOT' if mother is None else 'JOINT'} {prefix}{names[b]}")
        lines.append(pad + "{")
        lines.append(f"{pad}  OFFSET {' '.join(f'{100 * x:.6f}' for x in offset)}")
        place = "Xposition Yposition Zposition "
        lines.append(
            f"{pad}  CHANNELS {6 if six else 3} {place if six else ''}Zrotation Yrotation Xrotation"
        )
        local = turned[b] if mother is None else np.swapaxes(turned[mother], 1, 2) @ turned[b]
        if six:
            columns.append(
                100 * (at[:, 0] @ turn.T if mother is None else np.tile(offset, (len(at), 1)))
            )
        columns.append(Rotation.from_matrix(local).as_euler("ZYX", degrees=True))
        children = [c for c in chosen if parent[c] == b]
        for c in children:
            put(c, depth + 1)
        if not children:
            lines.extend([pad + "  End Site", pad + "  {", pad + "    OFFSET 0 0 0", pad + "  }"])
        lines.append(pad + "}")

    put("Hips", 0)
    lines += ["MOTION", f"Frames: {len(at)}", f"Frame Time: {1 / motion.fps:.8f}"]
    rows = np.concatenate(columns, axis=1)
    lines += [" ".join(f"{x:.6f}" for x in row) for row in rows]
    return "\n".join(lines) + "\n"


def along_bones(body, rest):
    """Local axes with X along every bone, as in LAFAN1; the zero pose is a bundle."""
    heads = np.asarray(body.joint_positions(rest)[0], np.float64)
    tails = np.asarray(body.joint_positions(rest)[1], np.float64)
    out = {}
    for name, head, tail in zip(body.joint_names, heads, tails, strict=True):
        x = (tail - head) / np.linalg.norm(tail - head)
        z = np.cross(x, [0.0, 0.0, 1.0])
        z /= np.linalg.norm(z)
        out[name] = np.stack([x, np.cross(z, x), z], axis=1)
    return out


def degrees(body, rest, a, b):
    """Largest angle between limbs, and between joint rotations, of two clips."""
    thick = [body.joint(n) for n in (*LIMBS, "Hips")]
    one, other = (np.asarray(clip_transforms(body, rest, m)[0])[:, thick] for m in (a, b))
    trace = np.trace(np.swapaxes(one, 2, 3) @ other, axis1=2, axis2=3)
    turns = np.degrees(np.arccos(np.clip(0.5 * (trace - 1), -1, 1)))
    return limbs_apart(body, rest, a, b), float(turns.max())


# What programs put before names, and a name that separates its parts in another way.
PREFIXES = {"mixamo": "mixamorig:", "biped": "Bip001_", "rigify": "DEF-", "vroid": "J_Bip_"}
PREFIXES |= {"character-creator": "CC_Base_", "vrm": "Avatar.", "unreal-4": "ue4_"}


@pytest.mark.parametrize("family", sorted(JOINT_MAPS.keys() - {"cmu-asf", "cmu-daz"}))
def test_walk_round_trips_through_every_joint_naming(body, rest, tmp_path, family):
    walk = procedural_clip("walk", fps=15.0)
    odd = along_bones(body, rest) if family == X_ALONG_BONE else None
    path = tmp_path / "a.bvh"
    names = {b: s.replace(" ", "_") for b, s in JOINT_MAPS[family].items()}
    path.write_text(bvh(body, rest, walk, names, odd, prefix=PREFIXES.get(family, "")))
    found, joints = find_joint_map(read_bvh(path))
    assert found == family and joints.keys() == names.keys()
    again = load_motion(path)
    assert again.num_frames == walk.num_frames
    limbs, turns = degrees(body, rest, walk, again)
    # From a standing frame the turn of a limb about itself is known less well.
    assert limbs < 0.1 and turns < (5.0 if odd else 1.0)
    # Nor how far its feet were turned then, on which the clip is put down.
    np.testing.assert_allclose(again.root, walk.root, atol=0.05 if odd else 0.01)


def test_skeleton_along_z_is_turned_upright(body, rest, tmp_path):
    walk = procedural_clip("walk", fps=15.0)
    z_up = Rotation.from_euler("X", 90, degrees=True).as_matrix()
    path = tmp_path / "a.bvh"
    path.write_text(bvh(body, rest, walk, JOINT_MAPS["mixamo"], turn=z_up))
    limbs, turns = degrees(body, rest, walk, load_motion(path))
    assert limbs < 0.1 and turns < 3.0
    # Without the turn he would lie on his back.
    lying = read_bvh(path).positions()
    assert np.ptp(lying[0][:, 2]) > 2 * np.ptp(lying[0][:, 1])


@pytest.mark.parametrize("angle", [180.0, 90.0, -90.0])
@pytest.mark.parametrize("z_up", [False, True])
def test_rest_heading_of_a_skeleton_does_not_change_the_walk(body, rest, tmp_path, angle, z_up):
    walk = procedural_clip("walk", fps=15.0)
    turn = Rotation.from_euler("Y", angle, degrees=True)
    stood = Rotation.from_euler("X", 90 if z_up else 0, degrees=True)
    path = tmp_path / "a.bvh"
    text = bvh(body, rest, walk, JOINT_MAPS["mixamo"], turn=(stood * turn).as_matrix())
    path.write_text(text)
    again = load_motion(path)
    # It goes where the file's person goes: turned with the skeleton.
    root = turn.apply(np.asarray(walk.root, np.float64))
    np.testing.assert_allclose(again.root, root, atol=0.01)
    first = np.asarray(again.rotations).copy()
    hips = Rotation.from_quat(first[:, 0], scalar_first=True)
    first[:, 0] = (turn.inv() * hips).as_quat(scalar_first=True)
    back = make_motion(first, walk.root, again.fps)
    limbs, turns = degrees(body, rest, walk, back)
    assert limbs < 0.1 and turns < 3.0


def test_joint_translations_are_applied(body, rest, tmp_path):
    walk = procedural_clip("walk", fps=15.0)
    path = tmp_path / "a.bvh"
    path.write_text(bvh(body, rest, walk, JOINT_MAPS["mixamo"], moving=True))
    limbs, turns = degrees(body, rest, walk, load_motion(path))
    assert limbs < 0.1 and turns < 3.0


def test_prefixed_names_and_missing_joints_are_handled(body, rest, tmp_path):
    walk = procedural_clip("walk", fps=10.0)
    few = {b: s for b, s in JOINT_MAPS["mixamo"].items() if "Toe" not in b and b != "Spine1"}
    path = tmp_path / "a.bvh"
    path.write_text(bvh(body, rest, walk, few, prefix="Model_"))
    family, joints = find_joint_map(read_bvh(path))
    assert family == "mixamo" and joints["Hips"] == "Model_Hips" and "LeftToeBase" not in joints
    limbs, _ = degrees(body, rest, walk, load_motion(path))
    assert limbs < 0.1


def test_custom_joint_map_is_read_from_a_file(body, rest, tmp_path):
    walk = procedural_clip("walk", fps=10.0)
    strange = {b: f"bone{n}" for n, b in enumerate(JOINT_MAPS["mixamo"])}
    path = tmp_path / "a.bvh"
    path.write_text(bvh(body, rest, walk, strange))
    with pytest.raises(MotionError, match=r"unknown joints.*--joint-map.*bone3"):
        load_motion(path)
    names = tmp_path / "names.toml"
    names.write_text("".join(f'{b} = "{s}"\n' for b, s in strange.items()))
    limbs, _ = degrees(body, rest, walk, load_motion(path, joint_map=read_joint_map(names)))
    assert limbs < 0.1


def test_partial_joint_map_completes_the_known_names(body, rest, tmp_path):
    """Four renamed joints, told; the spine and the neck are still known by their names."""
    walk = procedural_clip("walk", fps=10.0)
    odd = {"LeftUpLeg": "thighA", "RightUpLeg": "thighB", "LeftArm": "armA", "RightArm": "armB"}
    path = tmp_path / "a.bvh"
    path.write_text(bvh(body, rest, walk, JOINT_MAPS["mixamo"] | odd))
    again = load_motion(path, joint_map=odd)
    whole = tmp_path / "b.bvh"
    whole.write_text(bvh(body, rest, walk, JOINT_MAPS["mixamo"]))
    np.testing.assert_allclose(again.rotations, load_motion(whole).rotations, atol=1e-6)
    with pytest.raises(MotionError, match=r"the joint map lacks LeftArm, RightArm\. Map"):
        load_motion(path, joint_map={k: v for k, v in odd.items() if "Leg" in k})
    with pytest.raises(MotionError, match="has Tail, which the body lacks"):
        load_motion(path, joint_map=odd | {"Tail": "armA"})


def test_blend_from_the_initial_t_pose_is_removed(body, rest, tmp_path):
    """A conversion that blends from its T-pose in five frames: the clip begins as it goes on."""
    walk = procedural_clip("walk", fps=30.0)
    q = np.asarray(walk.rotations, np.float64)
    stretched = np.asarray(t_pose(body, body.default_shape()), np.float64)
    share = np.array([0.0, 0.5, 0.8, 0.92, 0.97])[:, None, None]
    blend = (1 - share) * stretched * np.sign(
        (stretched * q[:5]).sum(-1, keepdims=True)
    ) + share * q[:5]
    blend /= np.linalg.norm(blend, axis=-1, keepdims=True)
    blend[0, 0] = [1.0, 0.0, 0.0, 0.0]
    mixed = make_motion(np.concatenate([blend, q[5:]]), walk.root, 30.0)
    path = tmp_path / "a.bvh"
    path.write_text(bvh(body, rest, mixed, JOINT_MAPS["cmu-motionbuilder"]))
    again = np.asarray(load_motion(path).rotations)
    assert len(again) == len(q) - 1
    turned = 2 * np.degrees(np.arccos(np.clip(np.abs((again[1:] * again[:-1]).sum(-1)), 0, 1)))
    usual = 2 * np.degrees(np.arccos(np.clip(np.abs((q[1:] * q[:-1]).sum(-1)), 0, 1)))
    assert turned.max() < 1.6 * usual.max() and (turned[:1] < 0.1).all()
    # The control: a clip that begins with its first step is left alone.
    path.write_text(
        bvh(
            body,
            rest,
            make_motion(
                np.concatenate([stretched[None], q]),
                np.concatenate([walk.root[:1], walk.root]),
                30.0,
            ),
            JOINT_MAPS["cmu-motionbuilder"],
        )
    )
    same = load_motion(path)
    assert same.num_frames == len(q) and limbs_apart(body, rest, walk, same) < 0.2


@pytest.mark.parametrize("text", ["", "Hips = 3\n", 'Hip = "a"\n', "not toml", '[Hips]\na = "b"\n'])
def test_broken_joint_maps_are_refused(tmp_path, text):
    path = tmp_path / "names.toml"
    path.write_text(text)
    with pytest.raises(MotionError, match=r"names\.toml.*[Ww]rite"):
        read_joint_map(path)


def test_non_text_joint_map_is_refused(tmp_path):
    path = tmp_path / "names.toml"
    path.write_bytes(b"\xff\xfe\x00broken")
    with pytest.raises(MotionError, match="joint map"):
        read_joint_map(path)


SIDE_BEHIND = {
    "vrm": ("{}_L", "{}_R"),
    "mixamo": ("{}.l", "{}.r"),
    "unreal-4": ("{}-left", "{}-right"),
}


@pytest.mark.parametrize("family", sorted(SIDE_BEHIND))
def test_sides_may_stand_behind_names(body, rest, tmp_path, family):
    """UpperArm_L, arm.l, hand left; the control: a letter without a mark belongs to the name."""
    walk = procedural_clip("walk", fps=15.0)
    names = {}
    left, right = SIDE_BEHIND[family]
    for b, s in JOINT_MAPS[family].items():
        pattern = left if b.startswith("Left") else right if b.startswith("Right") else "{}"
        plain = s.removeprefix("left").removeprefix("right").removeprefix("Left")
        plain = plain.removeprefix("Right").removesuffix("_l").removesuffix("_r")
        names[b] = pattern.format(plain)
    path = tmp_path / "a.bvh"
    path.write_text(bvh(body, rest, walk, names))
    assert find_joint_map(read_bvh(path))[1] == names
    assert limbs_apart(body, rest, walk, load_motion(path)) < 0.1
    joined = {b: re.sub("[-_.]", "x", n) for b, n in names.items()}
    path.write_text(bvh(body, rest, walk, joined))
    with pytest.raises(MotionError, match="unknown joints"):
        load_motion(path)


@pytest.mark.parametrize("degrees_", [-40.0, 28.0])
def test_twist_of_the_trunk_comes_from_hips_and_shoulders(body, rest, tmp_path, degrees_):
    """A person who stands twisted all the time, told with X along the bones."""
    turns = np.tile([1.0, 0.0, 0.0, 0.0], (6, len(body.joint_names), 1))
    half = 0.5 * np.radians(degrees_)
    turns[:, body.joint("Spine")] = [np.cos(half), 0.0, np.sin(half), 0.0]
    clip = make_motion(turns, np.zeros((6, 3)), 30.0)
    path = tmp_path / "a.bvh"
    path.write_text(bvh(body, rest, clip, JOINT_MAPS["lafan"], along_bones(body, rest)))
    again = load_motion(path)
    heads = np.asarray(body.joint_positions(rest)[0], np.float64)

    def twist(motion):
        world, shift = (np.asarray(x, np.float64) for x in clip_transforms(body, rest, motion))
        at = np.einsum("fjab,jb->fja", world, heads) + shift
        yaw = []
        for name in ("UpLeg", "Arm"):
            line = at[0, body.joint(f"Left{name}")] - at[0, body.joint(f"Right{name}")]
            yaw.append(np.degrees(np.arctan2(-line[2], line[0])))
        return yaw[1] - yaw[0]

    assert twist(clip) == pytest.approx(degrees_, abs=1.0)
    assert twist(again) == pytest.approx(degrees_, abs=2.0)
    # Arms keep their directions.
    assert limbs_apart(body, rest, clip, again) < 0.5


def test_one_frame_through_the_floor_does_not_lift_the_others(body, rest):
    """The control: feet that go below it in many frames are on it."""
    walk = procedural_clip("walk", fps=30.0)
    frames = walk.num_frames
    for share, hover in ((1, False), (frames // 4, True)):
        root = np.array(walk.root)
        root[:share, 1] -= 0.11
        clip = stand_on_floor(body, make_motion(walk.rotations, root, 30.0), rest)
        heights = foot_heights(body, clip, rest)
        assert (np.median(heights) > 0.09) == hover
        assert float(np.quantile(heights, 0.2 if hover else 0.5)) == pytest.approx(0.0, abs=0.03)
