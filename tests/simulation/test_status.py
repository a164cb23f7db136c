"""Status flags: single vertices don't raise them, many do, and each says what to do."""

import numpy as np
import pytest

from physxnet_jax.garment import square_sheet
from physxnet_jax.simulation import (
    XPBD,
    Rollout,
    Scene,
    Status,
    prepare_scene,
    settle_on_static_body,
)
from physxnet_jax.simulation.effects import Bend, Stretch

QUIET = {
    "finite": 1.0,
    "residual_p99": 0.5,
    "strain_p99": 0.2,
    "strain_max": 3.0,
    "penetration_max": 0.002,
    "missed": 15.0,
    "pinched": 15.0,
    "speed_max": 5.0,
    "layers_crossed": 4.0,
    "overflow": 0.0,
}


def status(**changes):
    values = {k: np.asarray([v]) for k, v in (QUIET | changes).items()}
    return int(Rollout((np.zeros((1, 1000, 3)),), 30.0, values).status[0])


def test_a_few_stretched_or_pinched_places_raise_nothing():
    assert status() == 0


@pytest.mark.parametrize(
    ("flag", "change"),
    [
        (Status.NONFINITE, {"finite": 0.0}),
        (Status.UNCONVERGED, {"residual_p99": 1.5}),
        (Status.STRAINED, {"strain_p99": 0.6}),
        (Status.INSIDE, {"penetration_max": 0.02}),
        (Status.MISSED, {"missed": 25.0}),
        (Status.FAST, {"speed_max": 80.0}),
        (Status.PINCHED, {"pinched": 25.0}),
        (Status.CROSSED, {"layers_crossed": 6.0}),
        (Status.OVERFLOW, {"overflow": 1.0}),
        (Status.COLLAPSED, {"collapsed": 0.2}),
        (Status.STRAINED, {"strain_p99": float("nan")}),
    ],
)
def test_each_flag_is_raised_by_its_own_quantity(flag, change):
    assert status(**change) == int(flag)


def test_every_flag_says_what_to_do():
    assert all(len(flag.advice) > 10 for flag in Status)
    assert (Status.FAST | Status.INSIDE).advice == ""


def test_a_sheet_that_has_collapsed_to_a_point_is_flagged():
    """Its edges have no direction in which they could grow; beside it one that has."""
    sheet = square_sheet(7)
    scene = prepare_scene(Scene((sheet,), (Stretch(), Bend())))
    point = np.repeat(np.asarray(sheet.mesh.vertices)[:1], 49, axis=0)
    noise = 1e-4 * np.random.default_rng(0).normal(size=point.shape)
    found = [
        settle_on_static_body(scene, 12, solver=XPBD(32, 1), start=start).status
        for start in (point, point + noise)
    ]
    assert all(s & Status.COLLAPSED for s in found[0])
    assert not found[1][-1] & Status.COLLAPSED
