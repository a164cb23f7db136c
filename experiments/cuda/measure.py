"""What waits for a CUDA machine, part by part, each within its own time.

Command: bash experiments/cuda/run.sh [tests simulator network] [--toy]
Cost:    under 6 minutes on an H100 or H200 (--seconds); with --toy a few on two cores.
Result:  $OUT/results.json, by part. The table comes last. A part that ends early keeps its rows.

    tests      versions, and the package's fast tests that need no file
    simulator  ms a person and frame, next to the error, and to the arithmetic floor
    network    ms a frame of network and pipeline, live and batched, and the error of precisions
"""

import argparse
import dataclasses
import faulthandler
import importlib.metadata
import json
import os
import re
import shutil
import subprocess
import sys
import time
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from floor import Ceilings, measure_ceilings, work_of
from places import OUT, ROOT, WORK, say, shown

import physxnet_jax as px
from physxnet_jax.dressing import Inference, clothe, make_dresser
from physxnet_jax.evaluation import evaluated_errors, machine, network_costs
from physxnet_jax.files import write_json
from physxnet_jax.motion import Motion
from physxnet_jax.simulation import (
    PRESETS,
    ROLLOUT_BLOCK,
    XPBD,
    Rollout,
    Scene,
    advance,
    make_system,
    prepare_scene,
    simulate_batch,
    start_state,
    warmup,
)

# The most seconds of each part, in order of worth.
LIMITS = {
    "tests": 75,
    "simulator": 130,
    "network": 110,
}
# Left for the table and the last writes [s].
_RESERVE = 10
_Rows = list[dict[str, Any]]


class Record:
    """Rows of a part, on disk as they come.

    Args:
        part: Name of the part.
    """

    def __init__(self, part: str) -> None:
        self._part, self._path = part, OUT / "results.json"
        self.rows: _Rows = []

    def add(self, what: str, **values: Any) -> None:
        """Adds a row, and writes all of the part."""
        self.rows.append({"what": what, **values})
        say(f"  {what}: {shown(values)}")
        stored = read_results()
        stored[self._part] = self.rows
        write_json(self._path, stored)


def read_results() -> dict[str, Any]:
    path = OUT / "results.json"
    return json.loads(path.read_text()) if path.is_file() else {}


def tests(record: Record, toy: bool, until: float) -> None:
    found = machine()
    names = ("jax", "jaxlib", "flax", "optax", "numpy", "orbax-checkpoint", "tensorstore")
    card = (
        subprocess.run(
            ["nvidia-smi", "--query-gpu=name,driver_version,memory.total", "--format=csv,noheader"],
            capture_output=True,
            text=True,
            check=False,
        )
        if shutil.which("nvidia-smi")
        else None
    )
    record.add(
        "versions",
        device=jax.devices()[0].device_kind,
        card="none" if card is None else card.stdout.strip(),
        cores=found["cores"],
        python=sys.version.split()[0],
        **{n: importlib.metadata.version(n) for n in names},
    )
    folders = ["geometry"] if toy else ["geometry", "uv", "models", "simulation", "training"]
    command = [sys.executable, "-m", "pytest", *(f"tests/{f}" for f in folders)]
    # A card's memory is shared by all workers; its compiler warns of its own accord.
    command += ["-W", "default", "-p", "no:cacheprovider", "-vv", "--tb=line"]
    command += ["-n", "2" if toy else "14", "--max-worker-restart=2"]
    if toy:
        command += ["-k", "normals"]
    log = OUT / "tests.txt"
    env = {**os.environ, "XLA_PYTHON_CLIENT_PREALLOCATE": "false"}
    start = time.perf_counter()
    with log.open("w") as file:
        process = subprocess.Popen(command, cwd=ROOT, stdout=file, stderr=file, env=env)
        try:
            process.wait(max(until - time.monotonic() - 5.0, 1.0))
        except subprocess.TimeoutExpired:
            process.terminate()
            process.wait()
    text = log.read_text()
    last = re.findall(r"^.*\b(?:passed|failed|error).* in [\d.]+s.*$", text, re.M)
    # Each test's line, also if the run was cut.
    verdicts = [v for v, _ in re.findall(r"\] (PASSED|FAILED|SKIPPED) (\S+)", text)]
    record.add(
        "fast tests",
        folders=" ".join(folders),
        seconds=time.perf_counter() - start,
        finished=bool(last),
        passed=verdicts.count("PASSED"),
        failed=sorted(set(re.findall(r"\] FAILED (\S+)", text))),
    )


