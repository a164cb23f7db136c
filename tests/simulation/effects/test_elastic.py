"""Laws of the elastic effects: closed forms, invariances, derivatives."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from physxnet_jax.garment import Fabric, free_garment, square_sheet
from physxnet_jax.simulation import XPBD, Clock, Scene, prepare_scene, settle_on_static_body
from physxnet_jax.simulation._effect import Step
from physxnet_jax.simulation.effects import (
    Bend,
    Dihedral,
    Gravity,
    Membrane,
    Pin,
    StrainLimit,
    Stretch,
)
from physxnet_jax.simulation.effects._colored import Colored

FABRIC = Fabric(stretch=300.0, bend=1e-4, warp=400.0, weft=200.0, shear=30.0)
CLOCK = Clock(jnp.float32(0.0), 0.01)
ELASTIC = [Stretch(), Membrane(), Bend(), Dihedral()]


def prepared(effect, garment):
    scene = prepare_scene(Scene((garment,), (effect,)))
    return scene.effects[0], scene.assembly.rest


@jax.jit
def begun(effect, base):
    return effect.begin(base, None, None, CLOCK, ())


@jax.jit
def stored(effect, d, base):
    return effect.energy(d, begun(effect, base))


def energy(effect, rest, x):
    """Energy at positions x, with the rest shape as the block's base."""
    base = jnp.asarray(rest, jnp.float32)[:, :, None]
    return stored(effect, jnp.asarray(x, jnp.float32)[:, :, None] - base, base)[0]


def turned(x, seed):
    q = np.random.default_rng(seed).normal(size=(3, 3))
    r = np.linalg.qr(q)[0]
    r *= np.sign(np.linalg.det(r))
    return (x - x.mean(0)) @ r.T + [0.3, -0.2, 1.0]


@pytest.mark.parametrize("effect", ELASTIC)
@pytest.mark.parametrize("seed", [0, 1])
def test_elastic_energy_is_invariant_to_rigid_motion(effect, seed):
    e, rest = prepared(effect, square_sheet(5, 0.2, fabric=FABRIC))
    bent = rest + np.random.default_rng(seed).normal(size=rest.shape) * 0.004
    reference = float(energy(e, rest, bent))
    assert reference > 1e-6
    assert float(energy(e, rest, turned(rest, seed))) < 1e-5 * reference + 1e-9
    assert float(energy(e, rest, turned(bent, seed))) == pytest.approx(reference, rel=2e-3)


@pytest.mark.parametrize("direction", [0, 2])
@pytest.mark.parametrize("strain", [0.1, -0.1])
def test_membrane_passes_the_patch_test(direction, strain):
    """Uniform stretch along warp (z, level sheet) and weft (x): E = 1/2 Y A strain^2."""
    e, rest = prepared(Membrane(compression=0.5), square_sheet(4, 0.2, fabric=FABRIC))
    x = rest.copy()
    x[:, direction] = rest[0, direction] + (1 + strain) * (rest[:, direction] - rest[0, direction])
    stiffness = {2: 400.0, 0: 200.0}[direction] * (0.5 if strain < 0 else 1.0)
    expected = 0.5 * stiffness * 0.2**2 * strain**2
    assert float(energy(e, rest, x)) == pytest.approx(expected, rel=1e-4)


def test_membrane_shear_energy_matches_the_thread_angle():
    e, rest = prepared(Membrane(), square_sheet(4, 0.2, fabric=FABRIC))
    angle = 0.1
    x = rest.copy()
    # Threads along x turn by the angle and keep their length: no stretch, only shear.
    along = rest[:, 0] - rest[0, 0]
    x[:, 0] = rest[0, 0] + along * np.cos(angle)
    x[:, 2] = rest[:, 2] + along * np.sin(angle)
    expected = 0.5 * 30.0 * 0.2**2 * np.sin(angle) ** 2
    assert float(energy(e, rest, x)) == pytest.approx(expected, rel=1e-3)


