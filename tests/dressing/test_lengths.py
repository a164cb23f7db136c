"""Clips of any length share a few compiled programs."""

import os
import subprocess
import sys

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import physxnet_jax as px
from physxnet_jax.dressing import Inference, _clothe, clothe, make_dresser, pad_frames
from physxnet_jax.motion import load_motion

NANO = Inference(weights="nano")


def test_lengths_are_few_and_near():
    found = {n: _clothe._padded_length(n) for n in range(1, 3000)}
    assert len(set(found.values())) < 22
    assert all(v >= n for n, v in found.items())
    assert all(v <= 2 * n for n, v in found.items())
    assert all(v < 1.5 * n for n, v in found.items() if n > 16)


def test_what_is_repeated_is_the_last_pose():
    q = jnp.arange(5 * 2 * 4.0).reshape(5, 2, 4)
    p = jnp.arange(5 * 3.0).reshape(5, 3)
    q8, p8 = pad_frames(q, p)
    np.testing.assert_array_equal(q8[:5], q)
    np.testing.assert_array_equal(p8[5:], jnp.broadcast_to(p[4], (3, 3)))
    whole = jnp.zeros((16, 2, 4)), jnp.zeros((16, 3))
    assert all(a is b for a, b in zip(pad_frames(*whole), whole, strict=True))


@pytest.mark.release
@pytest.mark.parametrize("method", ["lbs", "network"])
def test_padded_clips_have_the_cloth_of_the_clip(method):
    motion = load_motion("punch", fps=30.0)
    dresser = make_dresser(["bottom"], method=method, inference=NANO)
    alone = jax.jit(clothe, static_argnames="fps")
    for n in (1, 5, 37):
        q, p = motion.rotations[:n], motion.root[:n]
        found, expected = clothe(dresser, q, p, 30.0), alone(dresser, q, p, fps=30.0)
        assert found["bottom"].shape == (n, 2726, 3) and found.ok.shape == (n,)
        np.testing.assert_allclose(found["bottom"], expected["bottom"], atol=1e-5)
        # As a pipeline of one's own pads it.
        padded = alone(dresser, *px.pad_frames(q, p), fps=30.0)
        np.testing.assert_allclose(padded["bottom"][:n], found["bottom"], atol=1e-5)
    bad = clothe(dresser, motion.rotations[:5].at[4, 0].set(jnp.nan), motion.root[:5], 30.0)
    np.testing.assert_array_equal(bad.ok, [True] * 4 + [False])


@pytest.mark.release
def test_lengths_share_programs(caplog):
    dresser = make_dresser(["bottom"], method="lbs")
    motion = load_motion("walk", fps=30.0)
    q, p = np.asarray(motion.rotations), np.asarray(motion.root)
    lengths = np.random.default_rng(0).integers(1, 100, size=60)
    with jax.log_compiles():
        for n in lengths:
            clothe(dresser, jnp.asarray(q[:n]), jnp.asarray(p[:n]), 30.0)
    assert len(set(lengths)) > 40
    made = [r.getMessage() for r in caplog.records if "Finished XLA compilation" in r.getMessage()]
    # For cloth one of each length of a block, for poses one of each padded length.
    assert sum("_clothe_block" in m for m in made) <= 2
    # Those of `jnp.asarray` are this test's own, one for each length and more.
    own = sum("jit(stage)" in m for m in made)
    assert own > 40 and len(made) - own <= 16


SOAK = """
import pathlib, resource, time
import jax
import numpy as np
import physxnet_jax as px
maps = lambda: len(pathlib.Path("/proc/self/maps").read_text().splitlines())
rng = np.random.default_rng(0)
motion = px.load_motion("walk", fps=30.0)
q, p = np.asarray(motion.rotations), np.asarray(motion.root)
inference = px.Inference(weights="nano")
kinds = ["shirt", "trousers", "shorts", "skirt", "tee"]
times, most = [], 0
for k in range(50):
    word = f"{kinds[k % 5]}:ease={0.06 + 0.0015 * k:.4f}"
    dresser = px.make_dresser([word], inference=inference)
    for _ in range(20):
        n = int(rng.integers(1, 100))
        began = time.perf_counter()
        poses = jax.device_put(q[:n]), jax.device_put(p[:n])
        np.asarray(list(px.clothe(dresser, *poses, 30.0).values())[0])
        times.append((time.perf_counter() - began) / n)
        most = max(most, maps())
print(most, resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e6)
print(np.median(times[:200]), np.median(times[-200:]))
"""


@pytest.mark.nightly
@pytest.mark.skipif(sys.platform != "linux", reason="reads /proc")
def test_a_thousand_lengths_and_fifty_garments_end_as_they_began(promise):
    # As the commands have it: the allocator of glibc keeps a heap for each thread.
    env = {**os.environ, "MALLOC_ARENA_MAX": "1"}
    run = [sys.executable, "-c", SOAK]
    out = subprocess.run(run, capture_output=True, text=True, check=True, env=env)
    (maps, gigabytes), (early, late) = (map(float, s.split()) for s in out.stdout.splitlines()[-2:])
    what = "1,000 clips of random lengths in fifty garments"
    promise("programs are bounded", f"{what}: memory maps at most", maps, "maps")
    promise("programs are bounded", f"{what}: memory at most", 1e3 * gigabytes, "MB")
    promise("programs are bounded", f"{what}: time of the last over the first", late / early, "x")
    assert maps < 5000 and gigabytes < 1.5
