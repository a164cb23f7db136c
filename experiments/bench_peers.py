"""The network beside the same network in PyTorch: same weights, same maps, same machine.

Command: python experiments/bench_peers.py
         --torch PYTHON (one that has torch and numpy; default: $PHYSXNET_TORCH),
         --weights small, --batches 1 32, --rounds 3,
         --out experiments/results/peers.json
Cost:    about two minutes on two cores, most of it PyTorch's compilation.
Result:  peers.json and .md: milliseconds a frame of the network from motion maps to offset
         maps, three decoders, and the largest difference of the answers. Both take turns,
         so that a slow moment of the machine meets both.

To have a PyTorch: uv venv torch-env && uv pip install --python torch-env torch numpy
"""

import argparse
import json
import os
import pathlib
import statistics
import subprocess
import tempfile
import time

import jax
import jax.numpy as jnp
import numpy as np
from flax import nnx
from rich.progress import Progress

from physxnet_jax.files import atomic_write
from physxnet_jax.models import Predictor, fold_batch_norm, load_predictor

HERE = pathlib.Path(__file__).parent


def plain_weights(predictor: Predictor) -> dict[str, np.ndarray]:
    """Parameters under the names that `peers/torch_network.py` looks for."""
    network = nnx.merge(predictor.graph, predictor.state)
    out: dict[str, np.ndarray] = {}

    def norm(name: str, layer: nnx.BatchNorm) -> None:
        for part in ("scale", "bias", "mean", "var"):
            out[f"{name}.{part}"] = np.asarray(getattr(layer, part)[...])

    for k, layer in enumerate(network.encoder):
        out[f"encoder.{k}.conv"] = np.asarray(layer.conv.kernel[...])
        norm(f"encoder.{k}.norm", layer.norm)
    for t, decoder in network.decoders.items():
        for k, layer in enumerate(decoder.layers):
            name = f"decoders.{t}.{k}"
            out[f"{name}.conv"] = np.asarray(layer.kernel[...])
            if layer.norm is None:
                out[f"{name}.bias"] = np.asarray(layer.bias[...])
            else:
                norm(f"{name}.norm", layer.norm)
    return out


def ours(predictor: Predictor, maps: np.ndarray, seconds: float) -> tuple[dict, np.ndarray]:
    """A row of the jitted network with batch norm folded, and its answer."""
    templates = predictor.config.templates
    folded = fold_batch_norm(predictor)

    @jax.jit
    def run(state: nnx.State, x: jax.Array) -> jax.Array:
        network = nnx.merge(folded.graph, state)
        return jnp.concatenate([network(x, templates)[t] for t in templates], axis=-1)

    x = jnp.asarray(maps)
    began = time.perf_counter()
    answer = jax.block_until_ready(run(folded.state, x))
    cold = time.perf_counter() - began
    laps: list[float] = []
    began = time.perf_counter()
    while len(laps) < 20 or time.perf_counter() - began < seconds:
        start = time.perf_counter()
        jax.block_until_ready(run(folded.state, x))
        laps.append(1e3 * (time.perf_counter() - start))
    ms = statistics.median(laps) / len(maps)
    row = {"form": "jax", "batch": len(maps), "ms_per_frame": ms, "cold_s": cold}
    return row, np.asarray(answer)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--torch", default=os.environ.get("PHYSXNET_TORCH"))
    parser.add_argument("--weights", default="small")
    parser.add_argument("--batches", type=int, nargs="+", default=[1, 32])
    parser.add_argument("--rounds", type=int, default=3)
    parser.add_argument("--seconds", type=float, default=3.0)
    parser.add_argument("--out", default=str(HERE / "results" / "peers.json"))
    words = parser.parse_args()
    if not words.torch:
        parser.error("no PyTorch: name a Python that has it by --torch or $PHYSXNET_TORCH.")
    predictor = load_predictor(words.weights)
    config = predictor.config
    size = (max(words.batches), config.resolution, config.resolution, config.inputs.channels)
    maps = np.random.default_rng(0).normal(0.0, 0.3, size).astype(np.float32)
    told = {
        "channels": config.inputs.channels,
        "width": config.width,
        "templates": config.templates,
        "batches": words.batches,
        "threads": os.cpu_count(),
        "seconds": words.seconds,
    }
    rows: list[dict] = []
    worst = 0.0
    with tempfile.TemporaryDirectory() as folder, Progress() as bars:
        bar = bars.add_task("rounds", total=words.rounds)
        question, answer = (str(pathlib.Path(folder) / n) for n in ("in.npz", "out.npz"))
        np.savez(question, told=json.dumps(told), maps=maps, **plain_weights(predictor))
        for _ in range(words.rounds):
            script = HERE / "peers" / "torch_network.py"
            subprocess.run([words.torch, str(script), question, answer], check=True)
            theirs = np.load(answer)
            rows += json.loads(str(theirs["rows"]))
            for batch in words.batches:
                row, mine = ours(predictor, maps[:batch], words.seconds)
                rows.append(row)
                for form in ("torch eager", "torch compiled"):
                    worst = max(worst, float(np.abs(theirs[f"{form} {batch}"] - mine).max()))
            bars.update(bar, advance=1)
        version = str(theirs["version"])
    table = []
    for form in ("jax", "torch eager", "torch compiled"):
        for batch in words.batches:
            found = [r for r in rows if (r["form"], r["batch"]) == (form, batch)]
            ms, cold = (statistics.median(r[k] for r in found) for k in ("ms_per_frame", "cold_s"))
            table.append({"form": form, "batch": batch, "ms_per_frame": ms, "cold_s": cold})
    data = {
        "weights": words.weights,
        "machine": f"{os.cpu_count()} cores; jax {jax.__version__}; {version}",
        "largest_difference": worst,
        "rows": [{k: _short(v) for k, v in r.items()} for r in table],
    }
    lines = ["| form | batch | ms a frame | cold s |", "|---|---|---|---|"]
    lines += [
        f"| {r['form']} | {r['batch']} | {r['ms_per_frame']:.2f} | {r['cold_s']:.1f} |"
        for r in table
    ]
    out = pathlib.Path(words.out)
    with atomic_write(out) as part:
        part.write_text(json.dumps(data, indent=1) + "\n")
    with atomic_write(out.with_suffix(".md")) as part:
        part.write_text("\n".join(lines) + "\n")
    bars.console.print(f"largest difference {worst:.2g}; wrote {out} and .md")


def _short(value: object) -> object:
    return float(f"{value:.4g}") if isinstance(value, float) else value


if __name__ == "__main__":
    main()
