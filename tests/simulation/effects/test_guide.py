"""Guide: a critically damped spring on patch means, which leaves folds and everything else alone."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from physxnet_jax.garment import square_sheet, tailor
from physxnet_jax.simulation import (
    XPBD,
    Scene,
    advance,
    make_system,
    prepare_scene,
    start_state,
)
from physxnet_jax.simulation.effects import Bend, Gravity, Guide, Stretch

FPS = 30.0


def sheet():
    return square_sheet(9, 0.4)


def prepared(garments, guide, *others):
    scene = prepare_scene(Scene(garments, (*others, guide)))
    return scene, scene.effects[-1]


def run(scene, solver, x, frames, guide=None):
    system = make_system(scene, solver)
    pose = jnp.broadcast_to(jnp.asarray([1.0, 0.0, 0.0, 0.0]), (frames + 1, 1, 31, 4))
    root = jnp.zeros((frames + 1, 1, 3), jnp.float32)
    state = start_state(system, x, solver=solver, fps=FPS)
    return advance(system, state, pose, root, solver=solver, fps=FPS, guide=guide)[1]


@pytest.mark.release
@pytest.mark.parametrize("spacing", [0.05, 0.08, 0.16])
def test_patches_are_a_partition_of_every_garment(spacing):
    garments = (tailor("tee"), tailor("shorts"))
    scene, guide = prepared(garments, Guide(spacing))
    np.testing.assert_allclose(np.asarray(guide.weight).sum(axis=1), 1.0, atol=1e-5)
    np.testing.assert_allclose(np.asarray(guide.back_weight).sum(axis=0), 1.0, atol=1e-5)
    first = scene.assembly.parts[1]
    used = np.asarray(guide.weight) > 0.0
    owner = np.asarray(guide.index) >= first
    assert all(len(set(o[u])) == 1 for o, u in zip(owner, used)), "no patch is on two garments"
    x = jnp.asarray(scene.assembly.rest.astype(np.float32))[:, :, None]
    middles = np.asarray(guide.means(x))[:, :, 0]
    gap = np.linalg.norm(middles[:, None] - scene.assembly.rest[None], axis=2).min(axis=0)
    assert gap.max() < 1.5 * spacing


@pytest.mark.parametrize("substeps", [8, 32, 128])
def test_a_mean_follows_as_a_critically_damped_spring(substeps):
    """x(t) = D (1 + t / T) exp(-t / T), however long the substep is."""
    tc, shift = 0.1, 0.05
    scene, guide = prepared((sheet(),), Guide(0.1, tc))
    x = jnp.asarray(scene.assembly.rest.astype(np.float32))[:, :, None]
    target = guide.means(x + jnp.asarray([shift, 0.0, 0.0])[None, :, None])
    out = run(scene, XPBD(substeps, 1), x, 12, jnp.broadcast_to(target, (13, *target.shape)))
    t = np.arange(1, 13) / FPS
    wanted = shift * (1.0 - (1.0 + t / tc) * np.exp(-t / tc))
    moved = np.asarray(out[..., 0] - x[None, ..., 0])
    assert np.abs(moved[..., 1:]).max() < 1e-5
    # First order in the substep.
    assert np.abs(moved[..., 0].mean(axis=1) - wanted).max() < 0.25 * shift * (8 / substeps) * 0.5


def test_what_is_coarse_atlas_a_patch_is_left_alone():
    scene, guide = prepared((sheet(),), Guide(0.16, 0.02))
    x = np.asarray(scene.assembly.rest, np.float32)[:, :, None]
    rough = x.copy()
    # Alternating displacements, which means don't see.
    rough[::2, 2] += 0.01
    rough[1::2, 2] -= 0.01
    target = guide.means(jnp.asarray(x))
    seen = float(jnp.abs(guide.means(jnp.asarray(rough)) - target).max())
    assert seen < 4e-3
    out = run(
        scene, XPBD(16, 1), jnp.asarray(rough), 6, jnp.broadcast_to(target, (7, *target.shape))
    )
    assert np.abs(np.asarray(out[-1]) - rough).max() < 5e-3


@pytest.mark.release
def test_without_a_target_nothing_changes():
    others = (Gravity(), Stretch(), Bend())
    plain = prepare_scene(Scene((sheet(),), others))
    x = jnp.asarray(plain.assembly.rest.astype(np.float32))[:, :, None]
    guided, _ = prepared((sheet(),), Guide(), *others)
    solver = XPBD(16, 2)
    np.testing.assert_array_equal(run(plain, solver, x, 4), run(guided, solver, x, 4))

    def program(scene):
        return str(jax.make_jaxpr(lambda x: run(scene, solver, x, 1))(x))

    assert len(program(guided)) > len(program(plain))


@pytest.mark.release
def test_a_guided_sheet_falls_no_further_and_its_gradients_are_finite():
    others = (Gravity(), Stretch(), Bend())
    scene, guide = prepared((sheet(),), Guide(0.1, 0.01), *others)
    x = jnp.asarray(scene.assembly.rest.astype(np.float32))[:, :, None]
    target = jnp.broadcast_to(guide.means(x), (9, len(guide.index), 3, 1))
    held = run(scene, XPBD(16, 1), x, 8, target)
    free = run(scene, XPBD(16, 1), x, 8)
    assert float((x - free[-1])[:, 1].mean()) > 0.3
    # Gravity stretches the spring by g T^2.
    assert float((x - held[-1])[:, 1].mean()) == pytest.approx(9.81 * 0.01**2, rel=0.2)

    def height(target):
        return jnp.mean(run(scene, XPBD(8, 1), x, 3, target[:4])[-1][:, 1])

    slope = jax.grad(height)(target)
    assert bool(jnp.isfinite(slope).all()) and float(jnp.abs(slope).max()) > 1e-4


def test_a_skirt_is_held_less_than_a_bodice_and_a_loose_sheet_as_much():
    _, guide = prepared((tailor("aline"),), Guide(0.12, hanging=0.4))
    hold = np.asarray(guide.hung.hold)
    assert hold.min() == pytest.approx(0.4, abs=0.02) and hold.max() == pytest.approx(1.0)
    moves = jnp.ones((len(hold), 3, 1))
    np.testing.assert_allclose(guide.held(moves)[:, 1, 0], hold)
    # Nothing else holds a sheet.
    _, guide = prepared((sheet(),), Guide(0.12))
    assert guide.hung is None
    np.testing.assert_array_equal(guide.held(moves), moves)


def test_means_of_a_short_skirt_are_lengthened_and_those_at_rest_are_not():
    scene, guide = prepared((tailor("aline"),), Guide(0.12))
    rest = guide.means(jnp.asarray(scene.assembly.rest, jnp.float32)[:, :, None])
    np.testing.assert_allclose(guide.lengthened(rest), rest, atol=1e-5)
    snug = np.asarray(guide.hung.above) == np.arange(len(rest))
    assert 0.2 < snug.mean() < 0.8
    # What lies lower than the hem of the snug part is drawn up to it by 6 %.
    top = float(rest[snug, 1].min())
    short = rest.at[:, 1].add(jnp.where(rest[:, 1] < top, 0.06 * (top - rest[:, 1]), 0.0))
    longer = guide.lengthened(short)
    np.testing.assert_array_equal(longer[snug], short[snug])
    lowest = int(jnp.argmin(rest[:, 1, 0]))
    raised, left = (float(m[lowest, 1, 0] - rest[lowest, 1, 0]) for m in (short, longer))
    assert raised > 0.015 and left < 0.4 * raised

    def far(m):
        return jnp.linalg.norm((m - m[guide.hung.above])[:, :, 0], axis=1)

    missing = far(longer) - jnp.minimum(guide.hung.length, 1.1 * far(short))
    assert float(missing.min()) > -1e-5
    # Where two patches lie in one place.
    slope = jax.grad(lambda m: jnp.sum(guide.lengthened(m) ** 2))(jnp.zeros_like(rest))
    assert bool(jnp.isfinite(slope).all())


@pytest.mark.parametrize("wrong", [{"spacing": 0.0}, {"time_constant": -1.0}, {"hanging": -0.1}])
def test_impossible_settings_are_refused(wrong):
    with pytest.raises(ValueError, match=next(iter(wrong))):
        Guide(**wrong)