def test_spring_stiffness_matches_an_isotropic_sheet():
    """A regular spring mesh is an isotropic sheet of Poisson's ratio 1/3: stretched
    both ways it stores Y A strain^2 / (1 - 1/3)."""
    e, rest = prepared(Stretch(compression=1.0), square_sheet(21, 0.4, fabric=FABRIC))
    x = rest.copy()
    x[:, 0] *= 1.01
    x[:, 2] = rest[0, 2] + 1.01 * (rest[:, 2] - rest[0, 2])
    expected = 300.0 * 0.4**2 * 0.01**2 / (1 - 1 / 3)
    assert float(energy(e, rest, x)) == pytest.approx(expected, rel=1e-3)


def rolled(rest, angle, radius):
    """A level sheet rolled to a cylinder whose axis lies at an angle to the weft."""
    c, s = np.cos(angle), np.sin(angle)
    p = rest - rest.mean(0)
    u, v = c * p[:, 0] + s * p[:, 2], -s * p[:, 0] + c * p[:, 2]
    u, y = radius * np.sin(u / radius), radius * (1 - np.cos(u / radius))
    return np.column_stack([c * u - s * v, y, s * u + c * v])


@pytest.mark.parametrize("effect", [Bend(), Dihedral()])
@pytest.mark.parametrize("n", [17, 33])
def test_cylinder_bending_energy_matches_the_analytic_value(effect, n):
    size, radius = 0.2, 0.15
    e, rest = prepared(effect, square_sheet(n, size, fabric=FABRIC))
    # Free edges have no hinge: a third of their triangles' area stores nothing.
    covered = size**2 * (1 - 2 / (3 * (n - 1)))
    expected = 0.5 * 1e-4 / radius**2 * covered
    for angle, bound in ((0.0, 0.06), (np.pi / 2, 0.06)):
        found = float(energy(e, rest, rolled(rest, angle, radius)))
        assert found == pytest.approx(expected, rel=bound)
    # Across the diagonals a grid is stiffer: known, and not more than this.
    across = float(energy(e, rest, rolled(rest, np.pi / 4, radius)))
    assert 1.0 < across / expected < 1.6


def strip(kind, columns, rows):
    """A strip of unit length beyond its first three rows, cut into triangles."""
    length = (rows - 1) / (rows - 3)
    x, y = np.meshgrid(np.linspace(0, 0.5, columns), np.linspace(0, length, rows))
    k = np.arange(rows * columns).reshape(rows, columns)
    a, b, c, d = (q.ravel() for q in (k[:-1, :-1], k[:-1, 1:], k[1:, 1:], k[1:, :-1]))
    turned = np.ones((rows - 1, columns - 1), bool)
    if kind == "alternating":
        turned = np.add.outer(np.arange(rows - 1), np.arange(columns - 1)) % 2 == 0
    elif kind == "equilateral":
        x[1::2] += 0.25 / (columns - 1)
        turned[::2] = False
    elif kind == "irregular":
        inner = np.zeros(x.shape, bool)
        inner[1:-1, 1:-1] = True
        noise = np.random.default_rng(0).uniform(-0.3, 0.3, (2, *x.shape)) * 0.5 / (columns - 1)
        x, y = x + noise[0] * inner, y + noise[1] * inner
    e = turned.ravel()[:, None]
    faces = np.concatenate(
        [
            np.where(e, np.column_stack([a, c, b]), np.column_stack([a, d, b])),
            np.where(e, np.column_stack([a, d, c]), np.column_stack([b, d, c])),
        ]
    )
    return np.column_stack([x.ravel(), 0 * x.ravel(), y.ravel()]), faces


@pytest.mark.parametrize("kind", ["grid", "alternating", "equilateral", "irregular"])
def test_clamped_strip_deflects_like_a_beam_for_any_triangulation(kind):
    """Small deflections: stiffness k, load q an area, tip at q L^4 / 8 k."""
    v, faces = strip(kind, 9, 17)
    e, rest = prepared(Bend(), free_garment(v, faces, fabric=Fabric(bend=1.0)))
    i, j = e.coupled().T
    n = len(rest)
    stiffness = np.zeros((n, n))
    np.add.at(stiffness, (i, j), e.constant_stiffness())
    area = 0.5 * np.linalg.norm(
        np.cross(v[faces[:, 1]] - v[faces[:, 0]], v[faces[:, 2]] - v[faces[:, 0]]), axis=1
    )
    load = np.zeros(n)
    for k in range(3):
        np.add.at(load, faces[:, k], area / 3)
    row = np.arange(n) // 9
    free = row > 2
    tip = np.zeros(n)
    tip[free] = np.linalg.solve(stiffness[np.ix_(free, free)], load[free])
    assert tip[row == 16].mean() == pytest.approx(1 / 8, rel=0.32)
    # Three times as stiff, as the edge-midpoint Laplacian has it, is far from a beam.
    assert tip[row == 16].mean() / 3 < 0.5 / 8


