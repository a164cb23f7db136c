"""Clothes as a layer: live, batched, differentiated and exported, always the same."""

import dataclasses
import json
import os
import runpy
import subprocess
import sys

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from physxnet_jax.dressing import (
    Inference,
    clothe,
    clothe_step,
    dress,
    export_dresser,
    init_stream,
    make_dresser,
    with_shape,
)
from physxnet_jax.dressing._clothe import _check_pose
from physxnet_jax.errors import PhysXNetError
from physxnet_jax.models import PAPER, fold_batch_norm, load_predictor
from physxnet_jax.motion import _transforms, load_motion


@pytest.fixture(scope="module")
def whole(dresser, motion):
    return jax.jit(clothe, static_argnames="fps")(dresser, *motion, fps=30.0)


@pytest.mark.release
def test_clothe_matches_dress(whole, motion):
    from physxnet_jax.motion import make_motion

    clip = make_motion(*(np.asarray(x) for x in motion), 30.0)
    positions = dress(clip, ["bottom"], method="network", include_body=False).garments[0].positions
    np.testing.assert_allclose(np.asarray(whole["bottom"]), positions, atol=1e-5)


@pytest.mark.release
def test_stream_matches_the_clip(dresser, whole, motion):
    step = jax.jit(clothe_step, static_argnames="fps", donate_argnames="stream")
    rotations, root = motion
    stream = init_stream(dresser, rotations, root)
    for k in range(len(rotations)):
        stream, cloth = step(dresser, stream, rotations[k], root[k], fps=30.0)
        np.testing.assert_allclose(
            np.asarray(cloth["bottom"]), np.asarray(whole["bottom"][k]), atol=1e-5
        )


@pytest.mark.release
def test_vmap_batches_over_people(dresser, whole, motion):
    rotations, root = motion
    crowd = jnp.stack([root, root + jnp.array([[1.0, 0.0, 2.0]])])
    out = jax.jit(jax.vmap(lambda p: clothe(dresser, rotations, p, 30.0)))(crowd)["bottom"]
    np.testing.assert_allclose(np.asarray(out[0]), np.asarray(whole["bottom"]), atol=1e-5)
    moved = np.asarray(out[1]) - np.array([1.0, 0.0, 2.0], np.float32)
    np.testing.assert_allclose(moved, np.asarray(whole["bottom"]), atol=1e-4)


@pytest.fixture(scope="module")
def shapes(dresser):
    body = dresser.body
    return jnp.stack([body.shape(weight_up=0.6), body.default_shape(), body.shape(height_up=0.5)])


def _with_collisions(dresser, wanted):
    return dresser if wanted else dataclasses.replace(dresser, colliders=None, layers=None)


@pytest.mark.nightly
def test_with_shape_matches_a_dresser_made_for_the_shape(dresser, shapes, motion):
    for collisions in (False, True):
        mine = _with_collisions(dresser, collisions)
        made = make_dresser(["bottom"], shape=shapes[0], inference=Inference(collisions=collisions))
        run = jax.jit(lambda d: clothe(d, *motion, 30.0)["bottom"])
        moved, wanted, before = run(with_shape(mine, shapes[0])), run(made), run(mine)
        np.testing.assert_allclose(np.asarray(moved), np.asarray(wanted), atol=1e-5)
        assert float(jnp.linalg.norm(before - wanted, axis=2).mean()) > 2e-3, "another shape"


@pytest.mark.release
def test_with_shape_supports_vmap_and_gradients(dresser, shapes, motion):
    """A crowd by vmap is one after the other; the slope by a parameter is the difference's."""

    @jax.jit
    def cloth(shape):
        person = with_shape(_with_collisions(dresser, False), shape)
        return clothe(person, *motion, 30.0)["bottom"]

    crowd = jax.jit(jax.vmap(cloth))(shapes)
    for k, shape in enumerate(shapes):
        np.testing.assert_allclose(np.asarray(crowd[k]), np.asarray(cloth(shape)), atol=1e-5)

    def girth(shape):
        return jnp.mean(cloth(shape)[..., 2] ** 2)

    at = shapes[0]
    way = shapes[0] - shapes[1]
    slope = float(jax.jit(jax.grad(girth))(at) @ way)
    step = 0.05
    ends = [float(girth(at + s * way)) for s in (step, -step)]
    assert slope == pytest.approx((ends[0] - ends[1]) / (2 * step), rel=0.03)
    assert abs(slope) > 1e-5


