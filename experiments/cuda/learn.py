"""Learns on a CUDA machine: the networks that see garments, and the paper's at full size.

Command: bash experiments/cuda/run.sh learn [--seconds 760] [--toy]
Cost:    the seconds, on an H100 or H200 with 16 cores; with --toy minutes on two cores.
Result:  $OUT/learned.json, rows by role, and the weights in pieces under 16 MB.

    clothes   each default garment on all training actions and on six variations of them, side by
              side on the card: other upper bodies, speeds, wider poses, the frames left out
    variants  the outfits of datasets.toml#variants, on the processor's cores meanwhile
    paper     fitted garments on the card, then the paper's network, 256 x 256
    networks  base, small and nano from their packaged weights, on all clothes, one after another
"""

import argparse
import dataclasses
import functools
import hashlib
import json
import lzma
import os
import pathlib
import pickle
import shutil
import subprocess
import sys
import threading
import time
from collections.abc import Callable
from contextlib import AbstractContextManager
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import optax
from pack import FOLDERS, pack_clothes, unpack_motions
from places import OUT, PACK, ROOT, WORK, say, shown

from physxnet_jax.body import load_body
from physxnet_jax.cli._configs import read_config
from physxnet_jax.data import (
    QUANTIZATION_STEP,
    Action,
    DatasetConfig,
    Outfit,
    Sequence,
    _outfit,
    build_dataset,
    list_sequences,
    load_action,
    mirrored_sequence,
    read_protocol,
    read_sequence,
)
from physxnet_jax.files import write_json
from physxnet_jax.garment import template
from physxnet_jax.models import save_predictor
from physxnet_jax.motion import (
    Motion,
    animate,
    at_speed,
    exaggerated,
    save_motion,
    subdued,
    with_upper_body,
)
from physxnet_jax.simulation import (
    XPBD,
    PreparedScene,
    Scene,
    prepare_scene,
    simulate_batch,
    standard_effects,
)
from physxnet_jax.training import (
    TrainConfig,
    TrainingData,
    _data,
    load_data,
    make_optimizer,
    train,
)

SHARDS = 12
NETWORKS = ("base", "small", "nano")
# Shares of the time that is left when their data are ready.
SHARES = {"base": 0.5, "small": 0.3, "nano": 0.2}
# Until when outfits are simulated and the paper's network learns, of the whole time.
VARIANTS_UNTIL, PAPER_UNTIL = 0.36, 0.45
# Clips have a multiple of so many frames: each length is a program.
_STEP = 16
_PIECE = 15_000_000


@dataclasses.dataclass(frozen=True)
class Way:
    """A variation of the actions' motion, see `DatasetConfig`."""

    upper_from: int = 0
    exaggerate: float = 1.0
    subdue: float = 1.0
    speed: float = 1.0
    left_out: bool = False
    """Whether what the protocol leaves out of the clips takes the place of the actions."""


WAYS = (
    Way(),
    Way(left_out=True),
    Way(upper_from=9, exaggerate=1.25),
    Way(upper_from=5, speed=1.2),
    Way(upper_from=13, exaggerate=1.1, speed=0.85),
    Way(exaggerate=1.3),
    Way(subdue=0.3),
)


@dataclasses.dataclass(frozen=True)
class Run:
    """What all roles share.

    Attributes:
        toy: The smallest sizes.
        start: When the run began [s].
        seconds: Its length.
        folder: Folder of the motion files.
    """

    toy: bool
    start: float
    seconds: float
    folder: pathlib.Path

    def left(self, share: float = 1.0) -> float:
        """Seconds until a share of the time has passed."""
        return self.start + share * self.seconds - time.time()

    def say(self, text: str) -> None:
        """Prints a line with the time."""
        say(f"{time.time() - self.start:5.0f} s  {text}")

    def add(self, role: str, what: str, **values: Any) -> None:
        """Stores a row."""
        rows = WORK / f"{role}.json"
        known = json.loads(rows.read_text()) if rows.is_file() else []
        write_json(rows, [*known, {"what": what, **values}])
        self.say(f"{what}: {shown(values)}")


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seconds", type=float, default=760.0)
    parser.add_argument("--toy", action="store_true", help="the smallest sizes, for a rehearsal")
    parser.add_argument("--role", help=argparse.SUPPRESS)
    parser.add_argument("--start", type=float, help=argparse.SUPPRESS)
    options = parser.parse_args()
    OUT.mkdir(parents=True, exist_ok=True)
    folder = WORK / ("toy-mocap" if options.toy else "mocap")
    run = Run(options.toy, options.start or time.time(), options.seconds, folder)
    if options.role:
        name, _, number = options.role.partition(":")
        _take_packed(tables=name == "networks")
        ROLES[name](run, *([int(number)] if number else []))
        return 0
    return _start_all(run)


