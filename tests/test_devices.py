"""Batches are split over devices and processes; the result is that of one device."""

import json
import os
import socket
import subprocess
import sys

import jax
import numpy as np
import pytest

from physxnet_jax.devices import at_home, join_processes, make_mesh, own_rows, repeated, split
from physxnet_jax.errors import PhysXNetError

# Trains a small network by plain gradient descent and writes its weights.
PROGRAM = """
import sys, pathlib
import numpy as np
from physxnet_jax.devices import join_processes
folder, devices, number, port = sys.argv[1], int(sys.argv[2]), sys.argv[3], sys.argv[4]
if number != "alone":
    join_processes("127.0.0.1:" + port, 2, int(number), patience=30)
import jax, optax
from physxnet_jax.data import Sequence
from physxnet_jax.garment import template
from physxnet_jax.models import ModelConfig
from physxnet_jax.motion import load_motion
from physxnet_jax.training import TrainConfig, train
import dataclasses
motion = load_motion("walk", fps=30.0)
motion = dataclasses.replace(motion, rotations=motion.rotations[:24], root=motion.root[:24])
rng = np.random.default_rng(0)
base = 0.02 * np.asarray(template("bottom").mesh.vertices)
offsets = (base[None] + rng.normal(0, 1e-3, (24, 1, 3))).astype(np.float32)
meta = {"bottom": {"finite": True, "worst": {"penetration_max": 0.0}}}
data = [Sequence(name, "train", motion, {"bottom": offsets}, meta) for name in ("walk", "held")]
config = TrainConfig(
    model=ModelConfig(resolution=32, width=4, templates=("bottom",)), epochs=int(sys.argv[7]), batch=4,
    discriminator_width=4, checkpoint_every=10, validation=("held",), validate_every=10,
    adversarial=False,
)
optimizer = optax.sgd(1e-4) if sys.argv[5] == "sgd" else None
predictor = train(config, data, folder, steps=int(sys.argv[6]), devices=devices, optimizer=optimizer)
if number in ("alone", "0"):
    leaves = [np.asarray(x) for x in jax.tree.leaves(predictor.state)]
    np.savez(pathlib.Path(folder) / "weights.npz", *leaves)
"""


def start(folder, *, devices=1, number="alone", port=0, optimizer="sgd", steps=20, epochs=8):
    """A process of its own, since devices are chosen once for each."""
    flags = f"--xla_force_host_platform_device_count={devices}"
    words = [str(folder), str(devices), number, str(port), optimizer, str(steps), str(epochs)]
    return subprocess.Popen(
        [sys.executable, "-c", PROGRAM, *words],
        env=os.environ | {"XLA_FLAGS": flags, "JAX_PLATFORMS": "cpu"},
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
    )


def finish(*processes):
    for p in processes:
        out, _ = p.communicate(timeout=240)
        assert p.returncode == 0, out[-2000:]


def weights(folder):
    with np.load(folder / "weights.npz") as data:
        return np.concatenate([data[k].ravel() for k in data.files])


def free_port():
    with socket.socket() as s:
        s.bind(("127.0.0.1", 0))
        return s.getsockname()[1]


def test_one_device_is_a_mesh_of_one():
    mesh = make_mesh(8)
    assert mesh.size == len(jax.local_devices()) or 8 % mesh.size == 0
    assert own_rows(8) == slice(0, 8)
    batch = split(mesh, {"x": np.arange(8.0)})
    np.testing.assert_array_equal(at_home(batch)["x"], np.arange(8.0))
    assert repeated(mesh, np.ones(3)).sharding.is_fully_replicated


def test_impossible_numbers_are_refused():
    with pytest.raises(PhysXNetError, match="this machine has"):
        make_mesh(8, devices=len(jax.local_devices()) + 1)
    with pytest.raises(PhysXNetError, match="belong together"):
        join_processes("127.0.0.1:1", None, 0)
    assert join_processes() == 0


@pytest.mark.nightly
def test_two_devices_learn_what_one_learns(tmp_path):
    finish(start(tmp_path / "one"), start(tmp_path / "two", devices=2))
    one, two = weights(tmp_path / "one"), weights(tmp_path / "two")
    assert np.abs(one - two).max() < 1e-5
    # Another optimizer doesn't come that near.
    finish(start(tmp_path / "adam", optimizer="adam"))
    assert np.abs(one - weights(tmp_path / "adam")).max() > 1e-5


@pytest.mark.nightly
def test_two_processes_learn_what_one_learns_and_resume_on_one_device(tmp_path):
    port = free_port()
    finish(
        start(tmp_path / "both", number="0", port=port, steps=10),
        start(tmp_path / "both", number="1", port=port, steps=10),
    )
    finish(start(tmp_path / "both"), start(tmp_path / "one"))
    assert np.abs(weights(tmp_path / "both") - weights(tmp_path / "one")).max() < 1e-5


def losses(folder):
    lines = [json.loads(line) for line in (folder / "metrics.jsonl").read_text().splitlines()]
    return np.array([[x["step"], x["loss"]] for x in lines if "loss" in x])