def test_with_shape_is_refused_for_a_dress_of_the_paper_family(dresser):
    config = dataclasses.replace(load_predictor("paper").config, inputs=PAPER)
    worn = (dataclasses.replace(dresser.worn[0], template="dress"),)
    predictor = dataclasses.replace(dresser.predictor, config=config)
    skirt = dataclasses.replace(dresser, predictor=predictor, worn=worn)
    with pytest.raises(ValueError, match="make_dresser"):
        with_shape(skirt, dresser.body.default_shape())


@pytest.mark.nightly
def test_cloth_height_follows_the_root_one_to_one(dresser, motion):
    """The mean height of the cloth rises with the root, one for one, whatever is between."""
    rotations, root = motion

    @jax.jit
    def height(lift):
        cloth = clothe(dresser, rotations, root + lift * jnp.array([[0.0, 1.0, 0.0]]), 30.0)
        return jnp.mean(cloth["bottom"][..., 1])

    value, slope = jax.jvp(height, (jnp.float32(0.0),), (jnp.float32(1.0),))
    assert np.isfinite(value)
    assert float(slope) == pytest.approx(1.0, abs=2e-3)
    assert float(jax.grad(height)(jnp.float32(0.0))) == pytest.approx(1.0, abs=2e-3)


@pytest.mark.release
def test_exported_dresser_runs_without_this_package(dresser, whole, motion, tmp_path):
    pytest.importorskip("flatbuffers")
    files = export_dresser(tmp_path / "out", dresser, name="base")
    assert all(f.is_file() for f in files)
    card = json.loads((tmp_path / "out" / "card.json").read_text())
    assert card["garments"] == {"bottom": 2726} and card["weights"]["name"] == "base"
    assert card["strain_iterations"] == 8 and not card["tta"] and card["collisions"]
    assert card["platforms"] == ["cpu", "cuda"], "lowered for both, wherever it is written"
    faces = np.load(tmp_path / "out" / "garments.npz")["bottom_faces"]
    assert faces.max() == 2725
    np.savez(tmp_path / "motion.npz", rotations=motion[0], root=motion[1])
    script = tmp_path / "use.py"
    script.write_text(
        "import sys, numpy as np\n"
        "sys.modules['physxnet_jax'] = None\n"
        f"sys.path.insert(0, {str(tmp_path / 'out')!r})\n"
        "from dress import load\n"
        f"m = np.load({str(tmp_path / 'motion.npz')!r})\n"
        f"run = load({str(tmp_path / 'out')!r})\n"
        "short, ok = run(m['rotations'][:2], m['root'][:2])\n"
        "assert short['bottom'].shape[0] == 2 and ok.tolist() == [True, True]\n"
        f"np.save({str(tmp_path / 'cloth.npy')!r}, run(m['rotations'], m['root'])[0]['bottom'])\n"
    )
    done = subprocess.run([sys.executable, str(script)], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr[-2000:]
    np.testing.assert_allclose(
        np.load(tmp_path / "cloth.npy"), np.asarray(whole["bottom"]), atol=1e-5
    )
    (tmp_path / "out" / "dresser.jaxexport").write_bytes(b"spoiled")
    done = subprocess.run([sys.executable, str(script)], capture_output=True, text=True)
    assert done.returncode != 0 and "damaged" in done.stderr


@pytest.mark.nightly
def test_template_binding_is_unchanged_on_a_scaled_body(body):
    large = dataclasses.replace(body, bases=1.15 * body.bases, deltas=1.15 * body.deltas)
    ours, theirs = (
        make_dresser(
            ["bottom"],
            body=b,
            inference=Inference(weights="nano", strain_iterations=0, collisions=False),
        )
        for b in (body, large)
    )
    tied = theirs.worn[0].binding
    assert tied.hit_rate > 0.95 and tied.fallbacks <= ours.worn[0].binding.fallbacks + 30
    same = np.asarray(tied.texel) == np.asarray(ours.worn[0].binding.texel)
    assert same.all(axis=1).mean() > 0.9


def test_unknown_platforms_are_refused_with_the_known_ones(dresser, tmp_path):
    with pytest.raises(PhysXNetError, match="no platform 'toaster'; there are cpu"):
        export_dresser(tmp_path / "out", dresser, platforms=("cpu", "toaster"))
    assert not (tmp_path / "out").exists()


def test_garments_without_a_decoder_are_refused():
    with pytest.raises(PhysXNetError, match="one of tee, shirt"):
        make_dresser(["cape"])


@pytest.mark.release
def test_garment_sizes_share_one_compiled_program(dresser, motion):
    """Sizes of one pattern share a compiled program, whatever is told of their files."""
    base = dresser.garments[0]
    wide = base.mesh.replace(vertices=base.mesh.vertices * jnp.float32([[1.03, 1.0, 1.03]]))
    other = make_dresser(
        [dataclasses.replace(base, mesh=wide)],
        inference=Inference(weights=dresser.predictor, strain_iterations=0),
    )
    one = make_dresser([base], inference=Inference(weights=dresser.predictor, strain_iterations=0))
    noted = dataclasses.replace(other, notes=type(other.notes)(["too wide"]))
    assert noted.notes[0] == "too wide" and tuple(one.notes) != tuple(noted.notes)
    assert jax.tree.structure(one) == jax.tree.structure(noted)
    counted = jax.jit(lambda d: d.worn[0].rest.sum())
    counted(one), counted(noted)
    assert counted._cache_size() == 1


def test_empty_clips_are_refused(dresser, motion):
    q, p = motion
    with pytest.raises(ValueError, match="no frames"):
        clothe(dresser, q[:0], p[:0], fps=30.0)
    with pytest.raises(ValueError, match="no pose"):
        init_stream(dresser, q[:0], p[:0])


@pytest.mark.release
def test_two_frame_clip_matches_the_start_of_a_longer_one(dresser, whole, motion):
    """A clip of two frames is the first two of a longer one, live as well."""
    q, p = motion
    two = jax.jit(clothe, static_argnames="fps")(dresser, q[:2], p[:2], fps=30.0)
    np.testing.assert_allclose(two["bottom"], np.asarray(whole["bottom"])[:2], atol=1e-5)
    stream = init_stream(dresser, q[:2], p[:2])
    cloth = clothe_step(dresser, stream, q[0], p[0], fps=30.0)[1]
    np.testing.assert_allclose(cloth["bottom"], np.asarray(whole["bottom"])[0], atol=1e-5)


@pytest.mark.release
def test_poses_of_another_skeleton_are_refused_under_jit_too(dresser, motion):
    q, p = motion
    wrong = [(q[:, :22], p), (jnp.tile(q, (1, 2, 1)), p)]
    for rotations, root in wrong:
        with pytest.raises(ValueError, match="31 joints"):
            jax.jit(clothe, static_argnames="fps")(dresser, rotations, root, fps=30.0)
    # Where types aren't checked, these come this far.
    for rotations, root in [*wrong, (q, p[:2]), (q[0], p[0]), (q[None], p[None])]:
        with pytest.raises(ValueError, match="31 joints"):
            _check_pose(dresser.body, rotations, root, ("frames",))
    with pytest.raises(ValueError, match="31 joints"):
        init_stream(dresser, q[0, :24], p[0])
    stream = init_stream(dresser, q[0], p[0])
    with pytest.raises(ValueError, match="31 joints"):
        clothe_step(dresser, stream, q[0, :24], p[0], fps=30.0)
    with pytest.raises(ValueError, match=r"9 parameters, .*height"):
        with_shape(dresser, jnp.ones(5))


@pytest.mark.nightly
def test_dress_accepts_a_predictor_and_a_single_garment_name(dresser, motion):
    known = dresser.predictor
    clip = dress("walk", "bottom", method="network", inference=Inference(weights=known), frames=2)
    again = dress("walk", ["bottom"], method="network", frames=2)
    np.testing.assert_array_equal(clip.garments[0].positions, again.garments[0].positions)


def test_weights_can_be_loaded_under_jit(motion):
    @jax.jit
    def total(x):
        return x * jax.tree.leaves(load_predictor("nano").state)[0].sum()

    want = float(jax.tree.leaves(load_predictor("nano").state)[0].sum())
    assert float(total(jnp.ones(()))) == pytest.approx(want, rel=1e-5)


@pytest.mark.nightly
def test_predictor_is_moved_to_the_requested_body(dresser, shapes, motion):
    """Its texels are put onto the body that is asked for, whatever body they were on."""
    heavy = make_dresser(["bottom"], shape=shapes[0])
    again = make_dresser(
        ["bottom"], inference=Inference(weights=heavy.predictor, strain_iterations=0)
    )
    usual = make_dresser(
        ["bottom"],
        inference=Inference(weights=fold_batch_norm(load_predictor()), strain_iterations=0),
    )
    a, b = (clothe(d, *(x[:3] for x in motion), 30.0) for d in (again, usual))
    np.testing.assert_allclose(a["bottom"], b["bottom"], atol=1e-6)
    other = clothe(heavy, *(x[:3] for x in motion), 30.0)
    assert np.abs(np.asarray(other["bottom"] - a["bottom"])).max() > 5e-3


def test_notes_do_not_cause_recompilation(dresser):
    told = dataclasses.replace(dresser, notes=("a",))
    other = dataclasses.replace(dresser, notes=("b",))
    traced = []

    @jax.jit
    def same(d):
        traced.append(1)
        return d

    assert same(told).notes == same(other).notes == () and len(traced) == 1
    assert told.notes == ("a",) and jax.tree.structure(told) == jax.tree.structure(other)


@pytest.mark.nightly
def test_shard_map_distributes_people_over_devices(tmp_path):
    """In a process of two devices: one person on each is what one process says of both."""
    code = """
import jax, jax.numpy as jnp, numpy as np
from jax.sharding import Mesh, PartitionSpec as P
import physxnet_jax as px
dresser = px.make_dresser(["bottom"], inference=px.Inference(weights="nano"))
motion = px.load_motion("walk", fps=30)
q = jnp.stack([motion.rotations[:2], motion.rotations[2:4]])
p = jnp.stack([motion.root[:2], motion.root[2:4]])
mesh = Mesh(np.array(jax.devices()), ("people",))
move = jax.vmap(jax.vmap(lambda a, b: dresser.body.transforms(dresser.rest, a, b)[1]))
wear = jax.vmap(lambda a, b: px.clothe(dresser, a, b, 30.0)["bottom"])
each, all_alike = P("people"), P()
for f, specs in ((move, (each, all_alike)), (move, (all_alike, each)), (wear, (each, each))):
    args = [x if s == each else x[:1] for x, s in zip((q, p), specs)]
    wide = [jnp.concatenate([x, x]) if len(x) == 1 else x for x in args]
    spread = jax.jit(jax.shard_map(f, mesh=mesh, in_specs=specs, out_specs=each))
    gap = jnp.abs(spread(*args) - jax.jit(f)(*wide)).max()
    assert gap < 1e-5, (specs, gap)
# What is measured on the other device runs there, whatever was made on the first before.
other = jax.devices()[1]
with jax.default_device(other):
    anew = px.make_dresser(["bottom"], inference=px.Inference(weights="nano"))
    there = jax.jit(lambda d, a, b: px.clothe(d, a, b, 30.0)["bottom"])(anew, q[0], p[0])
assert there.devices() == {other}, there.devices()
here = px.clothe(dresser, q[0], p[0], 30.0)["bottom"]
assert np.abs(np.asarray(there) - np.asarray(here)).max() < 1e-5
print(len(jax.devices()), "devices")
"""
    flags = f"{os.environ.get('XLA_FLAGS', '')} --xla_force_host_platform_device_count=2"
    done = subprocess.run(
        [sys.executable, "-c", code],
        env=os.environ | {"XLA_FLAGS": flags.strip(), "JAX_PLATFORMS": "cpu"},
        cwd=tmp_path,
        capture_output=True,
        text=True,
        timeout=600,
    )
    assert done.returncode == 0 and "2 devices" in done.stdout, done.stderr[-2000:]


@pytest.mark.sampled(1)
@pytest.mark.release
@pytest.mark.parametrize("fps", [30.0, 120.0])
def test_clip_starts_without_a_jump(fps, monkeypatch):
    """Clips cut out of a walk begin as the walk goes on, however many frames there are a second."""
    walk = load_motion("walk", fps=fps)
    inference = Inference(weights="nano", strain_iterations=0, collisions=False)
    dresser = make_dresser(["trousers"], inference=inference)
    run = jax.jit(clothe, static_argnames="fps")
    whole = np.asarray(run(dresser, walk.rotations, walk.root, fps=fps)["trousers"])
    frames = int(0.4 * fps)

    def begin(still):
        """Mean error of eight starts to the whole walk, and largest acceleration over its own."""
        errors, jumps = [], []
        for k in range(1, 9):
            start = int(0.3 * k * fps)
            q, p, true = (x[start : start + frames] for x in (walk.rotations, walk.root, whole))
            if still:
                # The control: somebody who stood still until then is thrown into motion.
                q, p = (jnp.concatenate([x[:1], x]) for x in (q, p))
            cloth = np.asarray(run(dresser, q, p, fps=fps)["trousers"])[int(still) :]
            errors.append(np.sqrt(np.mean(np.sum((cloth - true) ** 2, axis=-1))))
            second = [np.linalg.norm(np.diff(x[:6], n=2, axis=0), axis=2) for x in (cloth, true)]
            now, usual = (np.quantile(x, 0.99, axis=1).max() for x in second)
            jumps.append(now / usual)
        return np.mean(errors), np.max(jumps)

    error, jump = begin(still=False)
    thrown_error, thrown = begin(still=True)
    assert jump < 2.0
    assert error < 0.8 * thrown_error
    if fps > 100:
        assert thrown > 5.0
    with monkeypatch.context() as patch:
        # The other control: limbs that have always turned as in the first frames.
        patch.setattr(_transforms, "_SWING", 1e6)
        jax.clear_caches()
        assert error < 0.9 * begin(still=False)[0]
    jax.clear_caches()
    clip = dataclasses.replace(walk, rotations=walk.rotations[15:47], root=walk.root[15:47])
    worn = run(dresser, clip.rotations, clip.root, fps=fps)["trousers"]
    again = dress(
        clip, ["trousers"], method="network", inference=inference, fps=fps, include_body=False
    )
    np.testing.assert_allclose(again.garments[0].positions, worn, atol=1e-5)


@pytest.mark.release
def test_exported_dresser_uses_its_frame_rate(dresser, motion, tmp_path):
    """Velocities are metres a second: the same poses twice as fast are another cloth."""
    pytest.importorskip("flatbuffers")
    export_dresser(tmp_path, dresser, fps=60.0, platforms=("cpu",))
    load = runpy.run_path(str(tmp_path / "dress.py"))["load"]
    cloth, ok = load(tmp_path)(*motion)
    run = jax.jit(clothe, static_argnames="fps")
    usual, fast = (np.asarray(run(dresser, *motion, fps=f)["bottom"]) for f in (30.0, 60.0))
    assert bool(ok.all()) and np.abs(fast - usual).max() > 1e-3
    np.testing.assert_allclose(np.asarray(cloth["bottom"]), fast, atol=1e-5)
