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
