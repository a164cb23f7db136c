"""Objects of wrong types give this package's errors, without the types that tests check."""

import subprocess
import sys

import pytest

from physxnet_jax.errors import PhysXNetError, check_type

CODE = """
import jax
import numpy as np
import physxnet_jax as px

walk, top = px.load_motion("walk"), px.template("top")
bare = px.make_dresser(["top"], method="lbs")
# Poses may be arrays of NumPy, also where others are traced.
root = np.asarray(walk.root[:1])
jax.jit(lambda q: px.clothe(bare, q, root, 30.0)["top"])(np.asarray(walk.rotations[:1]))
for call in (
    lambda: px.load_motion(5),
    lambda: px.dress(np.zeros((3, 31, 4)), ["top"]),
    lambda: px.simulate("walk", walk),
    lambda: px.simulate([top], walk),
    lambda: px.simulate(px.Scene((top,)), "walk"),
    lambda: px.simulate(px.Scene(top), walk),
    lambda: px.simulate(px.Scene(("top",)), walk),
    lambda: px.dress("walk", ["top"], frames="3"),
    lambda: px.dress("walk", ["top"], start="1"),
    lambda: px.make_dresser(["top"], method="simulate"),
    lambda: px.make_dresser(["top"], precision="float64"),
    lambda: px.Simulation(engine="bdf"),
    lambda: px.Simulation(substeps=1.5),
    lambda: px.Simulation(wind=3.0),
    lambda: px.Simulation(floor="low"),
    lambda: px.Simulation(self_contact="no"),
    lambda: px.Inference(tta="no"),
    lambda: px.clothe(bare, walk.rotations, walk.root, "30"),
    lambda: px.simulate(px.Scene((top,)), px.Motion(walk.rotations, walk.root[:3], 30.0)),
    lambda: px.simulate(px.Scene((top,)), px.Motion(0 * walk.rotations, walk.root, 30.0)),
    lambda: px.simulate(px.Scene((top,)), px.Motion(walk.rotations, walk.root, -30.0)),
    lambda: px.simulate(px.Scene((top,), shape=np.full(9, 5.0)), walk),
):
    try:
        call()
    except px.PhysXNetError as error:
        print(error)
"""


@pytest.mark.release
def test_errors_say_what_to_pass():
    done = subprocess.run([sys.executable, "-c", CODE], capture_output=True, text=True, timeout=300)
    lines = done.stdout.splitlines()
    assert done.returncode == 0 and len(lines) == 22, done.stdout + done.stderr[-2000:]
    advice = ["A motion is", "A motion is", "a Scene", "a Scene", "a Motion", "a tuple", "garments"]
    advice += ["a whole number", "a number of seconds"]
    advice += ["No method", "No precision", "No engine", "substeps is 1.5", "wind is 3.0"]
    advice += ["height is 'low'", "self_contact is 'no'", "tta is 'no'", "fps is '30'"]
    advice += ["3 places of the root"]
    advice += ["no rotation", "fps is -30.0", "limits"]
    assert all(some in line for some, line in zip(advice, lines, strict=True))


def test_what_is_given_is_named():
    check_type("walk", str, "Pass a name.")
    with pytest.raises(PhysXNetError, match=r"an object of list\. Pass a name\."):
        check_type([], str, "Pass a name.")
    with pytest.raises(PhysXNetError, match=r"This is 'walk'\. Pass a number\."):
        check_type("walk", (int, float), "Pass a number.")