@pytest.mark.nightly
def test_losses_of_adam_agree_on_two_devices(tmp_path):
    finish(
        start(tmp_path / "one", optimizer="adam"),
        start(tmp_path / "two", devices=2, optimizer="adam"),
    )
    one, two = losses(tmp_path / "one"), losses(tmp_path / "two")
    np.testing.assert_array_equal(one[:, 0], two[:, 0])
    np.testing.assert_allclose(one[:, 1], two[:, 1], rtol=1e-3)


# With a second device as JAX's default, in the place of an accelerator.
PREPARE = """
import jax, jax.numpy as jnp
processor, other = jax.devices()
jax.config.update("jax_default_device", other)
from physxnet_jax.devices import prepared_on_processor
from physxnet_jax.dressing import clothe, make_dresser
from physxnet_jax.motion import load_motion
from physxnet_jax.simulation import XPBD, Scene, make_system, prepare_scene, simulate_batch
from physxnet_jax.garment import template
seen = []
@prepared_on_processor
def prepare():
    x = jnp.ones(3)
    seen.extend(x.devices())
    return {"x": x, "name": "a"}
made = prepare()
assert seen == [processor] and made["x"].devices() == {other} and not made["x"].committed
assert jnp.zeros(()).devices() == {other}, "the default is restored"
dresser = make_dresser(["bottom"], method="lbs")
scene = prepare_scene(Scene((template("bottom"),)))
for tree in (dresser, make_system(scene, XPBD(8, 1))):
    arrays = [x for x in jax.tree.leaves(tree) if isinstance(x, jax.Array)]
    assert arrays and all(x.devices() == {other} and not x.committed for x in arrays)
motion = load_motion("punch", fps=30.0)
out = clothe(dresser, motion.rotations[:2], motion.root[:2], 30.0)
assert out.vertices["bottom"].devices() == {other}
"""


@pytest.mark.release
def test_preparation_computes_on_the_processor_and_results_are_on_the_default_device():
    flags = {"XLA_FLAGS": "--xla_force_host_platform_device_count=2", "JAX_PLATFORMS": "cpu"}
    command = [sys.executable, "-c", PREPARE]
    subprocess.run(command, env=os.environ | flags, check=True, timeout=240)


SIMULATE = """
import sys, csv, dataclasses, pathlib
import jax, numpy as np
from physxnet_jax.data import DatasetConfig, build_dataset, dataset_digest
from physxnet_jax.garment import template
from physxnet_jax.motion import load_motion, save_motion
from physxnet_jax.simulation import (
    XPBD, Scene, prepare_scene, simulate_batch
)
folder, devices = pathlib.Path(sys.argv[1]), len(jax.local_devices())
clip = load_motion("punch", fps=30.0)
def part(at, frames):
    return dataclasses.replace(
        clip, rotations=clip.rotations[at : at + frames], root=clip.root[at : at + frames]
    )
garment = template("bottom")
scene = prepare_scene(Scene((garment,)))
people = [part(0, 3), part(5, 4), part(9, 2)]
solver = XPBD(8, 2)
# Two at a time: with one person each, another program would run.
if devices == 1:
    out = [*simulate_batch(scene, people[:2], solver=solver)]
    out += simulate_batch(scene, [people[2], people[2]], solver=solver)[:1]
else:
    out = simulate_batch(scene, people, solver=solver)
assert [len(r.positions[0]) for r in out] == [3, 4, 2]
values = {f"x{k}": r.positions[0] for k, r in enumerate(out)}
values |= {f"d{k}{n}": v for k, r in enumerate(out) for n, v in r.diagnostics.items()}
np.savez(folder / "out.npz", **values)
mocap = folder / "mocap"
mocap.mkdir()
save_motion(mocap / "punch.npz", part(0, 40))
with (mocap / "ACTIONS.csv").open("w", newline="") as file:
    table = csv.writer(file)
    table.writerow(["split", "action", "file", "start_s", "frames_at_30fps"])
    table.writerows(["train", f"part {k}", "punch.npz", 0.3 * k, 5 + k] for k in range(3))
config = DatasetConfig(splits=("train",), templates=("bottom",), people=2, solver=XPBD(8, 1))
assert build_dataset(config, folder / "set", mocap) == 3
(folder / "digest.txt").write_text(dataset_digest(folder / "set")[0])
"""


@pytest.mark.nightly
def test_people_and_datasets_are_simulated_the_same_on_two_devices(tmp_path):
    found = []
    for devices in (1, 2):
        folder = tmp_path / str(devices)
        folder.mkdir()
        flags = {"XLA_FLAGS": f"--xla_force_host_platform_device_count={devices}"}
        command = [sys.executable, "-c", SIMULATE, str(folder)]
        subprocess.run(command, env=os.environ | flags, check=True, timeout=400)
        with np.load(folder / "out.npz") as data:
            found.append({k: data[k] for k in data.files})
        found[-1]["digest"] = (folder / "digest.txt").read_text()
    one, two = found
    assert one["digest"] == two["digest"]
    assert one.keys() == two.keys()
    for name, value in one.items():
        np.testing.assert_array_equal(value, two[name], err_msg=name)