def _people(count: int, frames: int) -> list[Motion]:
    clips = {n: px.load_motion(n, fps=30.0) for n in ("punch", "walk", "spin", "balance")}
    names = ["punch", *(("walk", "spin", "balance")[k % 3] for k in range(count - 1))]
    return [
        dataclasses.replace(
            clips[n], rotations=clips[n].rotations[:frames], root=clips[n].root[:frames]
        )
        for n in names
    ]


def _rms_mm(x: np.ndarray) -> float:
    return 1e3 * float(np.sqrt(np.mean(np.sum(np.square(x), axis=-1))))


def _peak_mb() -> float:
    stats = jax.devices()[0].memory_stats() or {}
    return stats.get("peak_bytes_in_use", 0) / 1e6


def _floor_ms(ceilings: Ceilings, scene: Any, solver: XPBD, people: int) -> float:
    """The least time of a frame of all people."""
    system = make_system(scene, solver)
    motion = warmup(scene.assembly.body, _people(1, 2)[0])
    x = jnp.asarray(scene.assembly.rest.astype(np.float32))
    x = jnp.repeat(x[:, :, None], people, axis=2)
    state = start_state(system, x, solver=solver, fps=30.0)
    q = jnp.repeat(motion.rotations[:2, None], people, axis=1)
    p = jnp.repeat(motion.root[:2, None], people, axis=1)
    return 1e3 * ceilings.seconds(work_of(advance, system, state, q, p, solver=solver, fps=30.0))


def _timed(scene: Any, people: list[Motion], solver: XPBD) -> tuple[list[Rollout], np.ndarray]:
    """Rollouts, and the seconds of each block."""
    ticks = [time.perf_counter()]
    out = simulate_batch(
        scene, people, solver=solver, progress=lambda *_: ticks.append(time.perf_counter())
    )
    return out, np.diff(ticks)


def simulator(record: Record, toy: bool, until: float) -> None:
    del until
    ceilings = measure_ceilings(1 << 20, 256) if toy else measure_ceilings()
    record.add("ceilings", **dataclasses.asdict(ceilings))
    frames = 3 if toy else 20
    scene = prepare_scene(Scene((px.template("dress"),)))
    solvers = {"toy": XPBD(8, 1)} if toy else PRESETS
    exact, sizes = ("toy", (1, 2)) if toy else ("reference", (1, 16, 64, 128))
    order = [(exact, 1)]
    order += [(p, n) for p in (("toy",) if toy else ("standard", exact)) for n in sizes]
    truth: np.ndarray | None = None
    for preset, count in dict.fromkeys(order):
        out, laps = _timed(scene, _people(count, frames), solvers[preset])
        first = out[0].positions[0]
        truth = first if truth is None else truth
        record.add(
            f"{preset}, {count} people",
            preset=preset,
            people=count,
            ms_per_person_frame=1e3 * float(np.median(laps[1:])) / (ROLLOUT_BLOCK * count),
            floor_ms=_floor_ms(ceilings, scene, solvers[preset], count) / count,
            rms_from_reference_mm=_rms_mm(first - truth),
            finite=all(bool(r.finite.all()) for r in out),
            first_block_s=float(laps[0]),
        )


