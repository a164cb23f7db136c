"""Datasets: quantised to 0.05 mm, whole or absent, resumed."""

import dataclasses
import functools
import zlib

import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings, strategies as st

from physxnet_jax.body import load_body
from physxnet_jax.data import (
    Action,
    DatasetConfig,
    _build,
    build_dataset,
    dataset_digest,
    expected_frames,
    left_out,
    list_sequences,
    load_action,
    make_codec,
    open_dataset,
    read_note,
    read_protocol,
    read_sequence,
    read_times,
    usable_garment,
    write_action,
    write_garment,
    write_offsets,
)
from physxnet_jax.data._build import action_motion
from physxnet_jax.data._files import join, last_name
from physxnet_jax.data._store import is_stored, write_times
from physxnet_jax.errors import FormatError, MotionError
from physxnet_jax.garment import square_sheet, template
from physxnet_jax.motion import load_motion, make_motion, save_motion
from physxnet_jax.simulation import XPBD, Rollout


def stored(root, frames=70, seed=0):
    """An action with a sheet that moves smoothly, with a little noise."""
    folder = root / "walk"
    sheet = square_sheet(9)
    vertices, faces = np.asarray(sheet.mesh.vertices), np.asarray(sheet.mesh.faces)
    write_garment(root, "top", vertices, faces)
    write_action(folder, load_motion("walk"), "train")
    t = np.arange(frames)[:, None, None] / 30.0
    wave = 0.1 * np.sin(3 * t + 4 * vertices[None])
    noise = np.random.default_rng(seed).normal(0, 2e-4, wave.shape)
    return folder, (wave + noise).astype(np.float32)


def test_offsets_round_trip_within_half_a_quantization_step(tmp_path):
    folder, offsets = stored(tmp_path)
    write_offsets(folder, "top", offsets, {"finite": True, "engine": "test"})
    s = read_sequence(folder)
    assert np.abs(s.offsets["top"] - offsets).max() <= 0.5001e-4 + 1e-7
    assert s.split == "train" and s.meta["top"]["finite"] and s.motion.num_frames == 120
    assert s.meta["top"]["unit"] == "m" and s.meta["top"]["engine"] == "test"
    assert list_sequences(tmp_path, "train") == [str(folder)] and not list_sequences(
        tmp_path, "test"
    )


def test_predictive_coding_compresses_smooth_offsets(tmp_path):
    """The wave costs little more than half of what its plain numbers cost, noise included."""
    folder, offsets = stored(tmp_path)
    write_offsets(folder, "top", offsets, {})
    size = sum(p.stat().st_size for p in (folder / "top").rglob("*") if p.is_file())
    plain = len(zlib.compress(np.round(offsets / 1e-4).astype("<i2").tobytes(), 9))
    assert size < 0.6 * plain


@settings(max_examples=25, deadline=None)
@given(st.integers(0, 2**31), st.integers(1, 6), st.integers(0, 15))
def test_codec_is_lossless_for_arbitrary_integers(seed, frames, bits):
    sheet = square_sheet(5)
    codec = make_codec(np.asarray(sheet.mesh.vertices), np.asarray(sheet.mesh.faces))
    values = np.random.default_rng(seed).integers(-(2**bits), 2**bits, (frames, 25, 3))
    np.testing.assert_array_equal(codec.decode(codec.encode(values)), values)


def test_codec_handles_unused_vertices_and_degenerate_triangles():
    x = np.array([[0, 0, 0], [1, 0, 0], [1, 0, 0], [0, 1e-9, 0], [5, 5, 5.0]])
    codec = make_codec(x, np.array([[0, 1, 2], [0, 1, 3]]))
    values = np.random.default_rng(0).integers(-32000, 32000, (4, 5, 3))
    np.testing.assert_array_equal(codec.decode(codec.encode(values)), values)


def test_datasets_are_byte_reproducible_and_damage_is_detected(tmp_path):
    digests = []
    for name in ("a", "b"):
        folder, offsets = stored(tmp_path / name)
        write_offsets(folder, "top", offsets, {"finite": True})
        digests.append(dataset_digest(tmp_path / name))
    assert digests[0] == digests[1]
    other, offsets = stored(tmp_path / "c", seed=1)
    write_offsets(other, "top", offsets, {"finite": True})
    assert dataset_digest(tmp_path / "c")[0] != digests[0][0]
    note = folder / "top" / "zarr.json"
    note.write_text(note.read_text().replace('"sha256":"', '"sha256":"0'))
    with pytest.raises(FormatError, match="checksum"):
        read_sequence(folder)


