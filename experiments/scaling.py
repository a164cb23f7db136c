"""What more processes, cores and data cost: datasets, training, the input pipeline, the store.

Command: python experiments/scaling.py [--parts dataset training pipeline store]
Cost:    about ten minutes on two cores with nothing else running (Linux, for taskset).
Result:  experiments/results/scaling.json and .md, and scale.md, hours and gigabytes of large
         datasets. `rows` have items a second and the efficiency of
         two processes, pinned to one core each, against one that is pinned to one core, and whether
         their result is the same; beside them one process on both cores. `pipeline`: how long
         training waits for its batches, and memory, by the size of the dataset. `store`: what an
         action takes on disk and to read.
"""

import argparse
import csv
import dataclasses
import json
import os
import pathlib
import resource
import shutil
import socket
import statistics
import subprocess
import sys
import tempfile
import time
from typing import Any

import jax
import numpy as np
import optax
from rich.console import Console

import physxnet_jax as px
from physxnet_jax.data import (
    DatasetConfig,
    build_dataset,
    dataset_digest,
    list_sequences,
    read_entry,
    read_sequence,
    read_times,
    write_action,
    write_garment,
    write_offsets,
)
from physxnet_jax.devices import join_processes, make_mesh, own_rows, repeated, split
from physxnet_jax.evaluation import machine
from physxnet_jax.files import atomic_write, write_json
from physxnet_jax.garment import TEMPLATES
from physxnet_jax.models import ModelConfig
from physxnet_jax.motion import save_motion
from physxnet_jax.simulation import PRESETS
from physxnet_jax.training import TrainConfig, make_problem, read_metrics, train, train_step
from physxnet_jax.training._data import load_data

RESULTS = pathlib.Path(__file__).parent / "results"
ACTIONS, FRAMES, COMPARED = 30, 45, 20
CONSOLE = Console()


