"""Datasets of outfits: who wears what, and what is read again."""

import dataclasses

import numpy as np
import pytest

from physxnet_jax.body import load_body
from physxnet_jax.data import (
    DatasetConfig,
    Outfit,
    _build,
    build_dataset,
    expected_frames,
    list_entries,
    mirrored_sequence,
    read_entry,
)
from physxnet_jax.errors import PhysXNetError
from physxnet_jax.simulation import XPBD

PAIR = Outfit(wear=("trousers", "tee:ease=0.2"), shape=("weight_up=0.5",))
ALONE = Outfit(wear=("strapless:fabric=silk",))


@pytest.fixture(scope="module")
def mocap(tmp_path_factory, write_mocap):
    actions = [("train", f"part {k}", 0.2 * k, 4 + k) for k in range(4)]
    return write_mocap(tmp_path_factory.mktemp("mocap"), 40, actions)


@pytest.mark.nightly
def test_garments_are_cut_for_the_person():
    garments = PAIR.garments()
    assert list(garments) == ["bottom", "top"], "innermost first"
    assert garments["top"].name == "tee"
    assert float(PAIR.params()[1]) == 0.5
    same = dataclasses.replace(PAIR, shape=()).garments()["top"]
    assert same.num_vertices == garments["top"].num_vertices
    assert np.abs(np.asarray(same.offset - garments["top"].offset)).max() > 1e-4


@pytest.mark.release
@pytest.mark.parametrize(
    ("words", "says"),
    [
        ({"wear": ()}, "no garment"),
        ({"wear": ("coat.obj",)}, "the tailor makes no"),
        ({"wear": ("tee",), "shape": ("tall",)}, "expected name=value"),
    ],
)
def test_outfits_that_cannot_be_are_refused(words, says):
    with pytest.raises(ValueError, match=says):
        Outfit(**words)
    with pytest.raises(PhysXNetError, match="two garments of the template 'top'"):
        Outfit(wear=("tee", "loose")).garments()
    for more in ({"engine": "blender"}, {"templates": ("top",)}, {"outfits_each": 3}):
        with pytest.raises(ValueError, match="outfits"):
            DatasetConfig(outfits=(PAIR, ALONE), **more)


@pytest.mark.release
def test_every_action_has_its_share_of_the_outfits(mocap, tmp_path, monkeypatch):
    done = []

    def note(config, root, clothes, groups, *_):
        done.extend((a.name, clothes.number) for group in groups for a in group)
        return []

    monkeypatch.setattr(_build, "_simulate", note)
    config = DatasetConfig(
        splits=("train",), outfits=(PAIR, ALONE, PAIR), outfits_each=2, first_outfit=1
    )
    assert build_dataset(config, tmp_path, mocap) == 8
    wanted = [(f"part {k}", (1 + 2 * k + j) % 3) for k in range(4) for j in range(2)]
    assert sorted(done) == sorted(wanted)
    frames = expected_frames(tmp_path, mocap)
    assert frames == {f"{name} #{number:02d}": 4 + int(name[-1]) for name, number in wanted}
    done.clear()
    build_dataset(config, tmp_path, mocap, only=("part 2",))
    assert sorted(done) == sorted(w for w in wanted if w[0] == "part 2"), "as without only"


@pytest.mark.nightly
def test_outfits_are_stored_and_read_again(mocap, tmp_path):
    config = DatasetConfig(
        splits=("train",), outfits=(PAIR, ALONE), outfits_each=1, people=2, solver=XPBD(64, 1)
    )
    assert build_dataset(config, tmp_path, mocap) == 4
    assert build_dataset(config, tmp_path, mocap) == 0
    entries = list_entries(tmp_path)
    assert [e.name for e in entries] == ["part 0 #00", "part 1 #01", "part 2 #00", "part 3 #01"]
    assert [e.action for e in entries] == [f"part {k}" for k in range(4)]
    assert [e.outfit for e in entries] == [PAIR, ALONE, PAIR, ALONE]
    read = entries[2].read()
    assert dataclasses.replace(read_entry(read), source="") == dataclasses.replace(
        entries[2], source=""
    )
    assert {t: x.shape[:2] for t, x in read.offsets.items()} == {
        t: (6, g.num_vertices) for t, g in PAIR.garments().items()
    }
    assert all(0.0 < np.abs(x).max() < 0.5 for x in read.offsets.values())
    assert read.garment("top") is PAIR.garments()["top"]
    back = mirrored_sequence(load_body(), mirrored_sequence(load_body(), read))
    for name, offsets in read.offsets.items():
        # Single vertices of this body are 3 mm from the mirror images of others.
        gap = np.linalg.norm(back.offsets[name] - offsets, axis=2)
        assert np.quantile(gap, 0.99) < 1e-5 and gap.max() < 1e-2