def _take_packed(*, tables: bool) -> None:
    """Takes garments and tables from the pack: cutting and binding them takes minutes."""
    place = WORK / "packed.pkl"
    if not place.is_file():
        return
    with _on_processor(), lzma.open(place) as file:
        stored = pickle.load(file)
    _outfit._garments = stored["garments"].__getitem__
    if not tables:
        return
    _data.make_wardrobe = lambda *_: stored["wardrobe"]
    _data.prepare_garments = lambda *_, **__: stored["tables"]


def _start_all(run: Run) -> int:
    shutil.rmtree(WORK, ignore_errors=True)
    WORK.mkdir(parents=True)
    if run.toy:
        _write_toy_motions(run.folder)
        some = tuple(o for t in ("default", "variants") for o in _dataset(run, t).outfits)
        pack_clothes(WORK / "packed.pkl", some, _network_config(run, NETWORKS[-1]))
    else:
        unpack_motions(PACK / "mocap.npz", run.folder)
        shutil.copy(PACK / "clothes.pkl", WORK / "packed.pkl")
    shards = 1 if run.toy else SHARDS
    roles = [f"variants:{k}" for k in range(shards)]
    roles += [f"clothes:{k}" for k in range(1 if run.toy else 3)] + ["paper", "networks"]
    cores = sorted(os.sched_getaffinity(0))
    running: dict[str, subprocess.Popen[bytes]] = {}
    for k, role in enumerate(roles):
        env = {**os.environ, "XLA_PYTHON_CLIENT_PREALLOCATE": "false"}
        env.setdefault("JAX_COMPILATION_CACHE_DIR", str(WORK / "programs"))
        command = [sys.executable, __file__, "--role", role, "--start", str(run.start)]
        command += ["--seconds", str(run.seconds)] + ["--toy"] * run.toy
        if role.startswith("variants") and len(cores) > shards:
            env["JAX_PLATFORMS"] = "cpu"
            command = ["taskset", "-c", str(cores[len(cores) - 1 - k]), *command]
        elif len(cores) > shards:
            some = ",".join(map(str, cores[: len(cores) - shards]))
            command = command if role == "networks" else ["taskset", "-c", some, *command]
        running[role] = subprocess.Popen(command, env=env)
    failed = []
    while running:
        time.sleep(0.2)
        for role, process in list(running.items()):
            late = run.left() < 0
            if late and process.poll() is None:
                process.kill()
            if process.poll() is None:
                continue
            del running[role]
            (WORK / f"{role}.ended").touch()
            if process.returncode:
                failed.append(role)
                run.say(f"{role}: {'cut' if late else 'failed'}")
    rows = {p.stem: json.loads(p.read_text()) for p in sorted(WORK.glob("*.json"))}
    write_json(OUT / "learned.json", rows)
    for role, found in rows.items():
        for row in found:
            say(f"{role:12} {shown(row)}")
    if failed:
        run.say(f"not finished: {', '.join(failed)}")
    return 1 if failed else 0


def _write_toy_motions(folder: pathlib.Path) -> None:
    import physxnet_jax as px

    lines = ["split,action,file,start_s,frames_at_30fps"]
    lines += ["train,punch,punch.npz,0.0,20", "train,kick ball,punch.npz,0.7,18"]
    lines += ["extra,side,punch.npz,1.0,20", "extra,back,punch.npz,1.2,17"]
    for name in FOLDERS:
        (folder / name).mkdir(parents=True)
        save_motion(folder / name / "punch.npz", px.load_motion("punch", fps=30.0))
        (folder / name / "ACTIONS.csv").write_text("\n".join(lines) + "\n")


def _dataset(run: Run, table: str) -> DatasetConfig:
    config = read_config(str(ROOT / f"experiments/datasets.toml#{table}"), DatasetConfig)
    if run.toy:
        config = dataclasses.replace(config, solver=XPBD(32, 1))
        some = config.outfits[: 3 if table == "variants" else 1]
        config = dataclasses.replace(config, outfits=some, outfits_each=1)
    return config


def _on_processor() -> AbstractContextManager[Any]:
    """For what consists of many small programs."""
    return jax.default_device(jax.local_devices(backend="cpu")[0])


def _cropped(motion: Motion) -> Motion:
    frames = motion.num_frames // _STEP * _STEP
    return dataclasses.replace(
        motion, rotations=motion.rotations[:frames], root=motion.root[:frames]
    )


