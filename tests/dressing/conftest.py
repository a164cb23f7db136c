import jax.numpy as jnp
import numpy as np
import pytest

from physxnet_jax.dressing import make_dresser
from physxnet_jax.motion import load_motion


@pytest.fixture(scope="module")
def motion():
    """Six frames of a punch: rotations and root."""
    m = load_motion("punch", fps=30.0)
    return m.rotations[8:14], m.root[8:14]


@pytest.fixture(scope="module")
def dresser():
    return make_dresser(["bottom"])


@pytest.fixture(scope="session")
def slope_error():
    """A measure of gradients of simulated cloth, which is a function with steps.

    Between two samples a contact may begin or end, and the last bits of a machine decide where.
    So the nearest of three differences counts, and the median of the places given.
    """

    def measure(function, gradient, places, steps):
        """Largest relative error over the arguments; `places` is (n, arguments)."""
        off = []
        for a in np.asarray(places):
            found = np.asarray(gradient(jnp.asarray(a)))
            assert np.isfinite(found).all() and found.all()
            for slope, way in zip(found, np.eye(len(a)), strict=True):
                off.append(
                    min(
                        abs(
                            (
                                float(function(jnp.asarray(a + step * way)))
                                - float(function(jnp.asarray(a - step * way)))
                            )
                            / (2.0 * step * slope)
                            - 1.0
                        )
                        for step in steps
                    )
                )
        return np.median(np.reshape(off, np.shape(places)), axis=0).max()

    return measure
