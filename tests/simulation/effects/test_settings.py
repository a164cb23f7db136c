"""Settings that mean nothing are refused where they are made, by name."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from physxnet_jax.garment import Fabric, square_sheet, template
from physxnet_jax.simulation import (
    XPBD,
    Implicit,
    Scene,
    State,
    Verlet,
    advance,
    make_system,
    prepare_scene,
    settle_on_static_body,
)
from physxnet_jax.simulation.blender import BlenderSettings
from physxnet_jax.simulation.effects import (
    Air,
    Bend,
    BodyContact,
    Damping,
    Dihedral,
    Floor,
    Gravity,
    LayerContact,
    Membrane,
    Pin,
    Seam,
    SelfContact,
    StrainLimit,
    Stretch,
    Tether,
)
from physxnet_jax.simulation.newton import NewtonSettings

NAN, INF = float("nan"), float("inf")
WRONG = [
    *((Fabric, {k: v}) for k in ("density", "stretch", "warp") for v in (0.0, -1.0, NAN, INF)),
    *((Fabric, {k: v}) for k in ("bend", "thickness", "friction") for v in (-1.0, NAN)),
    (Gravity, {"g": NAN}),
    (BlenderSettings, {"quality": 0}),
    (BlenderSettings, {"distance": 1e-4}),
    (BlenderSettings, {"mass": 0.0}),
    (BlenderSettings, {"air": NAN}),
    (NewtonSettings, {"substeps": 2.5}),
    (NewtonSettings, {"stretch": INF}),
    (NewtonSettings, {"friction": -0.1}),
    (Damping, {"rate": -5.0}),
    (StrainLimit, {"limit": -0.5}),
    (Seam, {"stiffness": 0.0}),
    (Tether, {"slack": -0.1}),
    (Seam, {"stiffness": -1e4}),
    (Stretch, {"compression": INF}),
    (Membrane, {"compression": NAN}),
    (Floor, {"height": NAN}),
    (Floor, {"push": 0.0}),
    (BodyContact, {"leave": -1.0}),
    (BodyContact, {"push": NAN}),
    (BodyContact, {"hops": 0}),
    (BodyContact, {"hops": 2.5}),
    (SelfContact, {"reach": 0.0}),
    (SelfContact, {"room": 0}),
    (SelfContact, {"every": 0}),
    (LayerContact, {"ring": 0}),
    (LayerContact, {"gap": NAN}),
    (LayerContact, {"hops": True}),
    (Air, {"wind": (NAN, 0.0, 0.0)}),
    (Air, {"wind": (1.0, 2.0)}),
    (Air, {"period": 0.0}),
    (Air, {"eddy": 0.0}),
    (Air, {"shelter": 1.5}),
    (XPBD, {"substeps": 4.0}),
    (XPBD, {"contact_updates": 0}),
    (Implicit, {"tolerance": -1.0}),
    (Implicit, {"newton": 0}),
]


@pytest.mark.parametrize(("kind", "setting"), WRONG)
def test_invalid_effect_settings_are_refused(kind, setting):
    kind()
    ((name, value),) = setting.items()
    # The suite's own check of types may come first.
    with pytest.raises(Exception, match=name) as error:
        kind(**setting)
    assert isinstance(error.value, ValueError | TypeError) and str(value)[:3] in str(error.value)


@pytest.mark.nightly
@pytest.mark.parametrize(
    "effect",
    [
        Air(wind=(0.0, 0.0, 4.0), turbulence=1.0),
        Bend(),
        BodyContact(),
        Damping(),
        Dihedral(),
        Floor(),
        LayerContact(),
        Membrane(),
        Pin(),
        Seam(((0, 24),)),
        SelfContact(),
        StrainLimit(),
        Stretch(),
    ],
    ids=lambda e: type(e).__name__,
)
@pytest.mark.parametrize("solver", [XPBD, Implicit, Verlet])
def test_every_effect_runs_in_double_precision(effect, solver):
    scene = prepare_scene(Scene((square_sheet(5, 0.2),), (Gravity(), effect)))
    out = settle_on_static_body(scene, 1, solver=solver(2, 1, precision="float64"))
    assert out.finite.all() and out.positions[0].dtype == np.float64


@pytest.mark.release
@pytest.mark.parametrize("solver", [XPBD(4, 1), Implicit(4, 1)])
def test_gradient_is_finite_for_a_strain_limit_between_pinned_vertices(solver, body, rest):
    """Both ends of it have no inverse mass: there is nothing to divide by."""
    sheet = square_sheet(4, 0.2, pinned=np.arange(4))
    scene = prepare_scene(Scene((sheet,), (Gravity(), StrainLimit(), Pin())))
    pose = jnp.repeat(body.a_pose()[None, None], 3, axis=0)
    root = jnp.repeat(body.joint_positions(rest)[0][:1][None], 3, axis=0)
    system = make_system(scene, solver)

    def low(x):
        v = jnp.zeros_like(x)
        state = State(x, v, solver.init_state(v, 1 / (30.0 * solver.substeps)))
        return jnp.sum(advance(system, state, pose, root, solver=solver, fps=30.0)[1][-1, :, 1])

    slope = jax.grad(low)(jnp.asarray(sheet.mesh.vertices)[:, :, None] * 1.3)
    assert np.isfinite(np.asarray(slope)).all() and np.abs(np.asarray(slope)).max() > 0.1


@pytest.mark.release
@pytest.mark.parametrize(("depth", "told"), [(0.03, True), (0.1, True), (-0.05, False)])
def test_layers_far_on_the_wrong_side_are_reported(depth, told):
    """Put right it is from 5 cm only; told of from farther."""
    inner = square_sheet(8, 0.3, upright=True, pinned=np.arange(64))
    x = np.asarray(inner.mesh.vertices)
    n = np.cross(*(x[inner.mesh.faces[0][k]] - x[inner.mesh.faces[0][0]] for k in (1, 2)))
    n /= np.linalg.norm(n)
    outer = dataclasses.replace(square_sheet(8, 0.3, upright=True), name="outer")
    scene = prepare_scene(Scene((inner, outer), (LayerContact(),)))
    (layers,) = scene.effects
    # Outwards is away from the body, whichever way triangles face.
    out = n * float(layers.side[-1, 0, 0])
    start = np.concatenate([x, x - depth * out])
    rollout = settle_on_static_body(scene, 1, solver=XPBD(4, 1), start=start)
    assert (rollout.diagnostics["layers_crossed"][0] > 50) == told


def test_changing_the_fabric_keeps_the_minimum_thickness():
    from physxnet_jax.dressing import make_scene

    for name in ("top", "bottom"):
        usual = template(name)
        (cotton,) = make_scene("walk", [f"{name}:fabric=cotton"], frames=1).scene.garments
        assert cotton.fabric == usual.fabric
        (silk,) = make_scene("walk", [f"{name}:fabric=silk"], frames=1).scene.garments
        assert silk.fabric.thickness == usual.fabric.thickness and silk.fabric.density == 0.07
    (denim,) = make_scene("walk", ["bottom:fabric=denim"], frames=1).scene.garments
    assert denim.fabric.thickness == 0.005


def test_air_replaces_the_default_damping():
    from physxnet_jax.dressing import Simulation, make_scene

    def kinds(**options):
        scene = make_scene("walk", ["bottom"], frames=1, **options).scene
        return {type(e) for e in scene.effects}

    assert Damping in kinds() and Damping not in kinds(also=[Air(wind=(0.0, 0.0, 4.0))])
    assert Damping in kinds(simulation=Simulation(effects=(Gravity(), Damping())), also=[Air()])
    assert Damping in kinds(also=[Air(), Damping(2.0)])
