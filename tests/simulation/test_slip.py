"""What slides off the body is noticed, and what stays isn't."""

import dataclasses

import jax.numpy as jnp
import numpy as np
import pytest

from physxnet_jax.garment import holding_loops, tailor, template
from physxnet_jax.motion import animate, load_motion
from physxnet_jax.simulation import OFF, Scene, Status, prepare_scene, simulate_batch, slipped


def carried(assembly, motion):
    rest, weights = (jnp.asarray(x, jnp.float32) for x in (assembly.rest, assembly.weights))
    body_rest = jnp.asarray(assembly.rest_body, jnp.float32)
    return np.asarray(animate(assembly.body, body_rest, rest, weights, motion))


def short(name, frames=6):
    m = load_motion(name, fps=30.0)
    return dataclasses.replace(m, rotations=m.rotations[:frames], root=m.root[:frames])


def test_cloth_that_follows_the_skin_has_not_slid_and_what_sinks_has():
    assembly = prepare_scene(Scene((template("dress"), template("bottom")))).assembly
    motion = short("walk")
    cloth = carried(assembly, motion)
    assert slipped(assembly, motion, cloth).max() < 1e-4
    lower = cloth.copy()
    split = assembly.parts[1]
    lower[3:, :split, 1] -= 0.1
    found = slipped(assembly, motion, lower)
    assert found[:3].max() < 1e-4 and found[:, 1].max() < 1e-4
    np.testing.assert_allclose(found[3:, 0], 0.1, atol=1e-4)
    # Folds that balance out are no slide.
    waved = cloth + 0.05 * np.sign(np.sin(np.arange(cloth.shape[1])))[None, :, None]
    assert slipped(assembly, motion, waved).max() < 0.03


def test_garments_hold_on_by_their_bands_or_their_highest_border():
    assert set(holding_loops(tailor("skirt"))) == {"waist"}
    assert set(holding_loops(tailor("skirt", hold=("waist",)))) == {"waist"}
    v = np.asarray(template("top").mesh.vertices)
    (neck,) = holding_loops(template("top")).values()
    assert v[neck, 1].min() > 0.5
    (waist,) = holding_loops(template("bottom")).values()
    assert np.asarray(template("bottom").pinned)[waist].all()


@pytest.mark.nightly
def test_a_skirt_that_falls_is_flagged_and_one_with_a_band_is_not():
    motion = short("walk", 40)
    skirt = tailor("skirt", ease=0.2)
    # Without its band, and without friction, nothing holds it.
    slick = dataclasses.replace(skirt.fabric, friction=0.0)
    wide = dataclasses.replace(skirt, elastic=(), fabric=slick)
    wide = dataclasses.replace(wide, offset=wide.offset * jnp.float32([[3.0, 1.0, 3.0]]))
    for garment, falls in ((skirt, False), (wide, True)):
        from physxnet_jax.simulation import standard_effects

        scene = prepare_scene(Scene((garment,), standard_effects((garment,))))
        (out,) = simulate_batch(scene, [motion])
        flagged = (out.status & int(Status.OFF)) > 0
        assert bool(flagged.any()) is falls
        assert (out.diagnostics["slipped"].max() > OFF) is np.bool_(falls)
    assert "hold" in Status.OFF.advice
