"""Every hard case of `physxnet stress`, one test each, and controls that bounds can fail."""

import numpy as np
import pytest

from physxnet_jax.evaluation import CASES, Finding, run_case
from physxnet_jax.garment import Fabric, square_sheet
from physxnet_jax.simulation import Scene, Stretch, Verlet, prepare_scene, simulate_still


@pytest.mark.parametrize("name", CASES)
def test_case(name):
    for finding in run_case(name):
        assert finding.holds, finding


def test_a_bound_can_fail_and_a_nan_always_does():
    assert Finding("x", "y", 1.0, 1.0).holds
    assert not Finding("x", "y", 1.0, 1.1).holds
    assert not Finding("x", "y", 1.0, float("nan")).holds


def test_an_explicit_method_does_explode_where_the_default_holds():
    """The control for stiffness: Verlet beyond its limit, on the sheet of the case."""
    g = square_sheet(5, fabric=Fabric(stretch=1e6))
    scene = prepare_scene(Scene((g,), (Stretch(),)))
    start = np.asarray(g.mesh.vertices) * [1.01, 1.0, 1.0]
    out = simulate_still(scene, 5, solver=Verlet(32, 1, "float32"), start=start)
    assert out.status.any()