def _motions(
    run: Run, splits: tuple[str, ...], ways: tuple[Way, ...]
) -> list[tuple[Action, Motion]]:
    """Every action in every way, on the processor, where a length's program costs little."""
    body, out = load_body(), []

    @functools.cache
    def load(folder: pathlib.Path, action: Action) -> Motion:
        return _cropped(load_action(folder, action))

    with _on_processor():
        for way in ways:
            folder = run.folder / FOLDERS[way.left_out]
            actions = [a for a in read_protocol(folder) if a.split in splits]
            for action in actions:
                motion = load(folder, action)
                if way.upper_from:
                    split = [a for a in actions if a.split == action.split]
                    other = split[(split.index(action) + way.upper_from) % len(split)]
                    motion = with_upper_body(body, motion, load(folder, other))
                if way.exaggerate != 1.0:
                    motion = exaggerated(motion, way.exaggerate)
                if way.subdue != 1.0:
                    motion = subdued(body, motion, way.subdue)
                if way.speed != 1.0:
                    motion = at_speed(motion, way.speed)
                motion = _cropped(motion)
                if motion.num_frames:
                    out.append((action, motion))
    return sorted(out, key=lambda x: x[1].num_frames)


def _simulated(
    run: Run,
    config: DatasetConfig,
    scene: PreparedScene,
    people: list[tuple[Action, Motion]],
    name: str,
    outfit: Outfit | None,
) -> list[Sequence]:
    """One garment on many people, half of them at a time: the shorter clips, then the longer."""
    out: list[Sequence] = []
    a, size = scene.assembly, max(-(-len(people) // 2), 1)
    for at in range(0, len(people), size):
        # Every group has the same size, since another size is another program.
        group = people[at : at + size]
        group += people[: size - len(group)]
        motions = [m for _, m in group]
        rollouts = simulate_batch(scene, motions, solver=config.solver)
        rest = (jnp.asarray(v.astype(np.float32)) for v in (a.rest_body, a.rest, a.weights))
        skinning = functools.partial(animate, a.body, *rest)
        for (action, motion), rollout in list(zip(group, rollouts, strict=True))[
            : len(people) - at
        ]:
            offsets = rollout.positions[0] - np.asarray(skinning(motion))
            good = bool(np.isfinite(offsets).all() and rollout.finite.all())
            good = good and float(np.abs(offsets).max()) <= 3.0
            worst = {k: v for k, v in rollout.worst.items() if np.isfinite(v)}
            meta = {**config.settings(), "fps": motion.fps, "finite": good, "worst": worst}
            offsets = (offsets if good else np.zeros_like(offsets)).astype(np.float32)
            motion = dataclasses.replace(motion, name=action.name)
            title = action.name if outfit is None else f"{action.name} #{len(out):03d}"
            out.append(Sequence(title, action.split, motion, {name: offsets}, {name: meta}, outfit))
        run.say(f"{name}: {min(at + size, len(people))} of {len(people)} people")
    return out


def _dump(path: pathlib.Path, sequences: list[Sequence]) -> None:
    """Stores clips and their mirror images, in the units in which networks learn them."""
    body, out = load_body(), []
    with _on_processor():
        for s in sequences:
            for mirror, clip in enumerate((s, mirrored_sequence(body, s))):
                offsets = {
                    t: np.round(x / QUANTIZATION_STEP).astype(np.int16)
                    for t, x in clip.offsets.items()
                }
                meta = {
                    t: {
                        **clip.meta[t],
                        "sha256": hashlib.sha256(np.ascontiguousarray(x)).hexdigest(),
                    }
                    for t, x in offsets.items()
                }
                name = clip.name + " mirrored" * mirror
                motion = dataclasses.replace(
                    clip.motion,
                    name=s.motion.name,
                    rotations=np.asarray(clip.motion.rotations),
                    root=np.asarray(clip.motion.root),
                )
                out.append(
                    dataclasses.replace(clip, name=name, motion=motion, offsets=offsets, meta=meta)
                )
    part = path.with_suffix(".part")
    with part.open("wb") as file:
        pickle.dump(out, file, protocol=5)
    part.rename(path)


def _read(path: pathlib.Path) -> list[Sequence]:
    with path.open("rb") as file:
        found = pickle.load(file)
    step = np.float32(QUANTIZATION_STEP)
    return [
        dataclasses.replace(s, offsets={t: x * step for t, x in s.offsets.items()}) for s in found
    ]


def clothes(run: Run, number: int) -> None:
    config = _dataset(run, "default")
    outfit = config.outfits[number]
    ((name, garment),) = outfit.garments().items()
    began = time.perf_counter()
    with _on_processor():
        scene = Scene((garment,), standard_effects((garment,)), None, outfit.params())
        scene = prepare_scene(scene)
    people = _motions(run, ("train", "extra"), WAYS[::2] if run.toy else WAYS)
    ready = time.perf_counter()
    found = _simulated(run, config, scene, people, name, outfit)
    _dump(WORK / f"clothes-{number}.pkl", found)
    run.add(
        f"clothes-{number}",
        f"{name}, clothes with ease",
        people=len(found),
        frames=sum(s.motion.num_frames for s in found),
        came_off=sum(not s.meta[name]["finite"] for s in found),
        preparation_s=ready - began,
        seconds=time.perf_counter() - ready,
    )


class _TimeUp(Exception):
    pass


def variants(run: Run, number: int) -> None:
    config, root = _dataset(run, "variants"), WORK / f"variants-{number}"
    until = 1.0 if run.toy else VARIANTS_UNTIL

    def report(text: str, done: int, total: int) -> None:
        run.say(f"variants {number}: {done} of {total}")
        if run.left(until) < 0:
            raise _TimeUp

    began = time.perf_counter()
    shards = 1 if run.toy else SHARDS
    try:
        folder = run.folder / FOLDERS[0]
        build_dataset(config, root, folder, shard=(number, shards), report=report)
    except _TimeUp:
        run.say(f"variants {number}: time is up")
    found = []
    for folder in list_sequences(root):
        s = read_sequence(folder)
        motion = _cropped(s.motion)
        if s.offsets and motion.num_frames:
            offsets = {t: x[: motion.num_frames] for t, x in s.offsets.items()}
            found.append(dataclasses.replace(s, motion=motion, offsets=offsets))
    _dump(WORK / f"variants-{number}.pkl", found)
    run.add(
        f"variants-{number}",
        "outfits",
        clips=len(found),
        frames=sum(s.motion.num_frames for s in found),
        seconds=time.perf_counter() - began,
    )


def paper(run: Run) -> None:
    config = DatasetConfig(solver=XPBD(32, 1)) if run.toy else DatasetConfig()
    people = _motions(run, ("train",), (Way(),))
    joined: dict[str, Sequence] = {}
    for name in config.templates[:1] if run.toy else config.templates:
        with _on_processor():
            scene = prepare_scene(Scene((template(name),)))
        for s in _simulated(run, config, scene, people, name, None):
            known = joined.setdefault(s.name, s)
            known.offsets.update(s.offsets)
            known.meta.update(s.meta)
    learn = read_config(str(ROOT / "experiments/training.toml#paper-cuda"), TrainConfig)
    if run.toy:
        model = dataclasses.replace(
            learn.model, templates=config.templates[:1], resolution=32, width=4
        )
        learn = dataclasses.replace(learn, model=model, batch=4, validate_every=20)
    data = load_data(learn, list(joined.values()))
    until = 0.9 if run.toy else PAPER_UNTIL
    _learn(run, "paper", learn, data, lambda: run.left(until))


class _Progress(NamedTuple):
    count: jax.Array
    total: jax.Array


def _anneal(total: int) -> optax.GradientTransformation:
    """Scales updates by a warm-up and a cosine; the length is no constant of the program."""
    return optax.GradientTransformation(functools.partial(_begin, total), _scale)


def _begin(total: int, params: Any) -> _Progress:
    del params
    return _Progress(jnp.zeros((), jnp.float32), jnp.asarray(total, jnp.float32))


def _scale(updates: Any, state: _Progress, params: Any = None) -> tuple[Any, _Progress]:
    del params
    done = state.count / state.total
    factor = jnp.minimum(50.0 * (done + 1.0 / state.total), 1.0)
    factor *= 0.5 * (1.0 + jnp.cos(jnp.pi * jnp.minimum(done, 1.0)))
    return jax.tree.map(lambda u: factor * u, updates), state._replace(count=state.count + 1.0)


def _learn(
    run: Run,
    name: str,
    config: TrainConfig,
    data: TrainingData,
    left: Callable[[], float],
) -> None:
    """Learns for the time that is left, to whose end a rate falls, and packs the weights."""
    steps = 20 if run.toy else 60

    def length(total: int) -> optax.GradientTransformation | None:
        return None if config.schedule == "constant" else _annealed(config, total)

    laps: list[float] = []
    began = time.perf_counter()
    quiet = _quiet(config)
    train(
        quiet,
        data,
        WORK / f"{name}-trial",
        optimizer=length(steps),
        steps=steps,
        report=lambda *_: laps.append(time.perf_counter()),
    )
    step_s = (laps[-1] - laps[0]) / (steps - 20) if len(laps) > 1 else laps[0] - began
    total = max(int((left() - 12.0) / step_s), 40)
    run.add(
        name,
        "trial",
        seconds=time.perf_counter() - began,
        ms_per_step=1e3 * step_s,
        steps_per_epoch=data.frames.steps_per_epoch,
        steps=min(total, 60) if run.toy else total,
    )
    total = min(total, 60) if run.toy else total
    validated = name == "paper"

    def report(done: int, _: int, values: dict[str, float]) -> None:
        found = {
            k: float(v) for k, v in values.items() if k.startswith(("validation", "l1", "los"))
        }
        if "validation_mm" in values or done % 500 == 0 or done == total:
            run.add(name, f"step {done}", **found)

    began = time.perf_counter()
    final = config if validated else quiet
    predictor = train(
        dataclasses.replace(final, epochs=10**4, checkpoint_every=10**9),
        data,
        WORK / f"{name}-run",
        optimizer=length(total),
        steps=total,
        report=report,
    )
    weights = WORK / f"{name}-weights"
    save_predictor(weights, predictor, name=name if name != "paper" else "paper-256")
    shutil.make_archive(str(WORK / f"{name}-packed"), "gztar", weights)
    packed = (WORK / f"{name}-packed.tar.gz").read_bytes()
    for k, at in enumerate(range(0, len(packed), _PIECE)):
        (OUT / f"{name}.tar.gz.{k}").write_bytes(packed[at : at + _PIECE])
    run.add(
        name,
        "run",
        steps=total,
        samples=total * config.batch,
        seconds=time.perf_counter() - began,
        megabytes=len(packed) / 1e6,
    )


def _quiet(config: TrainConfig) -> TrainConfig:
    """Without validation or checkpoints on the way."""
    never = 10**9
    return dataclasses.replace(config, validate_every=never, checkpoint_every=never, epochs=10**4)


def _annealed(config: TrainConfig, total: int) -> optax.GradientTransformation:
    inner = make_optimizer(
        dataclasses.replace(config, schedule="constant"),
        config.learning_rate,
        1,
        muon_learning_rate=config.muon_learning_rate if config.optimizer == "muon" else None,
    )
    return optax.chain(inner, _anneal(total))


def _compile(name: str, config: TrainConfig, data: TrainingData) -> None:
    """Puts the program of a network's step into the cache."""
    train(_quiet(config), data, WORK / f"{name}-first", optimizer=_annealed(config, 2), steps=2)


def networks(run: Run) -> None:
    roles = [f"variants:{k}" for k in range(1 if run.toy else SHARDS)]
    roles += [f"clothes:{k}" for k in range(1 if run.toy else 3)]
    sequences: list[Sequence] = []
    for role in roles:
        place = WORK / f"{role.replace(':', '-')}.pkl"
        while not place.is_file():
            if (WORK / f"{role}.ended").is_file() and not place.is_file():
                run.say(f"networks: nothing of {role}")
                break
            time.sleep(0.2)
        else:
            sequences += _read(place)
    run.say(f"networks: {len(sequences)} clips")
    configs = {n: _network_config(run, n) for n in (NETWORKS[-2:] if run.toy else NETWORKS)}
    data = load_data(next(iter(configs.values())), sequences)
    del sequences
    run.say("networks: loaded")
    shares = {n: SHARES[n] for n in configs}
    names = list(configs)
    _compile(names[0], configs[names[0]], data)
    run.say(f"{names[0]}: compiled")
    for name, following in zip(names, [*names[1:], None], strict=True):
        share = shares[name] / sum(shares.values())
        until = time.time() + share * (run.left() - 8.0)
        # The card learns while processors compile what comes next.
        thread = threading.Thread(target=_compile, args=(following, configs.get(following), data))
        if following is not None:
            thread.start()
        _learn(run, name, configs[name], data, lambda until=until: until - time.time())
        if following is not None:
            thread.join()
        del shares[name]


def _network_config(run: Run, name: str) -> TrainConfig:
    config = read_config(str(ROOT / f"experiments/training.toml#{name}-cuda"), TrainConfig)
    if run.toy:
        model = dataclasses.replace(config.model, resolution=64, width=4)
        config = dataclasses.replace(config, model=model, batch=4, start="")
    return config


ROLES: dict[str, Callable[..., None]] = {
    "clothes": clothes,
    "variants": variants,
    "paper": paper,
    "networks": networks,
}

if __name__ == "__main__":
    sys.exit(main())
