"""Builds a dataset: simulates every action with every template."""

import math
import pathlib
import time
from collections.abc import Callable, Collection
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from ..body import Body
from ..errors import FormatError
from ..garment import Template, template
from ..motion import (
    Motion,
    animate,
    at_speed,
    exaggerated,
    frames_at_speed,
    mirrored,
    with_upper_body,
)
from ..simulation import PreparedScene, Rollout, Scene, prepare_scene, simulate_batch
from ..simulation.blender import simulate_blender
from ._config import CARD, DatasetConfig
from ._protocol import FPS, Action, left_out, load_action, read_protocol
from ._store import (
    QUANTIZATION_STEP,
    is_stored,
    log_build,
    open_dataset,
    read_note,
    write_action,
    write_garment,
    write_offsets,
)


def build_dataset(
    config: DatasetConfig,
    root: str | pathlib.Path,
    folder: str | pathlib.Path,
    *,
    shard: tuple[int, int] = (0, 1),
    only: tuple[str, ...] = (),
    report: Callable[[str, int, int], None] | None = None,
    ask: Callable[[Motion, Template], np.ndarray] | None = None,
) -> int:
    """Simulates actions and stores the cloth relative to its skinning.

    Existing results are kept, so an interrupted build can be resumed. Several shards can be
    built concurrently into one folder.

    Args:
        config: Settings of the dataset.
        root: Folder of the dataset.
        folder: Folder with the motion files and ``ACTIONS.csv``.
        shard: ``(i, n)``: every n-th action, starting with the i-th.
        only: Names of the actions to build; all of them if empty.
        report: Callback that takes a message, the jobs done and the total number of jobs.
        ask: Predicts a garment's vertices [m], shape [frames, vertices, 3], with the networks
            of the configuration. Required if and only if the engine is ``network``.

    Returns:
        Number of garments simulated by this call.

    Raises:
        FormatError: ``root`` holds another dataset, an action of ``only`` isn't available,
            ``upper_from`` selects the action itself, or ``ask`` doesn't match the engine.
        MotionError: ``folder`` holds no protocol.
    """
    root = pathlib.Path(root)
    if (config.engine == "network") != (ask is not None):
        raise FormatError(f"engine is '{config.engine}'; pass ask if and only if it is 'network'.")
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
    actions = [a for a in actions if not only or a.name in only]
    open_dataset(root, _note(config))
    own_actions = actions[shard[0] :: shard[1]]
    jobs: list[tuple[Template, Action]] = [(t, a) for t in config.templates for a in own_actions]
    done = 0
    prepared: tuple[str, PreparedScene] | None = None
    for k, (name, action) in enumerate(jobs):
        if report is not None:
            report(f"{action.name}, {name}", k, len(jobs))
        target = root / action.slug
        if is_stored(target, name):
            continue
        if prepared is None or prepared[0] != name:
            # Programs compiled for the previous garment are no longer needed.
            jax.clear_caches()
            prepared = (name, prepare_scene(Scene((template(name),))))
        scene = prepared[1]
        assembly = scene.assembly
        write_garment(root, name, assembly.rest, np.asarray(assembly.faces))
        _simulate(config, target, name, action, scene, pathlib.Path(folder), ask)
        done += 1
    if report is not None:
        report("done", len(jobs), len(jobs))
    return done


def expected_frames(root: str | pathlib.Path, folder: str | pathlib.Path) -> dict[str, int]:
    """Expected number of frames of each action, from the dataset's own settings.

    Args:
        root: Folder of the dataset.
        folder: Folder with the motion files and ``ACTIONS.csv``.
    """
    note = read_note(root)
    actions = _actions_in_splits(folder, note["splits"])
    if note.get("left_out", False):
        actions = left_out(folder, actions)
    return {a.name: frames_at_speed(a.frames, note.get("speed", 1.0)) for a in actions}


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
    changes = {k: getattr(config, k) for k in ("left_out", "upper_from", "exaggerate")}
    defaults = DatasetConfig()
    return {k: v for k, v in changes.items() if v != getattr(defaults, k)}


def _simulate(
    config: DatasetConfig,
    target: pathlib.Path,
    name: Template,
    action: Action,
    scene: PreparedScene,
    folder: pathlib.Path,
    ask: Callable[[Motion, Template], np.ndarray] | None,
) -> None:
    motion = action_motion(config, action, scene.assembly.body, folder)
    write_action(target, motion, action.split)
    start = time.perf_counter()
    if ask is not None:
        cloth = ask(motion, name)
        finite = np.asarray(np.isfinite(cloth).all(axis=(1, 2)))
        rollout = Rollout((cloth,), motion.fps, {"finite": finite})
    elif config.engine == "blender":
        rollout = simulate_blender(Scene((template(name),)), motion, settings=config.blender)
    else:
        rollout = simulate_batch(scene, [motion], solver=config.solver)[0]
    seconds = time.perf_counter() - start
    offsets = rollout.positions[0] - skinned_cloth(scene, motion)
    # JSON has no infinity and no NaN.
    worst = {k: v for k, v in rollout.worst.items() if math.isfinite(v)}
    finite = bool(np.isfinite(offsets).all() and rollout.finite.all())
    if not np.isfinite(offsets).all() or np.abs(offsets).max() > 3.0:
        # Recorded as failed: one diverged simulation doesn't stop a build.
        offsets = np.zeros_like(offsets)
        finite = False
    write_offsets(
        target,
        name,
        offsets,
        {**config.settings(), "fps": motion.fps, "finite": finite, "worst": worst},
    )
    line = {"action": action.name, "template": name, "frames": motion.num_frames}
    log_build(target.parent, line | {"seconds": round(seconds, 2)})


def action_motion(
    config: DatasetConfig, action: Action, body: Body, folder: pathlib.Path
) -> Motion:
    """Loads an action and applies the settings: upper body, exaggeration, mirror, speed."""
    motion = load_action(folder, action)
    if config.upper_from:
        split = [a for a in read_protocol(folder) if a.split == action.split]
        index = next(k for k, a in enumerate(split) if a.name == action.name)
        other = load_action(folder, split[(index + config.upper_from) % len(split)])
        motion = with_upper_body(body, motion, other)
    if config.exaggerate != 1.0:
        motion = exaggerated(motion, config.exaggerate)
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
        jnp.asarray(a.rest_body.astype(np.float32)),
        jnp.asarray(a.rest.astype(np.float32)),
        jnp.asarray(a.weights.astype(np.float32)),
        motion,
    )
    return np.asarray(moved)
