"""Builds a dataset: simulates every action with every template."""

import contextlib
import dataclasses
import functools
import itertools
import math
import pathlib
import time
from collections.abc import Collection
from typing import Any

import jax
import numpy as np

from ..body import Body
from ..errors import FormatError
from ..files import claim
from ..garment import Garment, template
from ..jobs import Job, Report, run_jobs
from ..motion import (
    Motion,
    animate,
    at_speed,
    exaggerated,
    frames_at_speed,
    mirrored,
    subdued,
    with_upper_body,
)
from ..simulation import (
    PreparedScene,
    Rollout,
    Scene,
    prepare_scene,
    simulate_batch,
    standard_effects,
)
from ..simulation.blender import simulate_blender
from ._config import CARD, DatasetConfig
from ._files import join, last_name
from ._outfit import Outfit
from ._protocol import FPS, Action, left_out, load_action, read_protocol
from ._store import (
    QUANTIZATION_STEP,
    Where,
    is_stored,
    open_dataset,
    read_note,
    remove_index,
    sequence_name,
    write_action,
    write_garment,
    write_offsets,
    write_times,
)
from ._stream import index_dataset


def build_dataset(
    config: DatasetConfig,
    root: Where,
    folder: str | pathlib.Path,
    *,
    shard: tuple[int, int] = (0, 1),
    only: tuple[str, ...] = (),
    report: Report | None = None,
    ray: str | None = None,
) -> int:
    """Simulates actions and stores the cloth relative to its skinning.

    Existing results are kept, so an interrupted build can be resumed. A job is one garment on one
    group of actions (`DatasetConfig.people`): on a Ray cluster or in several shards, which can be
    built concurrently into one store, the bytes are those of one process on such a processor.

    Args:
        config: Settings of the dataset.
        root: Folder of the dataset, or a URL that tensorstore takes.
        folder: Folder with the motion files and ``ACTIONS.csv``.
        shard: ``(i, n)``: the i-th of n equal parts of the jobs, counted from 0.
        only: Names of the actions to build; all of them if empty.
        report: Callback that takes a message, the jobs done and the total number of jobs.
        ray: Address of a Ray cluster whose machines all see ``root`` and ``folder``, or ``local``;
            None to build in this process.

    Returns:
        Number of garments simulated by this call.

    Raises:
        FormatError: ``root`` holds another dataset, an action of ``only`` isn't available,
            or ``upper_from`` selects the action itself.
        MotionError: ``folder`` holds no protocol.
        BusyError: Another process builds this dataset, or this shard of it.
    """
    folder = pathlib.Path(folder).absolute()
    root = root if "://" in str(root) else pathlib.Path(root).absolute()
    actions = _actions_in_splits(folder, config.splits)
    unknown = set(only) - {a.name for a in actions}
    if unknown:
        raise FormatError(
            f"no action '{', '.join(sorted(unknown))}' in the splits {', '.join(config.splits)};"
            f" there are: {', '.join(a.name for a in actions)}."
        )
    if config.left_out:
        # Before `only` is applied: actions cut from one clip share its unused stretch.
        actions = left_out(folder, actions)
        if without := set(only) - {a.name for a in actions}:
            raise FormatError(f"left_out selects no frames for {', '.join(sorted(without))}.")
    for split in config.splits if config.upper_from else ():
        number = sum(a.split == split for a in actions)
        if number and config.upper_from % number == 0:
            raise FormatError(
                f"upper_from is {config.upper_from}: with {number} actions in the split"
                f" '{split}', that is the action itself."
            )
    with _claimed(root, shard):
        return _build(config, root, folder, actions, shard, only, report, ray)


def _claimed(root: Where, shard: tuple[int, int]) -> contextlib.AbstractContextManager[None]:
    """Shards are built side by side, but each by one process."""
    if isinstance(root, str):
        return contextlib.nullcontext()
    part = "" if shard == (0, 1) else f"-{shard[0]}-of-{shard[1]}"
    return claim(root.with_name(root.name + part))


