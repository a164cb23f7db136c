"""The learned path where it is hard: value, tangent and cotangent stay finite and bounded."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from physxnet_jax.body import load_body
from physxnet_jax.dressing import Inference, clothe, dress, make_dresser
from physxnet_jax.errors import PhysXNetError
from physxnet_jax.garment import skin_garment
from physxnet_jax.motion import Motion, load_motion

FRAMES = 7
# Cloth of a template is never this far from its skinning in any simulation [m].
FAR = 0.8


@pytest.fixture(scope="module")
def dresser():
    # The push-out has hard cases of its own.
    return make_dresser(["bottom", "dress"], inference=Inference(collisions=False))


@pytest.fixture(scope="module")
def motion():
    m = load_motion("walk", fps=30.0)
    return m.rotations[:FRAMES], m.root[:FRAMES]


@pytest.fixture(scope="module")
def judge(dresser):
    """Distances from skinning [m], and the derivatives of their sum."""

    @jax.jit
    def far(rotations, root, scale):
        def total(rotations, root):
            # Speed, not fps, is what changes: one program serves all cases.
            cloth = clothe(dresser, rotations, root, 30.0)
            out = {"ok": cloth.ok}
            for w in dresser.worn:
                skinned = jax.vmap(
                    lambda q, p, w=w: skin_garment(w, *dresser.body.transforms(dresser.rest, q, p))
                )(rotations, root)
                out[w.name] = cloth[w.name] - skinned
            gaps = [x for name, x in out.items() if name != "ok"]
            return sum(jnp.sum(x * x) for x in gaps) * scale, out

        (value, out), grads = jax.value_and_grad(total, argnums=(0, 1), has_aux=True)(
            rotations, root
        )
        tangent = jax.jvp(lambda p: total(rotations, p)[0], (root,), (jnp.ones_like(root),))[1]
        return value, out, grads, tangent

    return lambda q, p: far(q, p, jnp.float32(1.0))


def still(q, p):
    return jnp.repeat(q[:1], FRAMES, axis=0), jnp.repeat(p[:1], FRAMES, axis=0)


def teleport(q, p):
    return q, p.at[4:, 0].add(10.0)


def fast(q, p):
    """Every second frame turned half round: fifty times as fast as anyone turns."""
    half = jnp.array([0.0, 0.0, 1.0, 0.0])
    return q.at[::2, 0].set(jnp.broadcast_to(half, q[::2, 0].shape)), 50.0 * p


def far_away(q, p):
    return q, p + jnp.array([[3e3, 0.0, -3e3]])


def gliding(q, p):
    """One pose carried along at one speed: every map stays what it is."""
    q, p = still(q, p)
    return q, p + jnp.linspace(0.0, 0.5, FRAMES)[:, None] * jnp.array([[1.0, 0.0, 0.0]])


def mirrored_quaternions(q, p):
    """q and -q are the same rotation."""
    return jnp.where(jnp.arange(FRAMES)[:, None, None] % 2 == 0, q, -q), p


@pytest.mark.sampled(2)
@pytest.mark.release
@pytest.mark.parametrize("case", [still, gliding, teleport, fast, far_away, mirrored_quaternions])
def test_cloth_stays_near_the_body_with_finite_gradients(judge, motion, case):
    value, out, grads, tangent = judge(*case(*motion))
    assert np.isfinite(value) and np.isfinite(tangent)
    assert out.pop("ok").all()
    for x in out.values():
        assert np.isfinite(x).all() and np.linalg.norm(x, axis=2).max() < FAR
    assert all(np.isfinite(g).all() for g in grads)


@pytest.mark.release
def test_offsets_exceed_the_bound_after_a_teleport_without_the_limit(dresser, motion, monkeypatch):
    monkeypatch.setattr("physxnet_jax.models._predictor._FARTHEST", 1e9)
    q, p = motion
    near, gone = (
        jax.jit(lambda p: clothe(dresser, q, p, 30.0)["dress"] - p[:, None])(x)
        for x in (p, teleport(q, p)[1])
    )
    assert float(jnp.linalg.norm(gone - near, axis=2).max()) > FAR


@pytest.mark.release
def test_static_pose_is_a_fixed_point(judge, motion):
    _, out, _, _ = judge(*still(*motion))
    del out["ok"]
    for x in out.values():
        np.testing.assert_allclose(np.asarray(x), np.asarray(x[:1]).repeat(FRAMES, 0), atol=1e-6)


@pytest.mark.release
def test_constant_velocity_is_a_fixed_point_after_the_window_is_full(dresser, judge, motion):
    """Constant maps in, constant cloth out, seen from the person."""
    _, out, _, _ = judge(*gliding(*motion))
    _, stood, _, _ = judge(*still(*motion))
    del out["ok"]
    full = dresser.predictor.config.inputs.window - 1
    for name, x in out.items():
        x = np.asarray(x)
        np.testing.assert_allclose(x[full:], x[full:][:1].repeat(FRAMES - full, 0), atol=1e-5)
        assert np.abs(x[-1] - np.asarray(stood[name])[-1]).max() > 1e-4, "speed is seen"


@pytest.mark.release
def test_quaternion_signs_do_not_change_the_cloth(judge, motion):
    _, plain, _, _ = judge(*motion)
    _, flipped, _, _ = judge(*mirrored_quaternions(*motion))
    del plain["ok"]
    for name, x in plain.items():
        np.testing.assert_allclose(np.asarray(flipped[name]), np.asarray(x), atol=1e-5)


@pytest.mark.release
def test_non_finite_frame_affects_only_its_window(dresser, judge, motion):
    """The frames whose window holds it are NaN and say so; all others are untouched."""
    q, p = motion
    _, clean, _, _ = judge(q, p)
    inputs = dresser.predictor.config.inputs
    steps = inputs.stride * np.arange(inputs.frames)[:, None] + inputs.span * np.arange(3)
    frames = np.arange(FRAMES)
    # What was before the first frame is told from those after it: nothing gets in by that way.
    _, out, _, _ = judge(q, p.at[1].set(jnp.nan))
    spoiled = np.isin(frames - 1, steps)
    assert 1 < spoiled.sum() < FRAMES - 1
    np.testing.assert_array_equal(np.asarray(out["ok"]), ~spoiled)
    _, out, _, _ = judge(q, p.at[4].set(jnp.nan))
    spoiled = np.isin(frames - 4, steps)
    np.testing.assert_array_equal(np.asarray(out.pop("ok")), ~spoiled)
    for name, x in out.items():
        whole = np.isfinite(np.asarray(x)).all(axis=(1, 2))
        np.testing.assert_array_equal(whole, ~spoiled)
        np.testing.assert_allclose(
            np.asarray(x)[~spoiled], np.asarray(clean[name])[~spoiled], atol=1e-5
        )


@pytest.mark.release
def test_float32_matches_float64_from_rotations_to_vertices(dresser, motion):
    """The same numbers in float64: what is between is rounding alone, near and far away."""

    @jax.jit
    def wear(dresser, q, p):
        return clothe(dresser, q, p, 30.0).vertices

    def wide(tree):
        return jax.tree.map(
            lambda x: jnp.asarray(x, jnp.float64) if x.dtype == jnp.float32 else x, tree
        )

    for case, most, typical in (
        (lambda q, p: (q, p), 1e-5, 1e-6),
        (fast, 1e-3, 3e-5),
        # Here neighbouring numbers are a quarter of a millimetre apart.
        (far_away, 1e-2, 1e-3),
    ):
        moved = case(*motion)
        narrow = {k: np.asarray(x) for k, x in wear(dresser, *moved).items()}
        # What the code makes of its own constants stays float32.
        with jax.enable_x64(True), jax.numpy_dtype_promotion("standard"):
            told = {k: np.asarray(x) for k, x in wear(wide(dresser), *wide(moved)).items()}
        for name, x in told.items():
            off = np.linalg.norm(narrow[name] - x, axis=-1)
            # Were it float32 in disguise, nothing would be between.
            assert x.dtype == np.float64 and 0 < off.max() < most, (name, off.max())
            assert np.sqrt(np.mean(off**2)) < typical, (name, np.sqrt(np.mean(off**2)))


def test_non_finite_motions_are_refused_on_the_host(motion):
    q, p = motion
    for bad in (Motion(q, p.at[2].set(jnp.nan), 30.0), Motion(q.at[3, 4].set(jnp.inf), p, 30.0)):
        with pytest.raises(PhysXNetError, match="finite"):
            dress(bad, ["bottom"], method="lbs")


@pytest.mark.release
@pytest.mark.parametrize(
    "values",
    [
        {"gender": 1.0, "height_up": 1.0, "weight_up": 1.0},
        pytest.param({"height_down": 1.0, "weight_down": 1.0}, marks=pytest.mark.nightly),
    ],
    ids=["huge", "tiny"],
)
def test_cloth_stays_near_extreme_body_shapes(motion, values):
    shape = load_body().shape(**values)
    clip = Motion(*motion, 30.0)
    worn = {m: dress(clip, ["dress"], method=m, shape=shape) for m in ("network", "lbs")}
    gap = worn["network"].garments[0].positions - worn["lbs"].garments[0].positions
    assert np.isfinite(gap).all() and np.linalg.norm(gap, axis=2).max() < FAR


@pytest.mark.nightly
def test_degenerate_triangle_does_not_change_other_triangles(motion):
    from physxnet_jax.garment import template

    garment = template("bottom")
    faces = np.asarray(garment.mesh.faces).copy()
    spoiled = np.concatenate([faces, faces[:1, [0, 0, 1]]]).astype(faces.dtype)
    mesh = dataclasses.replace(garment.mesh, faces=jnp.asarray(spoiled))
    if garment.mesh.uv_faces is not None:
        uv = np.asarray(garment.mesh.uv_faces)
        mesh = dataclasses.replace(mesh, uv_faces=jnp.asarray(np.concatenate([uv, uv[:1]])))
    worn = [
        dress(Motion(*motion, 30.0), [g], method="network", include_body=False)
        .garments[0]
        .positions
        for g in (garment, dataclasses.replace(garment, mesh=mesh))
    ]
    np.testing.assert_allclose(worn[1], worn[0], atol=1e-4)


@pytest.mark.release
def test_off_chart_vertices_are_bound_and_counted(motion):
    """Trousers so long that they hang from the feet, where the atlas has no texels."""
    from physxnet_jax.garment import template
    from physxnet_jax.models import load_predictor
    from physxnet_jax.uv import bind

    body = load_body()
    rest = body.rest_vertices(body.default_shape())
    predictor = load_predictor("paper")
    valid = predictor.texel_points.valid["bottom"]
    garment = template("bottom")
    x = np.asarray(garment.mesh.vertices)
    low = x[:, 1] < np.quantile(x[:, 1], 0.05)
    longer = np.where(low[:, None], x + [0.0, -0.12, 0.04], x).astype(np.float32)
    mesh = dataclasses.replace(garment.mesh, vertices=jnp.asarray(longer))
    long = dataclasses.replace(garment, mesh=mesh)
    lost = [
        bind(g, atlas=predictor.atlas, body=body, rest=rest, valid=valid).off_chart
        for g in (garment, long)
    ]
    assert lost[1] > lost[0]
    worn = dress(
        Motion(*motion, 30.0),
        [long],
        method="network",
        inference=Inference(weights="paper", strain_iterations=0),
        include_body=False,
    ).garments[0]
    still = dress(Motion(*motion, 30.0), [long], method="lbs", include_body=False).garments[0]
    gap = np.linalg.norm(worn.positions - still.positions, axis=2)
    assert np.isfinite(gap).all() and gap.max() < FAR
