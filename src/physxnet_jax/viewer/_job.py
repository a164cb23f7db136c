"""Computes what the viewer shows from its settings."""

import dataclasses
import functools
import html
import pathlib
import time
from collections.abc import Callable
from typing import Any, Literal

import jax
import numpy as np

from .._environment import clear_caches_if_full
from ..body import Body, load_body
from ..dressing import (
    INFERENCE_STAGES,
    Character,
    Dresser,
    Inference,
    Simulation,
    animated_meshes,
    dress,
    load_character,
    make_dresser,
    make_scene,
    run_simulation,
)
from ..errors import FormatError, PhysXNetError
from ..evaluation import load_cost_table, method_name, parse_method
from ..files import is_file
from ..garment import find_fabric, with_default_fabric
from ..io import AnimatedMesh
from ..models import read_card
from ..motion import BLOCK, Motion, clip_transforms, prepare_motion, stand_on_floor
from ._live import Live
from ._maps import frame_maps

Progress = Callable[[str, int, int], None]


@dataclasses.dataclass(frozen=True)
class Choice:
    """Settings of the viewer.

    Attributes:
        motion: A built-in clip or a motion file.
        wear: Templates and garment files.
        method: ``network``, ``guided``, ``lbs`` or ``simulate``.
        inference: Weights and post-processing.
        compare: Simulate the same clothes for comparison, and colour by the distance.
        live: Compute each frame when it is shown, and report the time.
        shape: Shape parameters by name; none for the default shape.
        simulation: Options of the simulator. The reference is always ``standard``, on which
            the networks were trained.
        fabric: Fabric of garments that specify none, or its file.
        character: A rigged character that moves in place of the built-in body.
        start: Start time in the motion [s].
        frames: Maximum number of frames.
        fps: Frames per second.
        source_fps: True rate of a motion file [1/s], if its header is wrong or lacks it.
        skeleton: The ASF file of an AMC file, if it is in another folder.
        up: Axis of a motion file that points up; found from its skeleton if omitted.
        joint_map: File of joint names for a motion file whose names are unknown.
    """

    motion: str = "walk"
    wear: tuple[str, ...] = ("shirt", "trousers")
    method: str = "guided"
    inference: Inference = dataclasses.field(default_factory=Inference)
    compare: bool = False
    live: bool = False
    shape: tuple[tuple[str, float], ...] = ()
    simulation: Simulation = dataclasses.field(default_factory=Simulation)
    fabric: str | None = None
    character: pathlib.Path | None = None
    start: float = 0.0
    frames: int = 150
    fps: float = 30.0
    source_fps: float | None = None
    skeleton: pathlib.Path | None = None
    up: Literal["y", "z"] | None = None
    joint_map: pathlib.Path | None = None


@dataclasses.dataclass(frozen=True)
class Shown:
    """The result of a choice.

    Attributes:
        choice: The settings.
        garments: The animated garments.
        reference: The same garments simulated, or none.
        rest: Rest vertices of the body [m], shape [vertices, 3].
        world: World rotations of its joints, shape [frames, joints, 3, 3].
        shift: World translations of its joints [m], shape [frames, joints, 3].
        distances: By garment, distance to the reference [m], shape [frames, vertices].
        summary: The computation, its speed and its accuracy, as Markdown.
        clip: The motion.
        live: Computes the garments frame by frame; None if it wasn't requested.
        character: The character that wears them; None for the built-in body.
    """

    choice: Choice
    garments: tuple[AnimatedMesh, ...]
    reference: tuple[AnimatedMesh, ...]
    rest: np.ndarray
    world: np.ndarray
    shift: np.ndarray
    distances: dict[str, np.ndarray]
    summary: str
    clip: Motion
    live: Live | None = None
    character: Character | None = None

    @property
    def num_frames(self) -> int:
        """Number of frames."""
        return len(self.world)

    def meshes(self) -> tuple[AnimatedMesh, ...]:
        """The person and the garments, for export."""
        if self.character is not None:
            return (self.character.mesh, *self.garments)
        positions = {m.name: m.positions for m in self.garments}
        body = animated_meshes(load_body(), self.clip, _shape(self.choice), (), positions)
        return (*body, *self.garments)

    def maps(self, frame: int) -> dict[str, np.ndarray]:
        """The network's maps of a frame for what is worn, as pictures; none for a character."""
        choice = self.choice
        if self.character is not None:
            return {}
        weights = str(choice.inference.weights)
        worn = with_default_fabric(choice.wear, choice.fabric) or ("bottom",)
        dresser = _network(worn, weights, choice.shape, str(read_card(weights)["sha256"]))
        rows = np.arange(frame - dresser.history_length(self.clip.fps), frame + 1)
        rows = np.maximum(rows, 0)
        return frame_maps(
            dresser,
            jax.device_put(self.world[rows]),
            jax.device_put(self.shift[rows]),
            self.clip.fps,
        )


