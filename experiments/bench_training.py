"""What the convolution that stands in for a transposed one is worth in training.

Command: python experiments/bench_training.py
         --resolution 256 --width 64 --batch 4, --rounds 3,
         --out experiments/results/training.json
Cost:    four minutes on two cores.
Result:  training.json and .md: seconds of a training step of the paper's network
         (generator and discriminator, three decoders) with its decoders' layers as a 2x2
         convolution, interleaved, and as the plain transposed convolution, both in
         turns; the L1 losses of both; and what preparing a batch on the host takes.

The frames are a built-in walk with cloth that hangs still: times don't depend on them.
"""

import argparse
import json
import os
import pathlib
import statistics
import time
from unittest import mock

import jax
import jax.numpy as jnp
import numpy as np
from rich.progress import Progress

from physxnet_jax.body import load_body
from physxnet_jax.data import Frames, Sequence, load_frames, make_wardrobe, take
from physxnet_jax.files import atomic_write
from physxnet_jax.garment import TEMPLATES, template
from physxnet_jax.models import PAPER, ModelConfig, Normalisation, Up
from physxnet_jax.motion import load_motion
from physxnet_jax.training import TrainConfig, make_problem, prepare_targets, train_step

RESULTS = pathlib.Path(__file__).parent / "results"


def plain_transposed(layer: Up, x: jax.Array) -> jax.Array:
    """The layer as the paper writes it: a transposed convolution of stride two."""
    kernel = layer.kernel[...].astype(x.dtype)[::-1, ::-1]
    x = jax.lax.conv_general_dilated(
        x,
        kernel,
        (1, 1),
        ((2, 2), (2, 2)),
        lhs_dilation=(2, 2),
        dimension_numbers=("NHWC", "HWIO", "NHWC"),
    )
    if layer.bias is not None:
        x = x + layer.bias[...].astype(x.dtype)[None, None, None]
    return x if layer.norm is None else layer.norm(x)


def walking_frames() -> Frames:
    """Frames of the built-in walk, each cloth on its skinning."""
    motion = load_motion("walk", fps=30.0)
    still = {
        t: np.zeros((motion.num_frames, template(t).num_vertices, 3), np.float32) for t in TEMPLATES
    }
    meta = {t: {"finite": True, "worst": {"penetration_max": 0.0}} for t in TEMPLATES}
    return load_frames(
        [Sequence("walk", "train", motion, still, meta)],
        make_wardrobe([None], TEMPLATES),
        load_body(),
        window=PAPER.window,
        local=False,
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--resolution", type=int, default=256)
    parser.add_argument("--width", type=int, default=64)
    parser.add_argument("--batch", type=int, default=4)
    parser.add_argument("--rounds", type=int, default=3)
    parser.add_argument("--out", default=str(RESULTS / "training.json"))
    words = parser.parse_args()
    model = ModelConfig(PAPER, resolution=words.resolution, width=words.width)
    config = TrainConfig(model=model, batch=words.batch)
    frames = walking_frames()
    atlas, surface, tables = prepare_targets(model)
    one = jnp.ones(())
    scales = Normalisation(one, one, {t: 0.01 * one for t in TEMPLATES})
    forms, laps, losses, cold = ("fast", "plain"), {}, {}, {}
    with Progress() as bars:
        bar = bars.add_task("steps", total=2 * (words.rounds + 1))
        batch, host = batch_of(frames, config, 0)
        runs = {}
        for form in forms:
            # Traced while the layer is what the form says.
            way = plain_transposed if form == "plain" else Up.__call__
            with mock.patch.object(Up, "__call__", way):
                problem, first = make_problem(
                    config, atlas, surface, scales, tables, fps=frames.fps, steps=100
                )
                began = time.perf_counter()
                state, metrics = jax.block_until_ready(
                    train_step(problem, first, batch, jax.random.key(0))
                )
                cold[form] = time.perf_counter() - began
            runs[form], losses[form], laps[form] = (problem, state), float(metrics["l1"]), []
            bars.update(bar, advance=1)
        prepared = []
        for k in range(words.rounds):
            batch, host = batch_of(frames, config, k + 1)
            prepared.append(host)
            for form, (problem, state) in runs.items():
                began = time.perf_counter()
                jax.block_until_ready(train_step(problem, state, batch, jax.random.key(k)))
                laps[form].append(time.perf_counter() - began)
                bars.update(bar, advance=1)
    rows = [
        {
            "form": form,
            "s_per_step": statistics.median(laps[form]),
            "cold_s": cold[form],
            "l1_first_step": losses[form],
        }
        for form in forms
    ]
    data = {
        "machine": f"{os.cpu_count()} cores; {jax.devices()[0].device_kind}; jax {jax.__version__}",
        "resolution": words.resolution,
        "width": words.width,
        "batch": words.batch,
        "times_faster": rows[1]["s_per_step"] / rows[0]["s_per_step"],
        "host_s_per_batch": statistics.median(prepared),
        "rows": rows,
    }
    lines = [
        "| decoder layers | s a step | first step, s | L1 of the first step |",
        "|---|---|---|---|",
    ]
    names = {"fast": "2x2 convolution, interleaved", "plain": "transposed convolution"}
    lines += [
        f"| {names[r['form']]} | {r['s_per_step']:.2f} | {r['cold_s']:.1f} |"
        f" {r['l1_first_step']:.6f} |"
        for r in rows
    ]
    out = pathlib.Path(words.out)
    with atomic_write(out) as part:
        part.write_text(json.dumps(data, indent=1) + "\n")
    with atomic_write(out.with_suffix(".md")) as part:
        part.write_text("\n".join(lines) + "\n")
    bars.console.print(
        f"{data['times_faster']:.1f} times faster; a batch takes"
        f" {1e3 * data['host_s_per_batch']:.1f} ms on the host; wrote {out} and .md"
    )


def batch_of(frames: Frames, config: TrainConfig, step: int) -> tuple[dict, float]:
    began = time.perf_counter()
    batch = take(frames, np.random.default_rng(step).permutation(len(frames))[: config.batch])
    return batch, time.perf_counter() - began


if __name__ == "__main__":
    main()
