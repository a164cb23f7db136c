"""Every case of `physxnet stress` breaks a bound when the simulator is given a fault."""

import dataclasses
import math

import jax
import jax.numpy as jnp
import pytest

from physxnet_jax.evaluation import CASES, run_case
from physxnet_jax.simulation import _static_body
from physxnet_jax.simulation.effects import (
    _contact,
    _gravity,
    _layers,
    _pairs,
    _pin,
    _strain_limit,
    _stretch,
)


def idle(self, displacement, *_):
    return displacement


def heavier(self, velocity, context, h):
    return velocity.at[:, 1].add(-1.1 * self.g * h)


def nudging(self, displacement, *_):
    return displacement + 1e-6


def springs_with(change):
    """A fault of `_Stretch.begin`: the springs, or the positions, are others."""
    plain = _stretch._Stretch.begin

    def begin(self, base, *more):
        springs, base = change(self.springs, base)
        return plain(dataclasses.replace(self, springs=springs), base, *more)

    return begin


def longer(springs, base):
    return dataclasses.replace(springs, length=1.01 * springs.length), base


def coarse(springs, base):
    return springs, base.astype(jnp.float16).astype(base.dtype)


def explicit(self, displacement, start, context, progress, step):
    """Forces of springs at the start of a substep, as explicit Euler has them."""
    s, span = self.springs, context[0] + displacement[self.springs.ends[1]]
    span = span - displacement[s.ends[0]]
    length = jnp.sqrt(jnp.sum(span * span, axis=1, keepdims=True) + 1e-18)
    push = step.length**2 * span * ((length - s.length) / (length * s.compliance))
    moved = displacement.at[s.ends[0]].add(s.weight[0] * push)
    return moved.at[s.ends[1]].add(-s.weight[1] * push)


def bare(self, displacement, context):
    """Lengths without a floor, whose slope at zero isn't finite."""
    s, span = self.springs, self._spans(displacement, context)
    excess = jnp.sqrt(jnp.sum(span * span, axis=1, keepdims=True)) - s.length
    return 0.5 * jnp.sum(excess**2 / s.compliance, axis=(0, 1))


FAULTS = {
    "gravity is a tenth stronger": (_gravity._Gravity, "accelerate", heavier),
    "the skin isn't in the way": (_contact._Contact, "project", idle),
    "deep cloth starts where it is": (_static_body, "_out_of_body", lambda _, start: start),
    "contact moves what doesn't touch": (_contact._Contact, "project", nudging),
    "garments pass through each other": (_layers._Layers, "project", idle),
    "cloth passes through itself": (_pairs.ClothContact, "project", idle),
    "pins don't hold": (_pin._Pin, "project", idle),
    "springs are a hundredth longer": (_stretch._Stretch, "begin", springs_with(longer)),
    "springs see rounded positions": (_stretch._Stretch, "begin", springs_with(coarse)),
    "springs are explicit": (_stretch._Stretch, "project", explicit),
    "lengths have no floor": (_stretch._Stretch, "energy", bare),
    "the limit doesn't act": (_strain_limit._StrainLimit, "project", idle),
}
"""What is wrong: a class or module, its function, and what takes its place."""

SKIN = "the skin isn't in the way"
CONTROLS = {
    "free_fall": "gravity is a tenth stronger",
    "hanging_strip": "gravity is a tenth stronger",
    "rotated_rest_state": "springs are a hundredth longer",
    "scrambled_start": "springs are explicit",
    "collapsed_start": "springs are explicit",
    "degenerate_mesh": "springs are explicit",
    "gradients_at_singular_points": "lengths have no floor",
    "stiffness_over_nine_decades": "springs are explicit",
    "masses_over_seven_decades": "springs are explicit",
    "pendulum": "gravity is a tenth stronger",
    "a_fold_lands_on_itself": "cloth passes through itself",
    "layers_in_the_wrong_order": "garments pass through each other",
    "a_step_of_a_second": "springs are explicit",
    "contradicting_pins": "pins don't hold",
    "a_kilometre_from_the_origin": "springs see rounded positions",
    "ten_thousand_steps": "springs are explicit",
    "an_effect_that_touches_nothing": "contact moves what doesn't touch",
    "start_fifty_millimetres_inside": "deep cloth starts where it is",
    "a_top_over_trousers": "garments pass through each other",
    "a_strain_limit_in_a_storm": "the limit doesn't act",
}


def broken(name, fault):
    """The rows of a case whose bounds don't hold with a fault."""
    owner, method, instead = FAULTS[fault]
    # Compiled programs are kept by shapes and names, which a fault doesn't change.
    jax.clear_caches()
    try:
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(owner, method, instead)
            return [r for r in run_case(name) if not r.holds]
    finally:
        jax.clear_caches()


# By which experiments/reproduce.py finds the rows.
PROMISE = "a case of stress breaks with a fault"
QUICK = ("free_fall", "gradients_at_singular_points", "an_effect_that_touches_nothing")


def test_controls_are_of_cases():
    assert set(CONTROLS) <= set(CASES) and set(CONTROLS.values()) | {SKIN} == set(FAULTS)


@pytest.mark.release
@pytest.mark.parametrize("name", QUICK)
def test_cases_of_the_mechanism_break(name):
    assert all(r.holds for r in run_case(name))
    assert broken(name, CONTROLS[name])


@pytest.mark.nightly
@pytest.mark.parametrize("name", CASES)
def test_every_case_breaks_with_a_fault(name, promise):
    fault = CONTROLS.get(name, SKIN)
    rows = broken(name, fault)
    assert rows, f"{name} holds although {fault}"
    row = next((r for r in rows if math.isfinite(r.measured)), rows[0])
    case = f"{name.replace('_', ' ')}: {fault}"
    promise(PROMISE, case, row.measured, f"{row.quantity}, bound {row.bound:g}")
