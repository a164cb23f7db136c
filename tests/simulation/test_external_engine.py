"""Other simulators: what they are handed and what is taken back, with a stand-in for them."""

import dataclasses
import sys

import jax.numpy as jnp
import numpy as np
import pytest

from physxnet_jax.errors import MissingDependencyError, SimulationError
from physxnet_jax.evaluation import PEER_CASES, run_peer
from physxnet_jax.garment import square_sheet
from physxnet_jax.motion import animate, load_motion
from physxnet_jax.simulation import Rollout, Scene, Status, prepare_scene
from physxnet_jax.simulation._external_engine import _max_depth, run_external_engine
from physxnet_jax.simulation.newton import find_newton

COPY = """
import json, pathlib, sys
import numpy as np
folder = pathlib.Path(sys.argv[-1])
data = np.load(folder / "scene.npz")
wanted = json.loads((folder / "settings.json").read_text())
for k in range(len(data["cloth"])):
    print(f"frame {k + 1}", flush=True)
np.savez(
    folder / "cloth.npz",
    positions=data["cloth"] + np.float32(wanted["lift"]),
    milliseconds=np.arange(len(data["cloth"])) * 1.0,
)
"""


@pytest.fixture(scope="module")
def scene():
    return prepare_scene(Scene((square_sheet(4),), ()))


@pytest.fixture(scope="module")
def motion():
    m = load_motion("walk", fps=30.0)
    return dataclasses.replace(m, rotations=m.rotations[:5], root=m.root[:5])


def test_external_engine_clip_excludes_the_warmup(tmp_path, scene, motion):
    script = tmp_path / "copy.py"
    script.write_text(COPY)
    seen = []
    command = [sys.executable, str(script)]
    out = run_external_engine(
        "Copy", command, scene, motion, {"lift": 1.0}, lambda *a: seen.append(a)
    )
    assert out.positions[0].shape == (5, 16, 3)
    flat = run_external_engine("Copy", command, scene, motion, {"lift": 0.0}, None)
    np.testing.assert_allclose(out.positions[0] - flat.positions[0], 1.0, atol=1e-5)
    a = scene.assembly
    f = jnp.float32
    skinned = animate(
        a.body,
        jnp.asarray(a.rest_body, f),
        jnp.asarray(a.rest, f),
        jnp.asarray(a.weights, f),
        motion,
    )
    np.testing.assert_allclose(flat.positions[0], skinned, atol=1e-5)
    total = seen[-1][1]
    assert seen[-1][0] == total and total > 5
    assert out.finite.all() and len(out.diagnostics["milliseconds"]) == 5


def test_penetration_depth_of_cloth_is_measured():
    import trimesh

    ball = trimesh.creation.icosphere(subdivisions=4)
    skin = np.asarray(ball.vertices, np.float32)[None].repeat(3, axis=0)
    cloth = np.zeros((3, 2, 3), np.float32)
    cloth[:, 0, 1] = (1.2, 0.7, np.nan)
    cloth[:, 1, 0] = 1.1
    found = _max_depth(cloth, skin, np.asarray(ball.faces))
    np.testing.assert_allclose(found, [0.0, 0.3, 0.0], atol=0.01)


def test_external_engine_failure_reports_its_last_output(tmp_path, scene, motion):
    script = tmp_path / "fail.py"
    script.write_text("print('no cloth today')\nraise SystemExit(3)\n")
    with pytest.raises(SimulationError, match=r"Copy ended with code 3.*no cloth today"):
        run_external_engine("Copy", [sys.executable, str(script)], scene, motion, {}, None)


def test_missing_newton_error_names_the_environment_variable(monkeypatch):
    monkeypatch.delenv("PHYSXNET_NEWTON", raising=False)
    with pytest.raises(MissingDependencyError, match="PHYSXNET_NEWTON"):
        find_newton()


@pytest.mark.release
def test_peer_engines_are_evaluated_from_positions_only():
    """A simulator that leaves the trousers at rest, far from a spinning body."""

    def lazy(scene: Scene, motion) -> Rollout:
        rest = prepare_scene(scene).assembly.rest.astype(np.float32)
        x = np.repeat(rest[None], motion.num_frames, axis=0)
        return Rollout((x,), motion.fps, {}, "lazy")

    seen = run_peer("first_frame_far_from_rest", lazy)
    assert seen["frames not finite"] == 0
    assert seen["99 % of edges at the end (strain)"] < 1e-6

    def broken(scene: Scene, motion) -> Rollout:
        out = lazy(scene, motion)
        out.positions[0][3] = np.nan
        return out

    assert run_peer("first_frame_far_from_rest", broken)["frames not finite"] == 1
    assert set(PEER_CASES) == {
        "first_frame_far_from_rest",
        "limbs_at_eight_times_their_speed",
        "a_teleport_of_two_metres",
        "closed_armpits_and_crossed_arms",
        "edges_of_ten_centimetres",
        "fifty_thousand_vertices",
        "a_lined_top",
        "a_cape_on_a_body_that_touches_itself",
        "sleeves_on_crossed_arms",
        "a_top_over_trousers",
        "a_squat_in_a_skirt",
        "a_full_skirt_spun_and_stopped",
        "a_strapless_dress_on_jumps",
        "wide_sleeves_on_crossed_arms",
    }


RISING = """
import pathlib, sys
import numpy as np
folder = pathlib.Path(sys.argv[-1])
data = np.load(folder / "scene.npz")
up = np.arange(len(data["cloth"]), dtype=np.float32)[:, None, None] * np.float32([0, 2.0, 0])
np.savez(folder / "cloth.npz", positions=data["cloth"] + up, milliseconds=np.zeros(len(up)))
"""


def test_external_engine_speed_is_in_metres_per_second(tmp_path):
    """Two metres a frame are sixty a second, of somebody who stands still."""
    script = tmp_path / "rising.py"
    script.write_text(RISING)
    scene = prepare_scene(Scene((square_sheet(4),), ()))
    walk = load_motion("walk", fps=30.0)
    still = dataclasses.replace(
        walk,
        rotations=jnp.repeat(walk.rotations[:1], 4, axis=0),
        root=jnp.repeat(walk.root[:1], 4, axis=0),
    )
    out = run_external_engine("Rising", [sys.executable, str(script)], scene, still, {}, None)
    np.testing.assert_allclose(out.diagnostics["speed_max"][1:], 60.0, rtol=1e-3)
    assert (out.status[1:] & Status.FAST).all()