def test_partially_written_garments_are_ignored(tmp_path):
    folder, offsets = stored(tmp_path)
    write_offsets(folder, "top", offsets, {"finite": True})
    digest = dataset_digest(tmp_path)
    part = folder / ".bottom.part"
    part.mkdir()
    (part / "zarr.json").write_text((folder / "top" / "zarr.json").read_text())
    assert list(read_sequence(folder).offsets) == ["top"]
    assert dataset_digest(tmp_path) == digest


def test_stored_actions_refuse_another_motion(tmp_path):
    folder, _ = stored(tmp_path)
    walk = load_motion("walk")
    write_action(folder, walk, "train")
    with pytest.raises(FormatError, match="another version"):
        write_action(folder, load_motion("punch"), "train")
    with pytest.raises(FormatError, match="another version"):
        write_action(folder, dataclasses.replace(walk, root=walk.root + 0.01), "train")
    np.testing.assert_array_equal(read_sequence(folder).motion.root, walk.root)


def test_exploded_offsets_are_refused_and_leave_no_files(tmp_path):
    folder, offsets = stored(tmp_path)
    for bad in (np.full_like(offsets, 9.0), np.full_like(offsets, np.nan)):
        with pytest.raises(FormatError, match=r"3\.2 m"):
            write_offsets(folder, "top", bad, {})
    assert not read_sequence(folder).offsets
    with pytest.raises(FormatError, match=r"action\.json"):
        read_sequence(tmp_path)


@pytest.mark.release
def test_builds_resume_and_refuse_another_solver(data_dir, tmp_path):
    config = DatasetConfig(templates=("bottom",), solver=XPBD(8, 1))
    build = functools.partial(
        build_dataset, root=tmp_path, folder=data_dir / "mocap", only=("run",)
    )
    assert build(config) == 1
    assert build(config) == 0
    s = read_sequence(tmp_path / "run")
    assert s.offsets["bottom"].shape == (34, 2726, 3)
    assert s.meta["bottom"]["engine"] == "physxnet" and s.meta["bottom"]["substeps"] == 8
    before = dataset_digest(tmp_path)[0]
    assert build(config, shard=(1, 2)) == 0, "the only action belongs to the other shard"
    for path in sorted((tmp_path / "run" / "bottom").rglob("*"), reverse=True):
        path.unlink() if path.is_file() else path.rmdir()
    (tmp_path / "run" / "bottom").rmdir()
    assert build(config) == 1
    assert dataset_digest(tmp_path)[0] == before, "same configuration, same bytes"
    with pytest.raises(FormatError, match="another configuration"):
        build(DatasetConfig(templates=("bottom",), solver=XPBD(16, 1)))


@pytest.mark.release
def test_configuration_augments_the_actions(data_dir):
    body = load_body()
    train = [a for a in read_protocol(data_dir / "mocap") if a.split == "train"]
    last, first = train[-1], train[0]
    load = functools.partial(action_motion, body=body, folder=data_dir / "mocap")
    plain, other = load(DatasetConfig(), last), load(DatasetConfig(), first)
    arm, leg = body.joint("LeftArm"), body.joint("LeftUpLeg")
    # One place further on from the last action is the first one.
    mixed = load(DatasetConfig(upper_from=1), last)
    np.testing.assert_allclose(mixed.rotations[:5, arm], other.rotations[:5, arm], atol=1e-6)
    np.testing.assert_allclose(mixed.rotations[:, leg], plain.rotations[:, leg], atol=1e-6)
    wide = load(DatasetConfig(exaggerate=1.3), last)
    assert np.abs(np.asarray(wide.rotations - plain.rotations)).max() > 0.01
    both = load(DatasetConfig(mirror=True, speed=2.0), last)
    assert both.num_frames == (plain.num_frames + 1) // 2
    np.testing.assert_allclose(both.root[0] * jnp.array([-1.0, 1.0, 1.0]), plain.root[0], atol=1e-5)


@pytest.mark.nightly
def test_left_out_frames_overlap_no_action(data_dir):
    actions = read_protocol(data_dir / "mocap")
    rest = left_out(data_dir / "mocap", actions)
    assert {"exercise", "jumps kicks punches", "salsa"} <= {a.name for a in rest}
    tested = {a.file for a in actions if a.split == "test"}
    for a in rest:
        assert a.file not in tested and 60 <= a.frames <= 400
        (told,) = (b for b in actions if b.name == a.name)
        assert a.split == told.split
        end, told_end = a.start + a.frames / 30.0, told.start + told.frames / 30.0
        assert end <= told.start + 1e-6 or a.start >= told_end - 1e-6
        assert load_action(data_dir / "mocap", a).num_frames == a.frames


