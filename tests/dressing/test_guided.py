"""Guided simulation: it starts near the prediction, streams, starts anew, and obeys fabric and wind."""

import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax import export

from physxnet_jax.dressing import (
    Inference,
    Simulation,
    clothe,
    clothe_step,
    dress,
    export_dresser,
    init_stream,
    make_dresser,
)
from physxnet_jax.dressing._guided import _softness
from physxnet_jax.errors import FormatError, PhysXNetError
from physxnet_jax.geometry import mesh_edges
from physxnet_jax.models import load_predictor
from physxnet_jax.motion import load_motion
from physxnet_jax.simulation import STANDARD
from physxnet_jax.simulation.effects import Guide

NANO = Inference(weights="nano")
FRAMES = 8


@pytest.fixture(scope="module")
def motion():
    walk = load_motion("walk", fps=30.0)
    return dataclasses.replace(walk, rotations=walk.rotations[:40], root=walk.root[:40])


@pytest.fixture(scope="module")
def guided():
    return make_dresser(["bottom"], method="guided", inference=NANO)


@functools.partial(jax.jit, static_argnames="fps")
def cloth_of(dresser, q, p, fps=30.0):
    return clothe(dresser, q, p, fps)


@functools.partial(jax.jit, static_argnames="fps")
def step(dresser, stream, q, p, fps=30.0):
    return clothe_step(dresser, stream, q, p, fps)


@pytest.mark.release
def test_the_first_frame_is_skinned_cloth_near_the_prediction(motion):
    """Smooth, with its patches where they are predicted; later frames are the simulation's.

    The weights are rough ones: the packaged ones with a tenth of noise.
    """
    nano = load_predictor("nano")
    leaves, tree = jax.tree.flatten(nano.state)
    keys = jax.random.split(jax.random.key(0), len(leaves))
    leaves = [
        x + 0.1 * jnp.std(x) * jax.random.normal(k, x.shape) if x.ndim == 4 else x
        for x, k in zip(leaves, keys, strict=True)
    ]
    rough = dataclasses.replace(nano, state=jax.tree.unflatten(tree, leaves))
    guided = make_dresser(["bottom"], method="guided", inference=Inference(weights=rough))
    q, p = motion.rotations[:FRAMES], motion.root[:FRAMES]
    bare = Inference(weights=rough, strain_iterations=0)
    predicted = clothe(make_dresser(["bottom"], inference=bare), q, p, 30.0)["bottom"]
    found = cloth_of(guided, q, p)
    assert bool(found.ok.all())
    skinned = clothe(make_dresser(["bottom"], method="lbs"), q, p, 30.0)["bottom"]
    edges = mesh_edges(np.asarray(guided.garments[0].mesh.faces)).vertices

    def roughness(x):
        """Differences along edges over those of skinned cloth [m]."""
        off = np.asarray(x - skinned)[0]
        return np.linalg.norm(off[edges[:, 0]] - off[edges[:, 1]], axis=1).mean()

    assert roughness(found["bottom"]) < 0.7 * roughness(predicted)
    # The patches are still where they are predicted, nearly.
    scene = guided.guided
    means = [
        jax.vmap(lambda x: scene.guide.means(x[:, :, None]))(x)
        for x in (found["bottom"], predicted)
    ]
    away = np.linalg.norm(np.asarray(means[0] - means[1])[..., 0], axis=2)
    assert away[0].mean() < 4e-3 and away[-1].mean() < 0.01


def wide(tree):
    """The tree in float64."""
    return jax.tree.map(
        lambda x: x.astype("float64") if jnp.issubdtype(x.dtype, jnp.floating) else x, tree
    )


def in_double(dresser):
    """A guided dresser that computes in float64; to be used within `jax.enable_x64`."""
    dresser = wide(dresser)
    solver = dataclasses.replace(dresser.guided.solver, precision="float64")
    scene = dataclasses.replace(dresser.guided, solver=solver)
    return dataclasses.replace(dresser, guided=scene)


@pytest.mark.release
def test_a_stream_gives_the_clip(guided, motion):
    """In float64: in float32 rounding decides which contacts are found, from the second frame."""
    with jax.enable_x64(True):
        dresser = in_double(guided)
        q, p = wide((motion.rotations[:FRAMES], motion.root[:FRAMES]))
        whole = cloth_of(dresser, q, p)["bottom"]
        stream = init_stream(dresser, q[:2], p[:2])
        for k in range(FRAMES):
            stream, now = step(dresser, stream, q[k], p[k])
            assert float(jnp.abs(now["bottom"] - whole[k]).max()) < 1e-9


