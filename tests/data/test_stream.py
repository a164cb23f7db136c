"""Batches depend on seed and step alone, and memory doesn't grow with the dataset."""

import dataclasses
import itertools
import tracemalloc

import numpy as np
import pytest

from physxnet_jax.data import (
    Entry,
    Frames,
    FrameStream,
    Sequence,
    dataset_digest,
    list_entries,
    read_entry,
    write_action,
)
from physxnet_jax.data._store import remove_index, write_garment, write_offsets
from physxnet_jax.data._stream import index_dataset
from physxnet_jax.errors import FormatError
from physxnet_jax.garment import template
from physxnet_jax.motion import load_motion
from physxnet_jax.training import TrainConfig
from physxnet_jax.training._data import load_data


@dataclasses.dataclass(frozen=True)
class _Numbers(Sequence):
    """An action whose frames are numbered."""

    numbers: np.ndarray = dataclasses.field(default_factory=lambda: np.zeros(0))


def stream(lengths, *, capacity, batch=8, seed=3, mirrored=False, reads=None):
    """Frames numbered through all actions; mirror images have negative numbers."""
    entries, begin = [], 1
    for k, n in enumerate(lengths):
        motion = load_motion("walk")
        s = _Numbers(f"a{k}", "train", motion, {}, {}, numbers=np.arange(begin, begin + n))
        entries.append(Entry(s.name, s.name, "train", n, 30.0, "", s))
        begin += n
    if mirrored:
        entries += [dataclasses.replace(e, mirrored=True) for e in entries]

    def load(sequences):
        found = [s.numbers for s in sequences]
        if reads is not None:
            reads.append(sum(map(len, found)))
        x = np.concatenate(found).astype(np.float32)
        windows = np.broadcast_to(x[:, None, None, None, None], (len(x), 1, 1, 3, 3))
        return Frames(windows, windows[..., 0], {}, {}, 30.0)

    def mirror(s):
        return dataclasses.replace(s, numbers=-s.numbers)

    return FrameStream(entries, load, mirror, batch=batch, seed=seed, capacity=capacity)


def numbers(made, start, count, rows=slice(None)):
    batches = made.batches(start, rows)
    try:
        taken = itertools.islice(batches, count)
        return np.stack([b["rotations"][:, 0, 0, 0, 0] for b in taken]).astype(int)
    finally:
        batches.close()


@pytest.mark.parametrize("capacity", [1000, 32])
def test_an_epoch_has_every_frame_once(capacity):
    made = stream([8, 16, 8, 8], capacity=capacity)
    assert len(made) == 40 and made.steps_per_epoch == 5
    epochs = numbers(made, 0, 10).reshape(2, 40)
    for epoch in epochs:
        assert sorted(epoch) == list(range(1, 41))
    assert not np.array_equal(*epochs)
    other = stream([8, 16, 8, 8], capacity=capacity, seed=4)
    assert not np.array_equal(epochs[0], numbers(other, 0, 5).ravel())


@pytest.mark.parametrize("capacity", [1000, 24])
@pytest.mark.parametrize("lengths", [[10, 7, 5, 12, 7], [3, 1], [9]])
def test_an_epoch_leaves_out_less_than_a_batch_of_each_group(lengths, capacity):
    made = stream(lengths, capacity=capacity)
    steps = made.steps_per_epoch
    seen = numbers(made, 0, 12 * steps)
    groups = 1 if capacity == 1000 else len(lengths)
    assert len(set(seen[:steps].ravel())) > sum(lengths) - 8 * groups
    assert set(seen.ravel()) == set(range(1, sum(lengths) + 1)), "sooner or later all are seen"


@pytest.mark.release
@pytest.mark.parametrize("capacity", [1000, 24])
def test_batches_depend_on_the_step_alone(capacity):
    whole = numbers(stream([10, 7, 5, 12, 6], capacity=capacity, mirrored=True), 0, 25)
    for start in (3, 10, 17):
        again = stream([10, 7, 5, 12, 6], capacity=capacity, mirrored=True)
        np.testing.assert_array_equal(numbers(again, start, 5), whole[start : start + 5])
    halves = [
        numbers(stream([10, 7, 5, 12, 6], capacity=capacity, mirrored=True), 0, 25, rows)
        for rows in (slice(0, 4), slice(4, 8))
    ]
    np.testing.assert_array_equal(np.concatenate(halves, axis=1), whole)
    assert 0.3 < (whole[:10] < 0).mean() < 0.7


def test_what_fits_is_read_once_and_what_does_not_in_parts():
    reads: list[int] = []
    made = stream([10] * 8, capacity=80, reads=reads)
    made.first()
    numbers(made, 0, 30)
    assert reads == [80]
    reads.clear()
    made = stream([10] * 8, capacity=40, reads=reads)
    numbers(made, 0, 20)
    assert max(reads) == 20 and sum(reads) >= 160