def test_damaged_times_are_skipped_and_are_no_part_of_the_digest(tmp_path):
    before = dataset_digest(tmp_path)
    for k in range(2):
        write_times(tmp_path, f"walk{k}", "top", {"k": k})
    (tmp_path / "times/walk0-top.json").write_bytes(b'{"k": 2, "sec')
    assert [line["k"] for line in read_times(tmp_path)] == [1]
    assert read_times(tmp_path / "none") == []
    assert dataset_digest(tmp_path) == before


@pytest.mark.parametrize("url", ["memory://a/set", "file://{}/b/", "file://{}/c/|ocdbt:", "{}/d"])
def test_every_kind_of_store_holds_the_same_dataset(tmp_path, url):
    root = url.format(tmp_path)
    folder, offsets = stored(tmp_path / "plain")
    write_offsets(folder, "top", offsets, {"finite": True})
    sheet = square_sheet(9)
    open_dataset(root, {"fps": 30})
    assert read_note(root) == {"fps": 30}
    write_garment(root, "top", np.asarray(sheet.mesh.vertices), np.asarray(sheet.mesh.faces))
    write_action(join(root, "walk"), load_motion("walk"), "train")
    assert not is_stored(join(root, "walk"), "top")
    write_offsets(join(root, "walk"), "top", offsets, {"finite": True})
    assert is_stored(join(root, "walk"), "top")
    (where,) = list_sequences(root, "train")
    a, b = read_sequence(where), read_sequence(folder)
    np.testing.assert_array_equal(a.offsets["top"], b.offsets["top"])
    np.testing.assert_array_equal(a.motion.rotations, b.motion.rotations)
    assert a.name == b.name == "walk" and a.meta == b.meta
    open_dataset(tmp_path / "plain", {"fps": 30})
    assert dataset_digest(root) == dataset_digest(tmp_path / "plain")


def test_stores_that_cannot_be_opened_or_written_are_reported(tmp_path):
    with pytest.raises(FormatError, match="can't be opened"):
        list_sequences("nothing://a/b")
    (tmp_path / "file").write_text("")
    with pytest.raises(FormatError, match="can't be written"):
        open_dataset(tmp_path / "file", {"fps": 30})


@pytest.mark.parametrize("text", ["{", "[]", "\xff"])
def test_damaged_dataset_metadata_is_reported(tmp_path, text):
    open_dataset(tmp_path, {"fps": 30})
    open_dataset(tmp_path, {"fps": 30})
    (tmp_path / "dataset.json").write_bytes(text.encode("latin-1"))
    with pytest.raises(FormatError, match=r"damaged|another configuration"):
        open_dataset(tmp_path, {"fps": 30})


@pytest.mark.sampled(1)
@pytest.mark.release
@pytest.mark.parametrize(("left", "speed"), [(False, 1.25), (True, 0.8)])
def test_expected_frames_match_the_built_actions(data_dir, tmp_path, left, speed):
    folder = data_dir / "mocap"
    note = {"splits": ["extra"], "speed": speed} | ({"left_out": True} if left else {})
    open_dataset(tmp_path / "set", note)
    counts = expected_frames(tmp_path / "set", folder)
    actions = [a for a in read_protocol(folder) if a.split == "extra"]
    actions = left_out(folder, actions) if left else actions
    assert list(counts) == [a.name for a in actions]
    config = DatasetConfig(speed=speed)
    for a in actions[:2]:
        assert counts[a.name] == action_motion(config, a, load_body(), folder).num_frames
        assert counts[a.name] != a.frames


def test_unknown_actions_are_reported_before_the_build(data_dir, tmp_path):
    config = DatasetConfig(templates=("bottom",))
    with pytest.raises(
        FormatError, match="no action 'fly' in the splits train, test; there are: w"
    ):
        build_dataset(config, tmp_path / "d", data_dir / "mocap", only=("run", "fly"))
    assert not (tmp_path / "d").exists()


@pytest.mark.parametrize("names", [("Jump!", "jump"), ("walk", "\u6b69\u304f")])
def test_actions_without_a_unique_folder_name_are_refused(tmp_path, names):
    head = "split,action,file,start_s,frames_at_30fps\n"
    rows = [f"train,{n},a.bvh,0,30\n" for n in names]
    (tmp_path / "ACTIONS.csv").write_text(head + "".join(rows), encoding="utf-8")
    with pytest.raises(MotionError, match="no unique folder name"):
        read_protocol(tmp_path)