def _build(
    config: DatasetConfig,
    root: Where,
    folder: pathlib.Path,
    actions: list[Action],
    shard: tuple[int, int],
    only: tuple[str, ...],
    report: Report | None,
    ray: str | None,
) -> int:
    everyone = actions
    actions = [a for a in actions if not only or a.name in only]
    open_dataset(root, _note(config))
    # A group for each device; a job on a cluster has one.
    width = len(jax.local_devices()) if ray is None and config.engine == "physxnet" else 1
    jobs, count = [], 0
    planned = [
        (clothes, group)
        for clothes in _all_clothes(config)
        for group in _groups(config, _wearing(config, clothes, everyone, actions))
    ]
    # In one piece, so that few clothes are prepared by several shards.
    first, end = (-(-len(planned) * k // shard[1]) for k in (shard[0], shard[0] + 1))
    for clothes, own in itertools.groupby(planned[first:end], key=lambda p: p[0]):
        own_groups = [group for _, group in own]
        stored = {a: clothes.is_stored(root, a) for g in own_groups for a in g}
        count += sum(not s for s in stored.values())
        missing = [g for g in own_groups if not all(stored[a] for a in g)]
        for at in range(0, len(missing), width):
            groups = tuple(missing[at : at + width])
            label = f"{', '.join(a.name for g in groups for a in g)}: {clothes.label}"
            jobs.append(Job(label, _simulate, (config, root, clothes, groups, folder)))
    if jobs:
        remove_index(root)
    for _, lines in run_jobs(jobs, ray=ray, report=report):
        for slug, kind, line in lines:
            write_times(root, slug, kind, line)
    # Of several shards the last one lists all.
    index_dataset(root)
    return count


def expected_frames(root: Where, folder: str | pathlib.Path) -> dict[str, int]:
    """Expected number of frames of each sequence, from the dataset's own settings.

    Args:
        root: Folder or URL of the dataset.
        folder: Folder with the motion files and ``ACTIONS.csv``.
    """
    note = read_note(root)
    actions = _actions_in_splits(folder, note["splits"])
    if note.get("left_out", False):
        actions = left_out(folder, actions)
    frames = {a.name: frames_at_speed(a.frames, note.get("speed", 1.0)) for a in actions}
    count = len(note.get("outfits", ()))
    if not count:
        return frames
    each, first = note.get("outfits_each", 1), note.get("first_outfit", 0)
    return {
        sequence_name(a.name, number): frames[a.name]
        for k, a in enumerate(actions)
        for number in _outfits_of(k, count, each, first)
    }


def _outfits_of(action: int, count: int, each: int, first: int) -> list[int]:
    """Numbers of the outfits of an action, given its place among all actions."""
    return [(first + action * each + j) % count for j in range(each)]


@dataclasses.dataclass(frozen=True)
class _Clothes:
    """What is simulated together: a template, or the outfit of a number."""

    name: str
    outfit: Outfit | None = None
    number: int = 0

    @property
    def label(self) -> str:
        return self.name if self.outfit is None else " and ".join(self.outfit.wear)

    @property
    def garments(self) -> dict[str, Garment]:
        if self.outfit is not None:
            return self.outfit.garments()
        return {self.name: template(self.name)}  # pyright: ignore[reportArgumentType]

    def array(self, garment: str) -> str:
        """The name under which a garment of it is stored."""
        return garment if self.outfit is None else f"{garment}-{self.number:02d}"

    def folder(self, root: Where, action: Action) -> str:
        """The folder of an action in it."""
        return join(
            root, action.slug if self.outfit is None else f"{action.slug}-{self.number:02d}"
        )

    def is_stored(self, root: Where, action: Action) -> bool:
        folder = self.folder(root, action)
        return all(is_stored(folder, self.array(name)) for name in self.garments)


def _all_clothes(config: DatasetConfig) -> list[_Clothes]:
    if config.outfits:
        return [_Clothes(" and ".join(o.wear), o, k) for k, o in enumerate(config.outfits)]
    return [_Clothes(name) for name in config.templates]


def _wearing(
    config: DatasetConfig, clothes: _Clothes, everyone: list[Action], actions: list[Action]
) -> list[Action]:
    """Those of the actions that are simulated in some clothes."""
    if clothes.outfit is None:
        return actions
    numbers = (len(config.outfits), config.outfits_each, config.first_outfit)
    places = {a: k for k, a in enumerate(everyone)}
    return [a for a in actions if clothes.number in _outfits_of(places[a], *numbers)]


def _actions_in_splits(folder: str | pathlib.Path, splits: Collection[str]) -> list[Action]:
    return [a for a in read_protocol(folder) if a.split in splits]


def _note(config: DatasetConfig) -> dict[str, Any]:
    return {
        "format": 2,
        "fps": FPS,
        "unit": "m",
        "quantum": QUANTIZATION_STEP,
        "values": "cloth minus its linear blend skinning, world axes, Y up",
        "splits": list(config.splits),
        "templates": list(config.templates),
        "mirror": config.mirror,
        "speed": config.speed,
        **_changes(config),
        **config.settings(),
        **CARD,
    }


def _changes(config: DatasetConfig) -> dict[str, Any]:
    """Settings that differ from their defaults; datasets of earlier versions don't list them."""
    names = (
        *("left_out", "upper_from", "exaggerate", "subdue"),
        *("people", "outfits_each", "first_outfit"),
    )
    changes = {k: getattr(config, k) for k in names}
    defaults = DatasetConfig()
    out = {k: v for k, v in changes.items() if v != getattr(defaults, k)}
    return out | (
        {"outfits": [dataclasses.asdict(o) for o in config.outfits]} if config.outfits else {}
    )


def _groups(config: DatasetConfig, actions: list[Action]) -> list[tuple[Action, ...]]:
    """Actions that are simulated side by side: of similar length, whichever exist already."""
    if config.people > 1:
        actions = sorted(actions, key=lambda a: (a.frames, a.slug))
    starts = range(0, len(actions), config.people)
    return [tuple(actions[k : k + config.people]) for k in starts]


@functools.lru_cache(maxsize=1)
def _prepared(clothes: _Clothes) -> PreparedScene:
    # Programs compiled for the previous garment are no longer needed.
    jax.clear_caches()
    garments = tuple(clothes.garments.values())
    if clothes.outfit is None:
        return prepare_scene(Scene(garments))
    effects = standard_effects(garments)
    return prepare_scene(Scene(garments, effects, None, clothes.outfit.params()))


def _simulate(
    config: DatasetConfig,
    root: Where,
    clothes: _Clothes,
    groups: tuple[tuple[Action, ...], ...],
    folder: pathlib.Path,
) -> list[tuple[str, str, dict[str, Any]]]:
    """Stores clothes in groups of actions, one for each device; returns what each took."""
    group = tuple(action for g in groups for action in g)
    scene = _prepared(clothes)
    _write_garments(root, clothes, scene)
    motions = [action_motion(config, a, scene.assembly.body, folder) for a in group]
    for action, motion in zip(group, motions):
        place = clothes.folder(root, action)
        write_action(place, motion, action.split, clothes.outfit, clothes.number)
    start = time.perf_counter()
    if config.engine == "blender":
        one = Scene(tuple(clothes.garments.values()))
        rollouts = [simulate_blender(one, m, settings=config.blender) for m in motions]
    else:
        # Every group has the same size, since another size is another program.
        places = [group.index(a) for g in groups for a in (*g, *(config.people - len(g)) * g[-1:])]
        batch = [motions[k] for k in places]
        every = simulate_batch(scene, batch, solver=config.solver, devices=len(groups))
        rollouts = [every[places.index(k)] for k in range(len(group))]
    seconds = round((time.perf_counter() - start) / len(group), 2)
    lines = []
    for action, motion, rollout in zip(group, motions, rollouts):
        place = clothes.folder(root, action)
        _store(config, place, clothes, motion, rollout, scene)
        line = {"action": action.name, "template": clothes.name, "frames": motion.num_frames}
        kind = clothes.name if clothes.outfit is None else "outfit"
        lines.append((last_name(place), kind, line | {"seconds": seconds}))
    return lines


def _write_garments(root: Where, clothes: _Clothes, scene: PreparedScene) -> None:
    a, start = scene.assembly, 0
    for name, garment in clothes.garments.items():
        rest = a.rest[start : start + garment.num_vertices]
        write_garment(root, clothes.array(name), rest, np.asarray(garment.mesh.faces))
        start += garment.num_vertices


def _store(
    config: DatasetConfig,
    target: Where,
    clothes: _Clothes,
    motion: Motion,
    rollout: Rollout,
    scene: PreparedScene,
) -> None:
    every = np.concatenate(rollout.positions, axis=1) - skinned_cloth(scene, motion)
    # JSON has no infinity and no NaN.
    worst = {k: v for k, v in rollout.worst.items() if math.isfinite(v)}
    finite = bool(np.isfinite(every).all() and rollout.finite.all())
    if not np.isfinite(every).all() or np.abs(every).max() > 3.0:
        # Recorded as failed: one diverged simulation doesn't stop a build.
        every = np.zeros_like(every)
        finite = False
    meta = {**config.settings(), "fps": motion.fps, "finite": finite, "worst": worst}
    start = 0
    for name, garment in clothes.garments.items():
        offsets = every[:, start : start + garment.num_vertices]
        write_offsets(target, clothes.array(name), offsets, meta)
        start += garment.num_vertices


def action_motion(
    config: DatasetConfig, action: Action, body: Body, folder: str | pathlib.Path
) -> Motion:
    """Loads an action; upper body, exaggeration, subduing, mirror and speed as they are set."""
    motion = load_action(folder, action)
    if config.upper_from:
        split = [a for a in read_protocol(folder) if a.split == action.split]
        index = next(k for k, a in enumerate(split) if a.name == action.name)
        other = load_action(folder, split[(index + config.upper_from) % len(split)])
        motion = with_upper_body(body, motion, other)
    if config.exaggerate != 1.0:
        motion = exaggerated(motion, config.exaggerate)
    if config.subdue != 1.0:
        motion = subdued(body, motion, config.subdue)
    if config.mirror:
        motion = mirrored(body, motion)
    if config.speed != 1.0:
        motion = at_speed(motion, config.speed)
    return motion


def skinned_cloth(scene: PreparedScene, motion: Motion) -> np.ndarray:
    """Linear blend skinning of a scene's cloth [m] in every frame."""
    a = scene.assembly
    moved = animate(
        a.body,
        jax.device_put(a.rest_body.astype(np.float32)),
        jax.device_put(a.rest.astype(np.float32)),
        jax.device_put(a.weights.astype(np.float32)),
        motion,
    )
    return np.asarray(moved)
