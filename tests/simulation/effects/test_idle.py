"""What a scene doesn't call for isn't in its program, down to single parameters."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from physxnet_jax.garment import square_sheet, tailor
from physxnet_jax.simulation import (
    EFFECTS,
    XPBD,
    Scene,
    State,
    advance,
    make_system,
    prepare_scene,
)
from physxnet_jax.simulation.effects import (
    Air,
    Bend,
    BodyContact,
    Damping,
    Dihedral,
    Elastic,
    Floor,
    Gravity,
    Guide,
    LayerContact,
    Membrane,
    Pin,
    Seam,
    SelfContact,
    StrainLimit,
    Stretch,
    Tether,
)

BASE = (Gravity(), Stretch())
WIND = (1.0, 0.0, 3.0)
# An effect with something to do; it with nothing to do; and what does the same, if not nothing.
WHOLE = {
    "gravity": (Gravity(), Gravity(g=0.0)),
    "damping": (Damping(), Damping(rate=0.0)),
    "a vacuum": (Air(wind=WIND), Air(wind=WIND, density=0.0)),
    "no drag": (Air(wind=WIND), Air(wind=WIND, normal=0.0, tangent=0.0)),
    "no stitches": (Seam(stitches=((0, 5),)), Seam()),
}
PARTS = {
    "gust": (Air(wind=WIND, gust=0.5), Air(wind=WIND, gust=0.0, period=7.0), Air(wind=WIND)),
    "still air has no gusts": (Air(wind=WIND, gust=0.5), Air(gust=0.5), Air()),
    "turbulence": (
        Air(wind=WIND, turbulence=1.0),
        Air(wind=WIND, turbulence=0.0, eddy=3.0, seed=5),
        Air(wind=WIND),
    ),
    "turbulence without wind": (
        Air(wind=WIND, turbulence=1.0),
        Air(turbulence=1.0, gust=0.9),
        Air(turbulence=1.0),
    ),
    "shelter": (Air(wind=WIND), Air(shelter=0.3), Air()),
    "drag across": (Air(), Air(normal=0.0), None),
    "drag along": (Air(), Air(tangent=0.0), None),
}
# What has something to do on any cloth.
ALWAYS = {Stretch, Membrane, Bend, Dihedral, StrainLimit, SelfContact, BodyContact, Floor, Guide}
# What friction computes, and nothing else of a contact.
FRICTION = {
    "layers": (LayerContact(), LayerContact(friction=0.0), 2),
    "folds": (SelfContact(), SelfContact(friction=0.0), 1),
}


STILL = np.zeros((2, 1, 3), np.float32)


def scene_of(effects, garments=1, pinned=None):
    sheet = square_sheet(5, 0.2, pinned=pinned)
    sheets = [dataclasses.replace(sheet, name=f"sheet {k}") for k in range(garments)]
    return prepare_scene(Scene(tuple(sheets), tuple(effects)))


def frame(scene):
    """A frame as a function of its start, and a start in motion."""
    body = scene.assembly.body
    pose = jnp.repeat(body.a_pose()[None, None], 2, axis=0)
    system = make_system(scene, XPBD())
    x = jnp.asarray(scene.assembly.rest.astype(np.float32))[:, :, None]
    flying = np.random.default_rng(0).normal(size=x.shape).astype(np.float32)

    def run(start):
        return advance(system, start, pose, jnp.asarray(STILL), solver=XPBD(4, 1), fps=30.0)

    return run, State(x, jnp.asarray(flying))


def program(scene):
    run, start = frame(scene)
    return str(jax.make_jaxpr(run)(start))


def result(scene):
    run, start = frame(scene)
    return np.asarray(jax.jit(run)(start)[0].position)


@pytest.mark.parametrize("name", WHOLE)
def test_an_idle_effect_is_left_out(name):
    busy, idle = WHOLE[name]
    others = [e for e in BASE if type(e) is not type(busy)]
    with_it, without, nothing = (scene_of([*others, *e]) for e in ((busy,), (idle,), ()))
    assert len(without.effects) == len(nothing.effects) == len(with_it.effects) - 1
    assert program(without) == program(nothing) != program(with_it)
    np.testing.assert_array_equal(result(without), result(nothing))
    assert np.abs(result(with_it) - result(nothing)).max() > 1e-7


@pytest.mark.parametrize(
    ("effect", "busy"),
    [
        (Pin(), scene_of([*BASE, Pin()], pinned=np.arange(5))),
        (LayerContact(), scene_of([*BASE, LayerContact()], garments=2)),
        (Elastic(), None),
    ],
    ids=["pins of nothing", "layers of one garment", "no band"],
)
def test_an_effect_without_its_part_of_a_garment_is_left_out(effect, busy):
    without, nothing = scene_of([*BASE, effect]), scene_of(BASE)
    assert len(without.effects) == len(nothing.effects) == 2
    assert program(without) == program(nothing)
    np.testing.assert_array_equal(result(without), result(nothing))
    if busy is not None:
        assert len(busy.effects) == 3


def test_a_waistband_is_not_idle():
    scene = Scene((tailor("skirt"),), (*BASE, Elastic()))
    assert len(prepare_scene(scene).effects) == 3


@pytest.mark.parametrize("name", PARTS)
def test_an_idle_parameter_is_left_out(name):
    busy, idle, plain = PARTS[name]
    programs = [program(scene_of([*BASE, e])) for e in (busy, idle, plain) if e is not None]
    # Settings are named in no equation.
    assert programs[1].count(" = ") < programs[0].count(" = ")
    if plain is not None:
        assert programs[1] == programs[2]
        found, expected = (result(scene_of([*BASE, e])) for e in (idle, plain))
        np.testing.assert_array_equal(found, expected)


@pytest.mark.release
@pytest.mark.parametrize("name", FRICTION)
def test_contact_without_friction_computes_none(name):
    busy, idle, garments = FRICTION[name]
    programs = [program(scene_of([*BASE, e], garments)) for e in (busy, idle)]
    assert programs[1].count(" = ") < programs[0].count(" = ") - 5
    # As with so little that it moves nothing.
    little = dataclasses.replace(busy, friction=1e-30)
    found, expected = (result(scene_of([*BASE, e], garments)) for e in (idle, little))
    np.testing.assert_array_equal(found, expected)


def test_every_effect_is_idle_without_its_cause_or_always_acts():
    """A new effect belongs to one of these lists."""
    tested = {type(e) for e, _ in WHOLE.values()} | {Pin, LayerContact, Elastic, Tether}
    assert set(EFFECTS.values()) - tested == ALWAYS