def test_left_out_frames_begin_after_nested_actions(tmp_path):
    """An action within another: what lies after the inner one is still used, and once."""
    walk = load_motion("walk", fps=30.0)
    turns = np.tile(np.asarray(walk.rotations), (8, 1, 1))[:600]
    root = np.tile(np.asarray(walk.root), (8, 1))[:600]
    save_motion(tmp_path / "a.npz", make_motion(turns, root, 30.0))
    (tmp_path / "ACTIONS.csv").write_text(
        "split,action,file,start_s,frames_at_30fps\n"
        "train,long,a.npz,0.0,300\ntrain,short,a.npz,2.0,30\n"
    )
    found = left_out(tmp_path, read_protocol(tmp_path))
    assert [(a.name, a.start) for a in found] == [("long", 10.0)]
    # Asked for by itself the other one gets no stretch that isn't its.
    config = DatasetConfig(splits=("train",), templates=("bottom",), left_out=True)
    with pytest.raises(FormatError, match="left_out selects no frames for short"):
        build_dataset(config, tmp_path / "set", tmp_path, only=("short",))
    assert not (tmp_path / "set").exists()


@pytest.mark.parametrize(
    ("wrong", "says"),
    [
        ({"splits": ("training",)}, "there are train, test, extra"),
        ({"splits": ()}, "splits are"),
        ({"templates": ()}, "there are top, bottom, dress"),
        ({"speed": 0.0}, "speed is 0.0"),
        ({"speed": -1.0}, "speed is -1.0"),
        ({"exaggerate": float("nan")}, "exaggerate is nan"),
    ],
)
def test_invalid_dataset_settings_are_refused(wrong, says):
    with pytest.raises(ValueError, match=says):
        DatasetConfig(**wrong)


def test_upper_from_that_selects_the_action_itself_is_refused(data_dir, tmp_path):
    for number in (12, 24):
        config = DatasetConfig(splits=("test",), upper_from=number)
        with pytest.raises(FormatError, match="is the action itself"):
            build_dataset(config, tmp_path / "set", data_dir / "mocap")
    assert not (tmp_path / "set").exists()


@pytest.mark.parametrize(
    "row",
    ["train,walk,a.bvh,soon,34", "train,walk,a.bvh", "train,walk,a.bvh,0.0,3.5"],
    ids=["words", "short", "half a frame"],
)
def test_invalid_protocol_rows_are_reported_by_line(tmp_path, row):
    head = "split,action,file,start_s,frames_at_30fps"
    (tmp_path / "ACTIONS.csv").write_text(f"{head}\ntrain,run,b.bvh,0.0,30\n{row}\n")
    with pytest.raises(MotionError, match=r"ACTIONS\.csv:3: not a row"):
        read_protocol(tmp_path)
    (tmp_path / "ACTIONS.csv").write_text("name,file\nwalk,a.bvh\n")
    with pytest.raises(MotionError, match="split"):
        read_protocol(tmp_path)


def test_missing_protocol_file_is_reported(tmp_path):
    with pytest.raises(MotionError, match=r"ACTIONS\.csv"):
        read_protocol(tmp_path)