@pytest.mark.parametrize("effect", [Membrane(), Dihedral(), StrainLimit()])
def test_constraint_gradients_match_autodiff(effect):
    e, rest = prepared(effect, square_sheet(4, 0.1, fabric=FABRIC))
    assert isinstance(e, Colored)
    x = rest + np.random.default_rng(3).normal(size=rest.shape) * 0.02
    base = jnp.asarray(rest, jnp.float32)[:, :, None]
    context = begun(e, base)
    d = jnp.asarray(x, jnp.float32)[:, :, None] - base
    corners = e._corners([d[i] for i in e.group.index], context[0])
    for law in e.measure(e.group.law, corners):
        c = jax.jit(law)(corners)

        def value(y, law=law):
            return law(tuple(q - y[0] for q in y)).value.sum()

        slope = jax.jit(jax.grad(value))(corners)
        scale = max(float(jnp.abs(s).max()) for s in slope) + 1e-6
        for mine, theirs in zip(c.gradients, slope, strict=True):
            # A limit that isn't reached has no slope, and moves nothing.
            gap = np.where(np.asarray(c.value) != 0, np.asarray(mine - theirs), 0.0)
            gap = np.abs(gap).max()
            assert gap < 2e-3 * scale


@pytest.mark.release
@pytest.mark.parametrize("effect", ELASTIC)
def test_hessians_are_symmetric_semidefinite_and_near_the_exact_one(effect):
    e, rest = prepared(effect, square_sheet(3, 0.1, fabric=FABRIC))
    count = len(rest)
    # In tension: what the blocks leave out there is small.
    x = rest.mean(0) + (rest - rest.mean(0)) * 1.02
    x[:, 1] += 1e-4 * np.random.default_rng(0).normal(size=count)
    base = jnp.asarray(rest, jnp.float32)[:, :, None]
    d = jnp.asarray(x, jnp.float32)[:, :, None] - base
    pairs = np.asarray(e.coupled())
    full = np.zeros((count, 3, count, 3))
    values = jax.jit(lambda y: e.hessian(y, begun(e, base)))(d)
    if values is not None:
        for (a, b), v in zip(pairs, np.asarray(values)[:, 0], strict=True):
            full[a, :, b] += v
    constant = e.constant_stiffness()
    if constant is not None:
        for (a, b), v in zip(pairs, constant, strict=True):
            full[a, :, b] += v * np.eye(3)
    full = full.reshape(3 * count, 3 * count)
    np.testing.assert_allclose(full, full.T, atol=1e-4 * np.abs(full).max())
    assert np.linalg.eigvalsh(full).min() > -1e-5 * np.abs(full).max()
    exact = jax.jit(jax.hessian(lambda y: stored(e, y, base)[0]))(d)
    exact = np.asarray(exact)[:, :, 0, :, :, 0].reshape(3 * count, 3 * count)
    assert np.abs(full - exact).max() < 0.1 * np.abs(exact).max()


@pytest.mark.release
def test_strain_limit_bounds_strain_where_springs_do_not():
    weak = Fabric(stretch=1.0, bend=1e-6)
    g = square_sheet(6, 0.3, upright=True, pinned=np.arange(6), fabric=weak)

    def worst(*limit):
        scene = prepare_scene(Scene((g,), (Gravity(), Stretch(), Bend(), *limit, Pin())))
        out = settle_on_static_body(scene, 30, solver=XPBD(32, 2))
        rest = np.asarray(g.mesh.vertices)
        x = out.positions[0][-1]
        return max(
            np.linalg.norm(x[6 * (k + 1) + j] - x[6 * k + j])
            / np.linalg.norm(rest[6 * (k + 1) + j] - rest[6 * k + j])
            for k in range(5)
            for j in range(6)
        )

    assert worst() > 1.25
    assert worst(StrainLimit(0.05)) < 1.08


