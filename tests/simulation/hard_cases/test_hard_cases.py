"""Every hard case of `physxnet stress`, one test each, and controls that bounds can fail."""

import numpy as np
import pytest

from physxnet_jax.evaluation import CASES, Finding, run_case
from physxnet_jax.garment import Fabric, square_sheet
from physxnet_jax.simulation import Scene, Verlet, prepare_scene, settle_on_static_body
from physxnet_jax.simulation.effects import Stretch


@pytest.mark.release
@pytest.mark.parametrize("name", CASES)
def test_hard_case_findings_hold(name):
    for finding in run_case(name):
        assert finding.holds, finding


def test_findings_fail_above_the_bound_and_for_nan():
    assert Finding("x", "y", 1.0, 1.0).holds
    assert not Finding("x", "y", 1.0, 1.1).holds
    assert not Finding("x", "y", 1.0, float("nan")).holds


def test_explicit_solver_explodes_on_a_stiff_sheet():
    """The control for stiffness: Verlet beyond its limit, on the sheet of the case."""
    g = square_sheet(5, fabric=Fabric(stretch=1e6))
    scene = prepare_scene(Scene((g,), (Stretch(),)))
    start = np.asarray(g.mesh.vertices) * [1.01, 1.0, 1.0]
    out = settle_on_static_body(scene, 5, solver=Verlet(32, 1, "float32"), start=start)
    assert out.status.any()