def test_damaged_and_mismatched_files_are_reported(tmp_path):
    folder, offsets = stored(tmp_path)
    write_offsets(folder, "top", offsets, {})
    motion = load_motion("walk")
    with pytest.raises(FormatError, match="its motion isn't the one"):
        write_action(folder, dataclasses.replace(motion, fps=60.0), "train")
    with pytest.raises(FormatError, match="stored as 'train', now 'test'"):
        write_action(folder, motion, "test")
    write_action(folder, motion, "train")
    sheet = square_sheet(9)
    vertices, faces = np.asarray(sheet.mesh.vertices), np.asarray(sheet.mesh.faces)
    write_garment(tmp_path, "top", vertices, faces)
    with pytest.raises(FormatError, match="another garment"):
        write_garment(tmp_path, "top", 1.1 * vertices, faces)
    with pytest.raises(FormatError, match="32,767"):
        write_garment(tmp_path, "big", np.zeros((40_000, 3), np.float32), faces)
    note = folder / "top" / "zarr.json"
    text = note.read_text()
    for broken in (text[: len(text) // 2], "{}", "[]"):
        note.write_text(broken)
        with pytest.raises(FormatError, match=r"damaged .* build the dataset again"):
            read_sequence(folder)
    note.write_text(text)
    chunk = next(p for p in (folder / "top").rglob("*") if p.is_file() and p.name != "zarr.json")
    whole = chunk.read_bytes()
    chunk.write_bytes(whole[: len(whole) // 2])
    with pytest.raises(FormatError, match="damaged"):
        read_sequence(folder)
    chunk.write_bytes(whole)
    (folder / "action.json").write_text("{")
    with pytest.raises(FormatError, match="damaged"):
        list_sequences(tmp_path, "train")


def test_actions_that_exceed_their_clip_are_refused(tmp_path):
    save_motion(tmp_path / "a.npz", load_motion("walk", fps=30))  # four seconds
    action = Action("train", "walk", "a.npz", 2.0, 60, None)
    assert load_action(tmp_path, action).num_frames == 60
    for wrong in ({"frames": 61}, {"start": 2.1}, {"start": -0.1}, {"start": float("nan")}):
        with pytest.raises(MotionError, match=r"a\.npz: walk goes from .* Correct the table"):
            load_action(tmp_path, dataclasses.replace(action, **wrong))


@pytest.mark.release
def test_exploded_simulation_does_not_stop_a_build(tmp_path, monkeypatch):
    sheet = template("top")
    motion = load_motion("walk", fps=30)
    clip = dataclasses.replace(motion, rotations=motion.rotations[:3], root=motion.root[:3])
    monkeypatch.setattr(_build, "action_motion", lambda *a: clip)
    lost = np.full((3, sheet.num_vertices, 3), np.nan, np.float32)
    told = {"finite": np.zeros(3), "speed_max": np.full(3, np.nan), "self_gap": np.full(3, np.inf)}
    rollout = Rollout((lost,), 30.0, told | {"strain_max": np.array([0.1, 0.2, 0.3])})
    monkeypatch.setattr(_build, "simulate_batch", lambda *a, **k: [rollout])
    action = Action("train", "walk", "a.npz", 0.0, 3, None)
    config = DatasetConfig(templates=("top",))
    _build._simulate(config, tmp_path, _build._Clothes("top"), ((action,),), tmp_path)
    meta = read_sequence(tmp_path / "walk").meta["top"]
    assert not meta["finite"] and not usable_garment(meta)
    assert meta["worst"] == {"strain_max": pytest.approx(0.3)}


def test_action_begins_at_its_start_time(tmp_path):
    walk = load_motion("walk", fps=30)
    save_motion(tmp_path / "a.npz", walk)
    got = load_action(tmp_path, Action("train", "walk", "a.npz", 1.0, 30, None))
    np.testing.assert_allclose(got.root, walk.root[30:60], atol=1e-5)
    np.testing.assert_allclose(got.rotations, walk.rotations[30:60], atol=1e-5)
    assert got.name == "walk"


def test_shards_partition_the_actions(data_dir, tmp_path, monkeypatch):
    done = []

    def note(config, root, name, groups, *_):
        done.extend(a.name for group in groups for a in group)
        return []

    monkeypatch.setattr(_build, "_simulate", note)
    config = DatasetConfig(splits=("train",), templates=("bottom",))
    names = [a.name for a in read_protocol(data_dir / "mocap") if a.split == "train"]
    parts = []
    for k in range(3):
        done.clear()
        count = build_dataset(config, tmp_path, data_dir / "mocap", shard=(k, 3))
        assert count == len(done) > 5
        parts += done
    assert parts == names
    # Side by side: of similar length, all of them once.
    done.clear()
    grouped = dataclasses.replace(config, people=4)
    sizes = {a.name: a.frames for a in read_protocol(data_dir / "mocap")}
    build_dataset(grouped, tmp_path / "grouped", data_dir / "mocap")
    assert sorted(done) == sorted(names)
    assert [sizes[n] for n in done] == sorted(sizes[n] for n in names)
    with pytest.raises(FormatError, match="another configuration"):
        build_dataset(config, tmp_path / "grouped", data_dir / "mocap")


def test_people_side_by_side_need_this_simulator():
    with pytest.raises(ValueError, match="takes 1"):
        DatasetConfig(engine="blender", people=2)


def test_parts_of_urls_are_joined_and_named():
    assert last_name("s3://a/b/run/") == last_name("file:///a/|ocdbt:run") == "run"
    assert join("a/b", "c", "d") == "a/b/c/d"