@pytest.mark.release
def test_a_stream_whose_place_moves_gives_the_clip(guided, motion, monkeypatch, apart):
    """As after 16 m, but with every step: by whole 20 mm, as no wind blows."""
    for name in ("_FAR", "TURBULENCE_PERIOD"):
        monkeypatch.setattr(f"physxnet_jax.dressing._clothe.{name}", 0.02)
    follow = jax.jit(lambda *args: clothe_step(*args, 30.0))
    with jax.enable_x64(True):
        dresser = in_double(guided)
        q, p = wide((motion.rotations[:FRAMES], motion.root[:FRAMES]))
        whole = cloth_of(dresser, q, p)["bottom"]
        stream, places = init_stream(dresser, q[:2], p[:2]), []
        for k in range(FRAMES - 2):
            stream, now = follow(dresser, stream, q[k], p[k])
            places.append(float(stream.place[2]))
            # The network computes in float32.
            assert apart(now["bottom"], whole[k]) < 1e-5
        assert len(set(places)) > 3


@pytest.mark.release
def test_blocks_of_a_clip_go_on_from_each_other(guided, motion, apart):
    clip = dress(motion, ["bottom"], method="guided", inference=NANO, include_body=False)
    whole = cloth_of(guided, motion.rotations, motion.root)["bottom"]
    assert clip.stages[-2].name == "guided simulation" and clip.method == "guided"
    np.testing.assert_allclose(clip.meshes[0].positions[:4], whole[:4], atol=2e-3)
    for frame in range(4):
        assert apart(clip.meshes[0].positions[frame], whole[frame]) < 1e-4
    # Across the block's end cloth doesn't start anew: it would jump by millimetres at once.
    found = np.asarray(clip.meshes[0].positions)
    moved = np.linalg.norm(np.diff(found, n=2, axis=0), axis=2).mean(axis=1)
    assert moved.max() < 3.0 * np.median(moved[5:])


@pytest.mark.release
def test_cloth_starts_anew_after_what_is_not_finite(guided, motion):
    q, p = motion.rotations[:24], motion.root[:24]
    broken = q.at[5, 3, 0].set(jnp.nan)
    found = cloth_of(guided, broken, p)
    window = guided.history_length()
    ok = np.asarray(found.ok)
    assert not ok[5] and ok[:5].all() and ok[5 + window + 2 :].all()


@pytest.mark.release
def test_people_side_by_side_do_not_see_each_other(guided, motion, apart):
    pairs = [(motion.rotations[k : k + 6], motion.root[k : k + 6]) for k in (0, 20)]
    both = [jnp.stack(x) for x in zip(*pairs, strict=True)]
    program = jax.jit(jax.vmap(lambda q, p: clothe(guided, q, p, 30.0)["bottom"]))
    together = program(*both)
    twice = program(*(jnp.stack([x[0], x[0]]) for x in both))
    np.testing.assert_array_equal(twice[0], together[0])
    for k, pair in enumerate(pairs):
        alone = cloth_of(guided, *pair)["bottom"]
        np.testing.assert_allclose(together[k][0], alone[0], atol=1e-3)
        # Later the two programs' rounding decides a few contacts.
        assert np.mean(np.abs(together[k][:3] - alone[:3]) > 1e-3) < 0.005
        other = cloth_of(guided, *pairs[1 - k])["bottom"]
        for frame in range(3):
            assert apart(together[k][frame], alone[frame]) < 1e-4
            assert apart(together[k][frame], other[frame]) > 1e-2


@pytest.mark.release
def test_gradients_by_the_pose(guided, motion, slope_error):
    """Along the root's height, in float64."""
    with jax.enable_x64(True):
        person = in_double(guided)
        q, p = wide((motion.rotations[2:6], motion.root[2:6]))

        @jax.jit
        def height(dy):
            moved = p.at[:, 1].add(dy[0] * jnp.arange(4.0))
            cloth = clothe(person, q, moved, 30.0)["bottom"]
            return jnp.mean(cloth[-1, :, 1])

        places = np.array([[0.0], [2e-4], [-3e-4], [5e-4], [-7e-4]])
        gradient = jax.jit(jax.grad(height))
        assert slope_error(height, gradient, places, (1e-7, 1e-8, 1e-9)) < 1e-5


