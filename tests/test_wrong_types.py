"""Objects of wrong types give this package's errors, without the types that tests check."""

import subprocess
import sys

import pytest

from physxnet_jax.errors import PhysXNetError, check_type

CODE = """
import numpy as np
import physxnet_jax as px

walk, top = px.load_motion("walk"), px.template("top")
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
    assert done.returncode == 0 and len(lines) == 9, done.stdout + done.stderr[-2000:]
    advice = ["A motion is", "A motion is", "a Scene", "a Scene", "a Motion", "a tuple", "garments"]
    advice += ["a whole number", "a number of seconds"]
    assert all(some in line for some, line in zip(advice, lines, strict=True))


def test_what_is_given_is_named():
    check_type("walk", str, "Pass a name.")
    with pytest.raises(PhysXNetError, match=r"an object of list\. Pass a name\."):
        check_type([], str, "Pass a name.")
    with pytest.raises(PhysXNetError, match=r"This is 'walk'\. Pass a number\."):
        check_type("walk", (int, float), "Pass a number.")
