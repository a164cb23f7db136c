"""Datasets: quantised to 0.05 mm, whole or absent, resumed."""

import numpy as np
import pytest

from physxnet_jax.data import (
    build_dataset,
    list_sequences,
    read_protocol,
    read_sequence,
    write_action,
    write_offsets,
)
from physxnet_jax.errors import FormatError, MotionError
from physxnet_jax.motion import load_motion
from physxnet_jax.simulation import XPBD


def test_offsets_round_trip_within_a_twentieth_of_a_millimetre(tmp_path):
    folder = tmp_path / "walk"
    write_action(folder, load_motion("walk"), "train")
    offsets = np.random.default_rng(0).normal(0, 0.1, (70, 9, 3)).astype(np.float32)
    write_offsets(folder, "top", offsets, {"finite": True})
    s = read_sequence(folder)
    assert np.abs(s.offsets["top"] - offsets).max() <= 0.5001e-4 + 1e-7
    assert s.split == "train" and s.meta["top"]["finite"] and s.motion.num_frames == 120
    assert list_sequences(tmp_path, "train") == [folder] and not list_sequences(tmp_path, "test")


def test_explosions_are_refused_and_leave_nothing(tmp_path):
    folder = tmp_path / "walk"
    write_action(folder, load_motion("walk"), "train")
    for bad in (np.full((2, 3, 3), 9.0), np.full((2, 3, 3), np.nan)):
        with pytest.raises(FormatError, match=r"3\.2 m"):
            write_offsets(folder, "top", bad, {})
    assert not read_sequence(folder).offsets
    with pytest.raises(FormatError, match=r"action\.json"):
        read_sequence(tmp_path)


def test_a_build_goes_on_where_it_was(data_dir, tmp_path):
    actions = [a for a in read_protocol(data_dir / "mocap") if a.name == "run"]
    run = dict(templates=("bottom",), solver=XPBD(8, 1))
    assert build_dataset(tmp_path, data_dir / "mocap", actions, **run) == 1
    assert build_dataset(tmp_path, data_dir / "mocap", actions, **run) == 0
    s = read_sequence(tmp_path / "run")
    assert s.offsets["bottom"].shape == (34, 2726, 3)


def test_a_missing_protocol_is_named(tmp_path):
    with pytest.raises(MotionError, match=r"ACTIONS\.csv"):
        read_protocol(tmp_path)