@pytest.mark.nightly
def test_fabric_and_wind_act(motion):
    q, p = motion.rotations[:24], motion.root[:24]

    def last(wear, **options):
        dresser = make_dresser(
            [wear], method="guided", inference=NANO, simulation=Simulation(**options)
        )
        return np.asarray(cloth_of(dresser, q, p)["dress"][-1])

    calm, stiff = last("dress:fabric=silk"), last("dress:fabric=denim")
    blown = last("dress:fabric=silk", wind=(0.0, 0.0, -12.0))
    assert np.linalg.norm(stiff - calm, axis=1).max() > 0.005
    assert float(np.mean(blown[:, 2] - calm[:, 2])) < -0.002
    free = last("dress:fabric=silk", effects=None, substeps=16)
    assert np.isfinite(free).all()


@pytest.mark.release
def test_another_guide_and_other_rates(motion, guided):
    """A stronger guide holds the patches nearer; 60 frames a second are as far from 30 in bending
    as in substeps."""
    q, p = motion.rotations[:FRAMES], motion.root[:FRAMES]
    bare = Inference(weights="nano", strain_iterations=0, collisions=False)
    predicted = clothe(make_dresser(["bottom"], inference=bare), q, p, 30.0)["bottom"]
    away = []
    for seconds in (0.003, 0.1):
        options = Simulation(effects=(*STANDARD, Guide(time_constant=seconds)))
        found = make_dresser(["bottom"], method="guided", inference=NANO, simulation=options)
        x = cloth_of(found, q, p)["bottom"][-1]
        means = guided.guided.guide.means
        gap = means(x[:, :, None]) - means(predicted[-1][:, :, None])
        away.append(float(jnp.linalg.norm(gap[..., 0], axis=1).mean()))
    assert away[0] < 0.5 * away[1]
    fast = cloth_of(guided, q, p, fps=60.0)
    assert bool(fast.ok.all())
    assert _softness(240.0) == pytest.approx(8 / 128) and _softness(1e6) == 1.0


@pytest.mark.release
def test_options_that_it_has_not_are_refused(guided):
    for options in ({"engine": "bdf2"}, {"refine": 0.02}, {"accuracy": "fine"}):
        with pytest.raises(PhysXNetError, match="substeps and effects alone"):
            make_dresser(
                ["bottom"], method="guided", inference=NANO, simulation=Simulation(**options)
            )
    with pytest.raises(FormatError, match="at least 1"):
        Simulation(substeps=0)
    assert guided.strain is None and guided.colliders is None and guided.layers is None


@pytest.mark.release
def test_an_export_gives_the_clip(guided, motion, tmp_path, apart):
    """The state of the cloth is inside: any number of frames goes in, vertices come out."""
    q, p = motion.rotations[:5], motion.root[:5]
    export_dresser(tmp_path, guided, platforms=("cpu",))
    blob = bytearray((tmp_path / "dresser.jaxexport").read_bytes())
    vertices, ok = jax.jit(export.deserialize(blob).call)(q, p)
    assert bool(ok.all())
    np.testing.assert_allclose(vertices["bottom"], cloth_of(guided, q, p)["bottom"], atol=2e-3)
    for found, wanted in zip(vertices["bottom"], cloth_of(guided, q, p)["bottom"], strict=True):
        assert apart(found, wanted) < 1e-4


@pytest.mark.nightly
@pytest.mark.parametrize("kind", ["slim", "pencil-skirt"])
def test_denim_is_predicted_as_near_the_skin_as_cotton_is(kind):
    """No network learned from denim; seen as it is, it was thrown 10 cm off."""
    prediction = {
        fabric: np.asarray(
            dress(
                "walk",
                f"{kind}:fabric={fabric}",
                method="network",
                frames=12,
                include_body=False,
            )
            .garments[0]
            .positions
        )
        for fabric in ("cotton", "denim", "leather")
    }
    for fabric in ("denim", "leather"):
        apart = np.linalg.norm(prediction[fabric] - prediction["cotton"], axis=-1)
        assert np.sqrt(np.mean(apart**2)) < 0.02, fabric
