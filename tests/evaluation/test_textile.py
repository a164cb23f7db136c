"""Fabrics behave as laboratories measure them."""

import dataclasses

import pytest

from physxnet_jax.evaluation import DRAPE_BANDS, cantilever_test, drape_test
from physxnet_jax.garment import FABRICS

# Coarser than the default, for time.
EDGE = 0.011


@pytest.mark.nightly
def test_drape_coefficients_are_in_their_published_ranges():
    drapes = {name: drape_test(fabric) for name, fabric in FABRICS.items()}
    for name, drape in drapes.items():
        low, high, _ = DRAPE_BANDS[name]
        assert low <= drape.coefficient <= high, name
        assert drape.folds >= 3, "a disc that bends in one direction only isn't cloth"
        assert drape.speed < 0.3, "nearly at rest"
    # The cloth decides the number of folds, not the mesh; limp cloth has more than stiff cloth.
    assert drapes["denim"].folds < drapes["silk"].folds


@pytest.mark.nightly
def test_stiff_fabric_stays_flat_and_limp_fabric_hangs_down():
    """The controls: the instrument's two ends."""
    stiff = dataclasses.replace(FABRICS["cotton"], bend=1e-2)
    assert drape_test(stiff, edge=EDGE, seconds=1.0).coefficient > 97
    limp = dataclasses.replace(FABRICS["cotton"], bend=4e-6)
    assert drape_test(limp, edge=EDGE, seconds=4.0).coefficient < 40


@pytest.mark.nightly
def test_cantilever_measures_the_bending_length():
    cotton = cantilever_test(FABRICS["cotton"], cells=16)
    assert cotton.measured == pytest.approx(cotton.length, rel=0.05)
    # A strip eight times as stiff has twice the bending length, not the same.
    stiff = dataclasses.replace(FABRICS["cotton"], bend=8 * FABRICS["cotton"].bend)
    assert cantilever_test(stiff, cells=16).measured == pytest.approx(2 * cotton.measured, rel=0.05)