def check_choice(choice: Choice) -> None:
    """Checks that a choice can be computed.

    Raises:
        PhysXNetError: No frame is requested, or there is no such fabric, shape or network.
    """
    if choice.frames < 1:
        raise PhysXNetError(f"frames is {choice.frames}; it must be at least one.")
    if choice.fabric is not None:
        find_fabric(choice.fabric)
    if choice.character is not None and not is_file(choice.character):
        raise FormatError(f"{choice.character}: no such file. Check the path.")
    _shape(choice)
    if choice.method in ("network", "guided"):
        read_card(str(choice.inference.weights))


def run_job(choice: Choice, progress: Progress | None = None) -> Shown:
    """Dresses the person with these settings.

    Args:
        choice: The settings.
        progress: Called with a stage, the frames done and the total.

    Raises:
        PhysXNetError: An input can't be read, bound or worn; the text gives the reason.
    """
    check_choice(choice)
    # A page may stay open for days.
    clear_caches_if_full()
    person, body, clip = _person(choice, progress)
    character = person if isinstance(person, Character) else None
    # A character has a shape of its own.
    shape = None if character is not None else _shape(choice)
    rest = body.rest_vertices(body.default_shape() if shape is None else shape)
    garments: tuple[AnimatedMesh, ...] = ()
    reference: tuple[AnimatedMesh, ...] = ()
    lines = [f"{clip.num_frames} frames at {clip.fps:g} fps"]
    if choice.wear and choice.method == "simulate":
        garments, ms = _simulated(choice, person, progress)
        engine = choice.simulation.engine
        how = choice.simulation.accuracy if engine == "xpbd" else engine
        lines.append(f"simulated ({how}): {ms:.0f} ms a frame, compilation included")
    elif choice.wear:
        garments, found = _dressed(choice, person, shape, progress)
        lines += found
    distances: dict[str, np.ndarray] = {}
    if choice.compare and choice.wear and choice.method != "simulate":
        reference, distances = _compared(choice, person, garments, progress)
        for name, distance in distances.items():
            rmse = 1e3 * float(np.sqrt((distance**2).mean()))
            # Escaped, because the name may come from a file and the page renders HTML.
            lines.append(f"{html.escape(name)}: {rmse:.1f} mm RMSE from the simulation")
    world, shift = clip_transforms(body, rest, clip)
    if character is not None and choice.live:
        lines.append("frames are computed while playing on the built-in body alone")
    summary = "\n".join(f"* {line}" for line in lines if line)
    live = None
    if character is None and choice.live and choice.wear and choice.method in ("network", "guided"):
        live = Live(
            clip,
            with_default_fabric(choice.wear, choice.fabric),
            method=choice.method,
            inference=choice.inference,
            simulation=_effects(choice),
            shape=shape,
        )
    return Shown(
        choice,
        garments,
        reference,
        np.asarray(rest),
        np.asarray(world),
        np.asarray(shift),
        distances,
        summary,
        clip,
        live,
        character,
    )


# The last character, and what it was made from.
_FITTED: dict[str, Any] = {}


def _person(choice: Choice, progress: Progress | None) -> tuple[Motion | Character, Body, Motion]:
    """Who is dressed, the body that is or follows them, and its motion."""
    shape = None if choice.character is not None else _shape(choice)
    body = load_body()
    clip = prepare_motion(
        choice.motion,
        fps=choice.fps,
        start=choice.start,
        frames=choice.frames,
        source_fps=choice.source_fps,
        skeleton=choice.skeleton,
        up=choice.up,
        joint_map=choice.joint_map,
        body=body,
        shape=shape,
    )
    if choice.character is not None:
        character = _moved(choice.character, clip, progress)
        return character, character.body, character.motion.moved(character.place)
    if shape is not None:
        # As in `dress`, after slicing: the lowest foot of the clip is on the floor.
        clip = stand_on_floor(body, clip, body.rest_vertices(shape))
    return clip, body, clip


