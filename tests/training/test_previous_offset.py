"""What a network with a memory is told of comes from its own clip, and from before."""

import pathlib
import runpy

import numpy as np
from hypothesis import given, settings, strategies as st

MADE = runpy.run_path(str(pathlib.Path(__file__).parents[2] / "experiments/previous_offset.py"))


@settings(deadline=None)
@given(st.lists(st.integers(1, 30), min_size=1, max_size=5), st.integers(0, 12))
def test_what_was_before_lies_in_the_same_clip(lengths, frames):
    clip = np.repeat(np.arange(len(lengths)), lengths)
    first = np.repeat(np.cumsum([0, *lengths[:-1]]), lengths)
    index = np.arange(sum(lengths))
    at, known = MADE["earlier"](index, first, frames)
    assert (clip[at] == clip).all()
    assert (at[known > 0] == index[known > 0] - frames).all()
    assert known.sum() == sum(max(n - frames, 0) for n in lengths)
