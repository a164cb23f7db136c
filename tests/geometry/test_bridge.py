"""Hollows are bridged: grooves of tubes, and nothing else."""

import hypothesis
import numpy as np
import pytest
from hypothesis import strategies as st

from physxnet_jax.geometry import bridge_hollows

_AROUND, _UP, _RADIUS, _EDGE = 40, 40, 0.12, 0.01


def tube(radius):
    """A tube along Y, open at both ends, with a radius at each height and angle [m]."""
    angle = np.linspace(0.0, 2.0 * np.pi, _AROUND, endpoint=False)
    height = _EDGE * np.arange(_UP)
    y, a = np.meshgrid(height, angle, indexing="ij")
    r = radius(y, a)
    vertices = np.stack([r * np.sin(a), y, r * np.cos(a)], axis=-1).reshape(-1, 3)
    i, j = np.meshgrid(np.arange(_UP - 1), np.arange(_AROUND), indexing="ij")
    a, b = i * _AROUND + j, i * _AROUND + (j + 1) % _AROUND
    c, d = a + _AROUND, b + _AROUND
    faces = np.stack([a, b, c, b, d, c], axis=-1).reshape(-1, 3).astype(np.int32)
    return vertices.astype(np.float32), faces


def plain(y, a):
    return np.full_like(y, _RADIUS)


def dent(depth, width):
    """A hollow in the front."""

    def radius(y, a):
        angle = np.minimum(a, 2.0 * np.pi - a)
        away = np.hypot(y - 0.2, _RADIUS * angle)
        return _RADIUS - depth * np.exp(-0.5 * (away / width) ** 2)

    return radius


def radii(x):
    return np.hypot(x[:, 0], x[:, 2])


@pytest.mark.parametrize(("depth", "width"), [(0.02, 0.02), (0.04, 0.02), (0.04, 0.03)])
def test_hollow_is_bridged(depth, width):
    made, faces = tube(plain)
    carried, _ = tube(dent(depth, width))
    taut = bridge_hollows(carried, made, faces)
    before, after = (_RADIUS - radii(x).min() for x in (carried, taut))
    assert before > 0.95 * depth and after < 0.5 * before
    # Outwards only, and not out of the tube.
    assert (radii(taut) - radii(carried)).min() > -1e-4
    assert radii(taut).max() < _RADIUS + 1e-3


def test_cloth_without_a_new_hollow_stays_bit_for_bit():
    dented, faces = tube(dent(0.04, 0.02))
    np.testing.assert_array_equal(bridge_hollows(dented, dented, faces), dented)
    made, _ = tube(plain)
    wider = (1.3 * made).astype(np.float32)
    np.testing.assert_array_equal(bridge_hollows(wider, made, faces), wider)


def test_what_may_not_move_stays():
    made, faces = tube(plain)
    carried, _ = tube(dent(0.04, 0.02))
    free = np.arange(len(made)) % 2 == 0
    taut = bridge_hollows(carried, made, faces, free)
    np.testing.assert_array_equal(taut[~free], carried[~free])
    assert (taut[free] != carried[free]).any()


def test_borders_stay_and_what_protrudes_stays():
    made, faces = tube(plain)
    bulged, _ = tube(dent(-0.04, 0.02))
    taut = bridge_hollows(bulged, made, faces)
    top = radii(bulged).argmax()
    np.testing.assert_array_equal(taut[top], bulged[top])
    ends = np.r_[:_AROUND, len(made) - _AROUND : len(made)]
    np.testing.assert_array_equal(taut[ends], bulged[ends])


@hypothesis.given(
    depth=st.floats(0.0, 0.06),
    width=st.floats(0.015, 0.04),
    move=st.tuples(*[st.floats(-2.0, 2.0)] * 3),
)
@hypothesis.settings(max_examples=10)
def test_bridging_moves_with_the_body(depth, width, move):
    made, faces = tube(plain)
    carried, _ = tube(dent(depth, width))
    shift = np.asarray(move, np.float32)
    here = bridge_hollows(carried, made, faces)
    there = bridge_hollows(carried + shift, made, faces)
    np.testing.assert_allclose(there - shift, here, atol=2e-4)