def clips(folder: pathlib.Path, count: int, frames: int) -> None:
    """A folder of actions, cut from built-in clips."""
    folder.mkdir(parents=True, exist_ok=True)
    names = ("punch", "walk", "spin", "balance")
    for n in names:
        save_motion(folder / f"{n}.npz", px.load_motion(n, fps=30.0))
    with (folder / "ACTIONS.csv").open("w", newline="") as file:
        table = csv.writer(file)
        table.writerow(["split", "action", "file", "start_s", "frames_at_30fps"])
        for k in range(count):
            at = 0.1 * (k // len(names))
            table.writerow(["train", f"part {k}", f"{names[k % len(names)]}.npz", at, frames])


def config_of_dataset() -> DatasetConfig:
    return DatasetConfig(splits=("train",), templates=("bottom",), solver=PRESETS["standard"])


def build(folder: pathlib.Path, mocap: pathlib.Path, shard: tuple[int, int]) -> None:
    """Of one process: prints the seconds that its share took."""
    began = time.perf_counter()
    build_dataset(config_of_dataset(), folder, mocap, shard=shard)
    sys.stdout.write(f"{time.perf_counter() - began}\n")


# Resolution, channels, templates, steps that are timed.
NETWORKS: dict[str, tuple[int, int, tuple, int]] = {
    "64 x 64": (64, 32, ("bottom",), 60),
    "256 x 256": (256, 64, TEMPLATES, 5),
}


def learn(
    folder: pathlib.Path, data: pathlib.Path, size: str, number: int, processes: int, port: int
) -> None:
    """Of one process: trains and times steps; the first one writes weights and prints seconds."""
    if processes > 1:
        join_processes(f"127.0.0.1:{port}", processes, number)
    resolution, width, names, steps = NETWORKS[size]
    config = TrainConfig(
        model=ModelConfig(resolution=resolution, width=width, templates=names),
        epochs=100,
        adversarial=False,
        checkpoint_every=10**6,
    )
    folders, optimizer = list_sequences(data), optax.sgd(1e-4)
    compared = COMPARED if resolution == 64 else 1
    predictor = train(config, folders, folder, steps=compared, devices=1, optimizer=optimizer)
    if not number:
        leaves = [np.asarray(x).ravel() for x in jax.tree.leaves(predictor.state)]
        np.save(folder / "weights.npy", np.concatenate(leaves))
    made = load_data(config, folders)
    problem, state = make_problem(
        config,
        made.atlas,
        made.texel_points,
        made.normalisation,
        made.tables,
        fps=made.frames.fps,
        steps=100,
        optimizer=optimizer,
    )
    mesh = make_mesh(config.batch, 1)
    problem, state = repeated(mesh, problem), repeated(mesh, state)
    batches = made.frames.batches(0, own_rows(config.batch))
    ticks = []
    for k in range(steps + 1):
        batch = split(mesh, next(batches))
        state, metrics = train_step(problem, state, batch, jax.random.key(k))
        jax.block_until_ready(metrics)
        ticks.append(time.perf_counter())
    batches.close()
    sys.stdout.write(f"{statistics.median(np.diff(ticks))}\n")


def start(core: str, cache: pathlib.Path, *words: object) -> subprocess.Popen:
    """A process pinned to cores, which has a thread for each."""
    threads = str(len(core.split(",")))
    env = os.environ | {"JAX_COMPILATION_CACHE_DIR": str(cache / core), "NPROC": threads}
    env |= {
        "TF_CPP_MIN_LOG_LEVEL": "3",
        "JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS": "0",
        "OMP_NUM_THREADS": threads,
    }
    command = ["taskset", "-c", core, sys.executable, __file__, *map(str, words)]
    return subprocess.Popen(command, env=env, stdout=subprocess.PIPE, text=True)


def seconds_of(*processes: subprocess.Popen) -> float:
    """The longest time of processes that ran side by side."""
    found = [p.communicate()[0].split() for p in processes]
    if any(p.returncode for p in processes):
        raise SystemExit("a process failed; its error is above")
    return max(float(x[-1]) for x in found if x)


def row(what: str, processes: int, cores: int, rate: float, base: float, same: bool) -> dict:
    out = {
        "what": what,
        "processes": processes,
        "devices": processes,
        "cores": cores,
        "items_per_s": rate,
        "efficiency": rate / (base * cores),
        "same_result": same,
    }
    CONSOLE.print(out)
    return out


def measure_dataset(work: pathlib.Path) -> list[dict]:
    mocap, cache = work / "mocap", work / "programs"
    clips(mocap, ACTIONS, FRAMES)
    items = ACTIONS * FRAMES

    def run(name: str, *cores: str) -> tuple[float, str]:
        folder = work / name
        # The first time compiles.
        for _ in range(2):
            shutil.rmtree(folder, ignore_errors=True)
            started = [
                start(c, cache, "--build", folder, mocap, k, len(cores))
                for k, c in enumerate(cores)
            ]
            rate = items / seconds_of(*started)
        return rate, dataset_digest(folder)[0]

    base, digest = run("one", "0")
    two, digest_two = run("two", "0", "1")
    both, digest_both = run("both", "0,1")
    rows = [
        row("dataset", 1, 1, base, base, True),
        row("dataset", 2, 2, two, base, digest_two == digest),
        row("dataset", 1, 2, both, base, digest_both == digest),
    ]
    rows += measure_ray(work, mocap, digest)
    return rows


def measure_ray(work: pathlib.Path, mocap: pathlib.Path, digest: str) -> list[dict]:
    try:
        import ray
    except ImportError:
        return []
    rates, same = [], []
    os.environ["JAX_COMPILATION_CACHE_DIR"] = str(work / "programs/ray")
    os.environ["JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS"] = "0"
    for workers in (1, 2):
        for name in ("warm", "ray"):
            ray.init(num_cpus=workers, log_to_driver=False, logging_level="error")
            folder = work / f"{name}-{workers}"
            began = time.perf_counter()
            build_dataset(config_of_dataset(), folder, mocap, ray="local")
            taken = time.perf_counter() - began
            ray.shutdown()
        # Of the jobs alone: starting workers takes as long, however many jobs follow.
        times = [x["seconds"] for x in read_times(folder)]
        busy = sum(times) / workers
        CONSOLE.print(f"Ray with {workers}: {taken:.1f} s in all, {busy:.1f} s of jobs each")
        rates.append(ACTIONS * FRAMES / busy)
        same.append(dataset_digest(folder)[0] == digest)
    return [
        row("dataset on Ray, jobs alone", n, n, rates[n - 1], rates[0], same[n - 1]) for n in (1, 2)
    ]


def made_dataset(folder: pathlib.Path, count: int, frames: int, names: tuple) -> None:
    """Cloth that waves; writing it is much faster than simulating it."""
    for name in names:
        mesh = px.template(name).mesh
        write_garment(folder, name, np.asarray(mesh.vertices), np.asarray(mesh.faces))
    clip = px.load_motion("walk", fps=30.0)
    pick = np.arange(frames) % clip.num_frames
    motion = dataclasses.replace(clip, rotations=clip.rotations[pick], root=clip.root[pick])
    t = np.arange(frames)[:, None, None] / 30.0
    for k in range(count):
        where = folder / f"a{k:05d}"
        write_action(where, dataclasses.replace(motion, name=f"a{k}"), "train")
        for name in names:
            x = np.asarray(px.template(name).mesh.vertices)[None]
            noise = np.random.default_rng(k).normal(0, 2e-4, (frames, x.shape[1], 3))
            offsets = (0.02 * np.sin(3 * t + 4 * x + k) + noise).astype(np.float32)
            write_offsets(where, name, offsets, {"finite": True, "worst": {}, "engine": "made"})


def measure_training(work: pathlib.Path) -> list[dict]:
    data, cache = work / "learn", work / "programs"
    made_dataset(data, 2, 40, TEMPLATES)

    def run(size: str, name: str, *cores: str) -> tuple[float, np.ndarray]:
        folder = work / f"{name}-{size.partition(' ')[0]}"
        with socket.socket() as s:
            s.bind(("127.0.0.1", 0))
            port = s.getsockname()[1]
        started = [
            start(c, cache, "--learn", folder, data, size, k, len(cores), port)
            for k, c in enumerate(cores)
        ]
        rate = 8.0 / seconds_of(*started)
        return rate, np.load(folder / "weights.npy")

    rows = []
    for size in NETWORKS:
        base, weights = run(size, "one", "0")
        for name, *cores in (("two", "0", "1"), ("both", "0,1")):
            rate, found = run(size, name, *cores)
            gap = float(np.abs(found - weights).max())
            rows.append(row(f"training, {size}", len(cores), 2, rate, base, gap < 1e-5))
            rows[-1]["largest_difference"] = gap
        rows.insert(-2, row(f"training, {size}", 1, 1, base, base, True))
    return rows


def pipe(data: pathlib.Path, count: int, capacity: int, step_ms: float) -> None:
    """Of one process: prints frames, share of waiting and peak memory."""
    config = TrainConfig(
        model=ModelConfig(resolution=64, width=16),
        epochs=100,
        adversarial=False,
        checkpoint_every=10**6,
        frames_in_memory=capacity,
    )
    folders = list_sequences(data)[:count]
    if step_ms:
        stream = load_data(config, folders).frames
        batches = stream.batches(0, slice(None))
        next(batches)
        began, waited = time.perf_counter(), batches.waited
        for _ in range(stream.steps_per_epoch):
            next(batches)
            time.sleep(1e-3 * step_ms)
        share = (batches.waited - waited) / (time.perf_counter() - began)
        batches.close()
    else:
        with tempfile.TemporaryDirectory() as folder:
            train(config, folders, folder, steps=200)
            share = statistics.fmean(
                x["waiting_share"] for x in read_metrics(pathlib.Path(folder))[1:] if "loss" in x
            )
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e3
    frames = sum(read_entry(f).frames for f in folders)
    sys.stdout.write(json.dumps({"frames": frames, "share": share, "peak_mb": peak}) + "\n")


def measure_pipeline(work: pathlib.Path) -> list[dict]:
    data = work / "pipe"
    made_dataset(data, 48, 100, TEMPLATES)
    rows = []
    for step_ms in (0.0, 20.0):
        for count, capacity in ((12, 1200), (48, 1200), (48, 10**6)):
            process = start("0,1", work / "programs", "--pipe", data, count, capacity, step_ms)
            found = json.loads(process.communicate()[0].splitlines()[-1])
            step = "measured" if not step_ms else f"simulated, {step_ms:.0f} ms"
            rows.append({"step": step, "frames_in_memory": capacity, **found})
            CONSOLE.print(rows[-1])
    return rows


def measure_store(work: pathlib.Path) -> list[dict]:
    data = work / "pipe"
    if not data.is_dir():
        made_dataset(data, 48, 100, TEMPLATES)
    folders = list_sequences(data)
    began = time.perf_counter()
    list_sequences(data)
    listed = time.perf_counter() - began
    reads, entries = [], []
    for k in np.random.default_rng(0).permutation(len(folders)):
        began = time.perf_counter()
        read_entry(folders[k])
        entries.append(time.perf_counter() - began)
        began = time.perf_counter()
        s = read_sequence(folders[k])
        reads.append(time.perf_counter() - began)
    size = dataset_digest(data)[1]
    garment_frames = sum(len(x) for x in s.offsets.values()) * len(folders)
    return [
        {
            "actions": len(folders),
            "garment_frames": garment_frames,
            "bytes_per_garment_frame": size / garment_frames,
            "list_ms_per_action": 1e3 * listed / len(folders),
            "entry_ms": 1e3 * statistics.median(entries),
            "read_ms_per_action": 1e3 * statistics.median(reads),
            "read_garment_frames_per_s": garment_frames / len(folders) / statistics.median(reads),
        }
    ]


def _same(r: dict[str, Any]) -> str:
    gap = f", {r['largest_difference']:.0e} apart" if r.get("largest_difference") else ""
    return ("yes" if r["same_result"] else "no") + gap


def tables(found: dict[str, Any]) -> str:
    lines = [
        f"{found['machine']['device']}, {found['machine']['cores']} cores",
        "",
        "| what | processes | cores | items a second | efficiency | same result |",
        "|---|---|---|---|---|---|",
    ]
    lines += [
        f"| {r['what']} | {r['processes']} | {r['cores']} | {r['items_per_s']:.1f} |"
        f" {r['efficiency']:.2f} | {_same(r)} |"
        for r in found["rows"]
    ]
    lines += [
        "",
        "| step | frames | in memory at most | waiting | peak MB |",
        "|---|---|---|---|---|",
    ]
    lines += [
        f"| {r['step']} | {r['frames']:,} | {r['frames_in_memory']:,} | {100 * r['share']:.1f} % |"
        f" {r['peak_mb']:.0f} |"
        for r in found["pipeline"]
    ]
    lines += [
        "",
        "| actions | garment-frames | bytes each | listing ms an action | entry ms | reading ms"
        " | garment-frames a second |",
        "|---|---|---|---|---|---|---|",
    ]
    lines += [
        f"| {r['actions']} | {r['garment_frames']:,} | {r['bytes_per_garment_frame']:.0f} |"
        f" {r['list_ms_per_action']:.2f} | {r['entry_ms']:.1f} | {r['read_ms_per_action']:.0f} |"
        f" {r['read_garment_frames_per_s']:,.0f} |"
        for r in found["store"]
    ]
    return "\n".join(lines) + "\n"


def cost_table(found: dict[str, Any]) -> str:
    """Hours and gigabytes of large datasets, from measured rates."""
    core = next(r for r in found["rows"] if r["what"] == "dataset" and r["processes"] == 2)
    card = json.loads((RESULTS / "cuda.json").read_text())["simulator"]
    full = [r for r in card["rows"] if r.get("preset") == "standard"][-1]
    # Clips of 150 frames have a warm-up of 45 here; those of the rate above one of 45 for 45.
    core_rate = core["items_per_s"] / core["processes"] * (2 * 45 / 45) / (195 / 150)
    card_rate = 1e3 / full["ms_per_person_frame"] / (195 / 150)
    known = json.loads((RESULTS / "datasets.json").read_text())["ours"]
    size = 1e6 * known["megabytes"] / (3 * known["frames"])
    entry = found["store"][0]["entry_ms"] + found["store"][0]["list_ms_per_action"]
    lines = [
        f"| garment-frames | {core_rate:.0f} a second a core | {card_rate:.0f} a second a card"
        " | store | looking at each action without an index |",
        "|---|---|---|---|---|",
    ]
    for count in (1e6, 1e8):
        hours = [count / r / 3600 for r in (core_rate, card_rate)]
        lines.append(
            f"| {count:.0e} | {hours[0]:,.0f} core-hours | {hours[1]:.1f} card-hours |"
            f" {count * size / 1e9:,.0f} GB | {1e-3 * entry * count / 450:,.0f} s |"
        )
    return "\n".join(lines).replace("e+0", "e") + "\n"


PARTS = {
    "dataset": measure_dataset,
    "training": measure_training,
    "pipeline": measure_pipeline,
    "store": measure_store,
}


def main() -> int:
    words = sys.argv[1:]
    if words[:1] == ["--build"]:
        build(pathlib.Path(words[1]), pathlib.Path(words[2]), (int(words[3]), int(words[4])))
        return 0
    if words[:1] == ["--learn"]:
        learn(pathlib.Path(words[1]), pathlib.Path(words[2]), words[3], *map(int, words[4:]))
        return 0
    if words[:1] == ["--pipe"]:
        pipe(pathlib.Path(words[1]), int(words[2]), int(words[3]), float(words[4]))
        return 0
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--parts", nargs="+", choices=list(PARTS), default=list(PARTS))
    options = parser.parse_args()
    path = RESULTS / "scaling.json"
    found = json.loads(path.read_text()) if path.is_file() else {}
    found["machine"] = machine()
    with tempfile.TemporaryDirectory() as work:
        for part in options.parts:
            got = PARTS[part](pathlib.Path(work))
            if part in ("dataset", "training"):
                kept = [r for r in found.get("rows", []) if not r["what"].startswith(part)]
                found["rows"] = sorted([*kept, *got], key=lambda r: r["what"].split(",")[0])
            else:
                found[part] = got
            write_json(path, found)
    if {"rows", "pipeline", "store"} <= found.keys():
        with atomic_write(path.with_suffix(".md")) as part:
            part.write_text(tables(found))
        with atomic_write(RESULTS / "scale.md") as part:
            part.write_text(cost_table(found))
    return 0


if __name__ == "__main__":
    sys.exit(main())
