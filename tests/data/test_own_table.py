"""A table of one's own motions, written for a folder and read as the protocol is."""

import csv

import pytest

from physxnet_jax.data import read_protocol, write_protocol
from physxnet_jax.errors import MotionError
from physxnet_jax.motion import load_motion, save_motion


def test_a_table_is_written_for_a_folder_of_motions(tmp_path):
    walk = load_motion("walk", fps=60.0)
    (tmp_path / "deep").mkdir()
    for k in range(6):
        save_motion(tmp_path / f"my-walk_{k}.npz", walk[: 20 + 2 * k])
    save_motion(tmp_path / "deep" / "my walk 0.npz", walk)
    (tmp_path / "notes.txt").write_text("no motion")
    (tmp_path / "broken.bvh").write_text("HIERARCHY")
    path, unread = write_protocol(tmp_path)
    assert path.name == "ACTIONS.csv" and len(unread) == 1 and "broken.bvh" in unread[0]
    actions = read_protocol(tmp_path)
    assert len(actions) == 7 and len({a.slug for a in actions}) == 7
    assert [a.split for a in actions].count("test") == 1
    by_file = {a.file: a for a in actions}
    assert by_file["my-walk_2.npz"].frames == 12, "at 30 a second"
    assert "deep/my walk 0.npz" in by_file
    with path.open() as file:
        assert next(csv.reader(file))[:3] == ["split", "action", "file"]
    with pytest.raises(MotionError, match="exists already"):
        write_protocol(tmp_path)


def test_a_few_files_have_a_test_action_too(tmp_path):
    walk = load_motion("walk")
    for name, splits in (("a", ["train"]), ("b", ["train", "test"])):
        save_motion(tmp_path / f"{name}.npz", walk[:20])
        (tmp_path / "ACTIONS.csv").unlink(missing_ok=True)
        write_protocol(tmp_path)
        assert [a.split for a in read_protocol(tmp_path)] == splits


def test_a_folder_without_motions_is_refused(tmp_path):
    with pytest.raises(MotionError, match="no motion that can be read"):
        write_protocol(tmp_path)
    assert not (tmp_path / "ACTIONS.csv").exists()