def _moved(path: pathlib.Path, clip: Motion, progress: Progress | None) -> Character:
    """The character in a motion; fitting the body to it takes longer than most changes."""
    poses = (np.asarray(x).tobytes() for x in (clip.rotations, clip.root))
    key = path, path.stat().st_mtime_ns, clip.fps, *poses
    if _FITTED.get("key") != key:
        _FITTED["character"] = load_character(path, fps=clip.fps, motion=clip, progress=progress)
        _FITTED["key"] = key
    return _FITTED["character"]


def _dressed(
    choice: Choice, person: Motion | Character, shape: Any | None, progress: Progress | None
) -> tuple[tuple[AnimatedMesh, ...], list[str]]:
    """Garments by network or skinning, and lines that describe the result."""
    dressed = dress(
        person,
        with_default_fabric(choice.wear, choice.fabric),
        method=choice.method,  # pyright: ignore[reportArgumentType]
        inference=choice.inference,
        simulation=_effects(choice),
        fps=choice.fps,
        shape=shape,
        include_body=False,
        progress=progress,
    )
    stage = next(s for s in dressed.stages if s.name in INFERENCE_STAGES)
    cost = f"first {BLOCK} frames {stage.cold_ms:.0f} ms"
    if stage.warm_ms is not None:
        cost = f"{stage.warm_ms:.1f} ms a frame ({cost})"
    inside = 100 * float(np.mean(list(dressed.inside.values())))
    lines = [f"{choice.method}: {cost}", f"{inside:.2f} % of vertices inside the body"]
    lines.append(_known_error(choice))
    # Escaped, because a note may contain a file name and the page renders HTML.
    lines += [html.escape(note) for note in dressed.notes]
    return dressed.garments, lines


def _effects(choice: Choice) -> Simulation:
    """The options that a guided simulation has."""
    s = choice.simulation
    return Simulation(wind=s.wind, self_contact=s.self_contact, substeps=s.substeps)


def _compared(
    choice: Choice,
    person: Motion | Character,
    garments: tuple[AnimatedMesh, ...],
    progress: Progress | None,
) -> tuple[tuple[AnimatedMesh, ...], dict[str, np.ndarray]]:
    """The simulation beside the garments, and the distances to it [m]."""
    reference, _ = _simulated(choice, person, progress)
    by_name = {m.name: m.positions for m in reference}
    return reference, {
        m.name: np.linalg.norm(m.positions - by_name[m.name], axis=2) for m in garments
    }


def _simulated(
    choice: Choice, person: Motion | Character, progress: Progress | None
) -> tuple[tuple[AnimatedMesh, ...], float]:
    wear = with_default_fabric(choice.wear, choice.fabric)
    began = time.perf_counter()
    if isinstance(person, Character):
        dressed = dress(
            person,
            wear,
            method="simulate",
            simulation=choice.simulation,
            include_body=False,
            progress=progress,
        )
        return dressed.garments, 1e3 * (time.perf_counter() - began) / dressed.num_frames
    clip = person
    job = make_scene(clip, wear, simulation=choice.simulation, shape=_shape(choice))
    began = time.perf_counter()
    rollout = run_simulation(job.scene, clip, choice.simulation, progress=progress)
    took = 1e3 * (time.perf_counter() - began) / clip.num_frames
    names = [g.name for g in job.scene.garments]
    positions = dict(zip(names, rollout.positions, strict=True))
    meshes = animated_meshes(
        load_body(), clip, _shape(choice), job.scene.garments, positions, include_body=False
    )
    return meshes, took


def _known_error(choice: Choice) -> str:
    """The tabulated error of this method, which doesn't depend on the clip."""
    name = "lbs" if choice.method == "lbs" else method_name(choice.inference)
    if choice.method == "guided":
        name = f"{choice.inference.weights}+guided"
    iterations = choice.inference.strain_iterations
    if choice.method == "network" and iterations != parse_method(name).strain_iterations:
        return ""
    for profile in load_cost_table():
        if profile.name == name:
            errors = ", ".join(f"{t} {e:.1f}" for t, e in profile.rmse_mm.items())
            return f"RMSE over the twelve test actions: {errors} mm"
    return ""


def _shape(choice: Choice) -> Any | None:
    return load_body().shape(**dict(choice.shape)) if choice.shape else None


@functools.lru_cache(4)
def _network(
    wear: tuple[str, ...], weights: str, shape: tuple[tuple[str, float], ...], sha256: str
) -> Dresser:
    """Binds garments to a network; the checksum invalidates the cache when the weights change."""
    del sha256
    bare = Inference(weights=weights, strain_iterations=0, collisions=False)
    params = load_body().shape(**dict(shape)) if shape else None
    return make_dresser(wear, inference=bare, shape=params)
