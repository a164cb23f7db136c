"""Clips of any length share a few compiled programs."""

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
    for n in (1, 5, 21):
        q, p = motion.rotations[:n], motion.root[:n]
        found, expected = clothe(dresser, q, p, 30.0), alone(dresser, q, p, fps=30.0)
        assert found["bottom"].shape == (n, 2726, 3) and found.ok.shape == (n,)
        np.testing.assert_allclose(found["bottom"], expected["bottom"], atol=1e-5)
        # As a pipeline of one's own pads it.
        padded = alone(dresser, *px.pad_frames(q, p), fps=30.0)
        np.testing.assert_array_equal(padded["bottom"][:n], found["bottom"])
    bad = clothe(dresser, motion.rotations[:5].at[4, 0].set(jnp.nan), motion.root[:5], 30.0)
    np.testing.assert_array_equal(bad.ok, [True] * 4 + [False])


@pytest.mark.release
def test_lengths_share_programs():
    dresser = make_dresser(["bottom"], method="lbs")
    motion = load_motion("walk", fps=30.0)
    q, p = np.asarray(motion.rotations), np.asarray(motion.root)
    lengths = np.random.default_rng(0).integers(1, 100, size=60)
    before = _clothe._clothe_jitted._cache_size()
    for n in lengths:
        clothe(dresser, jnp.asarray(q[:n]), jnp.asarray(p[:n]), 30.0)
    assert len(set(lengths)) > 40
    assert _clothe._clothe_jitted._cache_size() - before <= 10


SOAK = """
import pathlib, resource, time
import jax.numpy as jnp
import numpy as np
import physxnet_jax as px
maps = lambda: len(pathlib.Path("/proc/self/maps").read_text().splitlines())
rng = np.random.default_rng(0)
motion = px.load_motion("walk", fps=30.0)
q, p = np.asarray(motion.rotations), np.asarray(motion.root)
inference = px.Inference(weights="nano")
kinds = ["shirt", "trousers", "shorts", "skirt", "tee"]
times = []
for k in range(50):
    word = f"{kinds[k % 5]}:ease={0.06 + 0.0015 * k:.4f}"
    dresser = px.make_dresser([word], inference=inference)
    for _ in range(20):
        n = int(rng.integers(1, 100))
        began = time.perf_counter()
        np.asarray(list(px.clothe(dresser, jnp.asarray(q[:n]), jnp.asarray(p[:n]), 30.0).values())[0])
        times.append((time.perf_counter() - began) / n)
print(maps(), resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e6)
print(np.median(times[:200]), np.median(times[-200:]))
"""


@pytest.mark.nightly
@pytest.mark.skipif(sys.platform != "linux", reason="reads /proc")
@pytest.mark.xfail(strict=True, reason="a program for each length, see docs/reliability.md")
def test_a_thousand_lengths_and_fifty_garments_end_as_they_began():
    out = subprocess.run([sys.executable, "-c", SOAK], capture_output=True, text=True, check=True)
    (maps, gigabytes), _ = (map(float, line.split()) for line in out.stdout.splitlines()[-2:])
    assert maps < 5000 and gigabytes < 1.5