def network(record: Record, toy: bool, until: float) -> None:
    del until
    began = time.monotonic()
    walk = px.load_motion("walk", fps=30.0)
    walk = dataclasses.replace(walk, rotations=walk.rotations[:64], root=walk.root[:64])
    # Precision first: against float32 on the processor.
    cpu = jax.local_devices(backend="cpu")[0]
    worn = ["bottom"] if toy else ["top", "bottom", "dress"]

    def dressed(precision: str) -> list[np.ndarray]:
        dresser = make_dresser(worn, inference=Inference(weights="small"), precision=precision)
        say(f"  bound at {time.monotonic() - began:.0f} s")
        # The processor's program is another than the device's.
        out = jax.jit(clothe, static_argnames="fps")(
            dresser, walk.rotations, walk.root, fps=walk.fps
        )
        return [np.asarray(v) for v in out.vertices.values()]

    with jax.default_device(cpu):
        exact = dressed("float32")
    for precision in ("float32", "bfloat16"):
        gaps = [a - b for a, b in zip(dressed(precision), exact, strict=True)]
        record.add(
            f"small, {precision}, from float32 on the processor",
            rms_mm=max(_rms_mm(g) for g in gaps),
            largest_mm=1e3 * max(float(np.abs(g).max()) for g in gaps),
        )
    known = evaluated_errors(ROOT / "experiments/results/test_errors.json")
    for weights in ("small",) if toy else ("base", "small"):
        for precision in ("float32",) if toy else ("float32", "bfloat16"):
            rows = network_costs(
                Inference(weights=weights, strain_iterations=0),
                walk,
                {f"network{end}": known.get(weights + end, {}) for end in ("", "+push")},
                batches=(2,) if toy else (1, 32, 256),
                garments=(1,) if toy else (1, 3),
                backward=precision == "float32" and not toy,
                precision=precision,
            )
            for r in rows:
                record.add(
                    f"{r.method} {r.size} {r.precision}, {r.garments} garments, {r.batch} frames",
                    **dataclasses.asdict(r),
                )


PARTS: dict[str, Callable[[Record, bool, float], None]] = {
    "tests": tests,
    "simulator": simulator,
    "network": network,
}


def print_table() -> None:
    say(f"\n{'part':10} {'what':62} values")
    for part, rows in read_results().items():
        for row in rows:
            values = {
                k: v
                for k, v in row.items()
                if k
                not in (
                    "what",
                    "preset",
                    "people",
                    "method",
                    "size",
                    "garments",
                    "batch",
                    "precision",
                    "weights",
                    "device",
                    "rmse_each",
                )
                and v is not None
            }
            say(f"{part:10} {row['what']:62} {shown(values)}")


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("parts", nargs="*", default=list(PARTS), help="parts to run, in order")
    parser.add_argument("--seconds", type=float, default=530.0, help="time for all of them")
    parser.add_argument("--toy", action="store_true", help="the smallest sizes, for a rehearsal")
    parser.add_argument("--only", help=argparse.SUPPRESS)
    parser.add_argument("--until", type=float, help=argparse.SUPPRESS)
    options = parser.parse_args()
    OUT.mkdir(parents=True, exist_ok=True)
    WORK.mkdir(parents=True, exist_ok=True)
    if options.only:
        # Says where a part was when its time was up.
        left = options.until - time.monotonic() - 2.0
        faulthandler.dump_traceback_later(max(left, 1.0), file=sys.stdout)
        PARTS[options.only](Record(options.only), options.toy, options.until)
        faulthandler.cancel_dump_traceback_later()
        return 0
    unknown = set(options.parts) - set(PARTS)
    if unknown:
        parser.error(f"unknown parts {', '.join(sorted(unknown))}; there are {', '.join(PARTS)}")
    (OUT / "results.json").unlink(missing_ok=True)
    end = time.monotonic() + options.seconds
    failed = []
    for part in options.parts:
        limit = min(LIMITS[part], end - time.monotonic() - _RESERVE)
        if limit < 20:
            say(f"{part}: skipped, no time left")
            failed.append(part)
            continue
        say(f"{part}: at most {limit:.0f} s")
        command = [sys.executable, __file__, "--only", part]
        command += ["--until", str(time.monotonic() + limit)] + ["--toy"] * options.toy
        env = dict(os.environ)
        # `network` reports what the first call costs.
        if part != "network":
            env.setdefault("JAX_COMPILATION_CACHE_DIR", str(WORK / "programs"))
        try:
            if subprocess.run(command, timeout=limit, env=env, check=False).returncode:
                failed.append(part)
        except subprocess.TimeoutExpired:
            say(f"{part}: cut after {limit:.0f} s")
            failed.append(part)
    print_table()
    if failed:
        say(f"not finished: {', '.join(failed)}")
    return 1 if failed else 0


if __name__ == "__main__":
    sys.exit(main())