def test_values_and_gradients_are_finite_for_degenerate_triangles():
    v = np.array([[0, 0, 0], [0.1, 0, 0], [0.1, 1e-9, 0], [0, 0, 0.1], [0, 0, 0.1]], float)
    g = free_garment(v, np.array([[0, 1, 2], [0, 1, 3], [0, 3, 4]]))
    for effect in (*ELASTIC, StrainLimit()):
        e, rest = prepared(effect, g)
        e = e.at_step(0.001)
        base = jnp.asarray(rest, jnp.float32)[:, :, None]
        project = jax.jit(
            lambda d, e=e, base=base: e.project(
                d, d, begun(e, base), jnp.float32(1.0), Step(0.001, 0.1)
            )
        )
        change = jax.jit(jax.value_and_grad(lambda d, e=e, base=base: stored(e, d, base).sum()))
        for x in (rest, np.zeros_like(rest), rest * [1, 1, 0]):
            d = jnp.asarray(x, jnp.float32)[:, :, None] - base
            assert np.isfinite(np.asarray(project(d))).all(), (effect, x)
            if e.elastic:
                value, slope = change(d)
                assert np.isfinite(float(value)) and np.isfinite(np.asarray(slope)).all()


@pytest.mark.nightly
@pytest.mark.parametrize("effect", [Stretch(), Membrane()])
@pytest.mark.parametrize("apart", [0.0, 1e-10, 1e-7])
def test_gradients_of_repeated_sweeps_are_finite_for_coincident_ends(effect, apart):
    """They have no direction to be parted in: as many sweeps as a frame has must not blow it up."""
    v = np.array([[0, 0, 0], [0.02, 0, 0], [0, 0, 0.02]], float)
    e, rest = prepared(effect, free_garment(v, np.array([[0, 1, 2]])))
    base = jnp.asarray(rest, jnp.float32)[:, :, None]
    folded = jnp.asarray(rest * apart / 0.02, jnp.float32)[:, :, None] - base

    def swept(d):
        for _ in range(32):
            d = e.project(d, d, begun(e, base), jnp.float32(1.0), Step(0.001, 0.1))
        return jnp.sum(d**2)

    value, slope = jax.jit(jax.value_and_grad(swept))(folded)
    assert np.isfinite(float(value)) and np.isfinite(np.asarray(slope)).all()
    # The control: where there is a direction there is a slope, the differences' own.
    half = 0.5 * jnp.asarray(rest, jnp.float32)[:, :, None] - base
    slope = jax.jit(jax.grad(swept))(half)
    assert np.abs(np.asarray(slope)).max() > 1e-3


def test_membrane_of_degenerate_triangles_reports_no_diagnostics():
    v = np.array([[0, 0, 0], [0.1, 0, 0], [0.2, 1e-9, 0]], float)
    e, rest = prepared(Membrane(), free_garment(v, np.array([[0, 1, 2]])))
    base = jnp.asarray(rest, jnp.float32)[:, :, None]
    assert e.diagnose(jnp.zeros_like(base), begun(e, base)) == {}


@pytest.mark.release
def test_strain_diagnostic_is_the_maximum_over_effects():
    sheet = square_sheet(4, 0.3, pinned=np.arange(4), fabric=FABRIC)
    reported = {}
    for effects in ((Stretch(),), (Membrane(),), (Stretch(), Membrane()), (Membrane(), Stretch())):
        scene = prepare_scene(Scene((sheet,), (Gravity(), *effects, Pin())))
        info = settle_on_static_body(scene, 3, solver=XPBD(4, 1), fps=30.0).diagnostics
        reported[tuple(type(e).__name__ for e in effects)] = info["strain_max"]
    both = reported["Stretch", "Membrane"]
    assert (both > 0).any() and not np.array_equal(reported["Stretch",], reported["Membrane",])
    np.testing.assert_allclose(both, reported["Membrane", "Stretch"], atol=5e-3)