@pytest.mark.release
@pytest.mark.parametrize("capacity", [1000, 80])
def test_a_process_reads_the_actions_of_its_own_rows(capacity):
    reads: list[int] = []
    made = stream([10] * 16, capacity=capacity, reads=reads)
    whole = numbers(made, 0, 40)
    everything = sum(reads)
    reads.clear()
    made = stream([10] * 16, capacity=capacity, reads=reads)
    own = numbers(made, 0, 40, slice(2, 4))
    np.testing.assert_array_equal(own, whole[:, 2:4])
    assert sum(reads) == everything // 4


def test_frames_of_a_group_are_mixed():
    """Neighbours in time don't stay neighbours in a batch."""
    order = numbers(stream([30] * 10, capacity=120, batch=10), 0, 30).ravel()
    assert np.mean(np.abs(np.diff(order)) == 1) < 0.1


def test_errors_of_the_reader_are_raised_where_the_batch_is_used():
    made = stream([10], capacity=100)
    made._load = lambda sequences: (_ for _ in ()).throw(FormatError("damaged"))
    batches = made.batches(0, slice(None))
    with pytest.raises(FormatError, match="damaged"):
        next(batches)
    batches.close()
    assert not batches._thread.is_alive()


def test_actions_of_other_rates_and_none_are_refused():
    made = stream([3], capacity=9)._entries[0]
    two = [made, dataclasses.replace(made, fps=60.0)]
    for entries, says in (([], "no sequence"), (two, "different frame rates")):
        with pytest.raises(FormatError, match=says):
            FrameStream(entries, lambda s: s, lambda s: s, batch=1, seed=0, capacity=1)


def test_entries_of_stored_actions_are_those_of_actions_in_memory(tmp_path):
    garment, motion = template("bottom"), load_motion("walk", fps=30.0)
    write_garment(
        tmp_path, "bottom", np.asarray(garment.mesh.vertices), np.asarray(garment.mesh.faces)
    )
    write_action(tmp_path / "walk", motion, "train")
    offsets = np.zeros((motion.num_frames, garment.num_vertices, 3), np.float32)
    write_offsets(tmp_path / "walk", "bottom", offsets, {"finite": True, "worst": {}})
    stored = read_entry(str(tmp_path / "walk"))
    whole = stored.read()
    assert dataclasses.replace(read_entry(whole), source="") == dataclasses.replace(
        stored, source=""
    )


@pytest.mark.nightly
def test_memory_does_not_grow_with_the_dataset(tmp_path):
    garment, clip = template("bottom"), load_motion("walk", fps=30.0)
    motion = dataclasses.replace(clip, rotations=clip.rotations[:40], root=clip.root[:40])
    write_garment(
        tmp_path, "bottom", np.asarray(garment.mesh.vertices), np.asarray(garment.mesh.faces)
    )
    for k in range(16):
        write_action(tmp_path / f"a{k}", motion, "train")
        rng = np.random.default_rng(k)
        offsets = rng.normal(0, 1e-3, (40, garment.num_vertices, 3)).astype(np.float32)
        meta = {"finite": True, "worst": {}}
        write_offsets(tmp_path / f"a{k}", "bottom", offsets, meta)
    peaks = {}
    for count, capacity in ((4, 80), (16, 80), (16, 10_000)):
        config = TrainConfig(batch=8, frames_in_memory=capacity)
        config = dataclasses.replace(
            config, model=dataclasses.replace(config.model, resolution=32, templates=("bottom",))
        )
        tracemalloc.start()
        data = load_data(config, [tmp_path / f"a{k}" for k in range(count)])
        batches = data.frames.batches(0, slice(None))
        for _ in range(data.frames.steps_per_epoch):
            next(batches)
        batches.close()
        peaks[count, capacity] = tracemalloc.get_traced_memory()[1] / 1e6
        tracemalloc.stop()
    assert peaks[16, 80] < 1.1 * peaks[4, 80]
    # The control: all of them in memory, with two bytes a coordinate.
    held = 2e-6 * 16 * 40 * garment.num_vertices * 3
    assert peaks[16, 10_000] > peaks[16, 80] + 0.5 * held


def test_index_lists_what_the_actions_say(tmp_path):
    garment, motion = template("bottom"), load_motion("walk", fps=30.0)
    write_garment(
        tmp_path, "bottom", np.asarray(garment.mesh.vertices), np.asarray(garment.mesh.faces)
    )
    offsets = np.zeros((motion.num_frames, garment.num_vertices, 3), np.float32)
    for name, split in (("walk", "train"), ("other", "test")):
        write_action(tmp_path / name, dataclasses.replace(motion, name=name), split)
        write_offsets(tmp_path / name, "bottom", offsets, {"finite": True, "worst": {}})
    looked = list_entries(tmp_path)
    before = dataset_digest(tmp_path)
    index_dataset(tmp_path)
    assert list_entries(tmp_path) == looked and [e.name for e in looked] == ["other", "walk"]
    assert [e.name for e in list_entries(tmp_path, "train")] == ["walk"]
    assert dataset_digest(tmp_path) == before
    for text in ("[3]", '[{"folder": "walk"}]'):
        (tmp_path / "index.json").write_text(text)
        with pytest.raises(FormatError, match="damaged"):
            list_entries(tmp_path)
    remove_index(tmp_path)
    remove_index(tmp_path)
    assert list_entries(tmp_path) == looked
