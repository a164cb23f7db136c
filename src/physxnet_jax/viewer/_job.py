"""What the viewer shows, computed from what is chosen in it."""

import dataclasses
import functools
import html
import pathlib
import time
from collections.abc import Callable
from typing import Any

import jax.numpy as jnp
import numpy as np

from .._environment import free_programs
from ..body import load_body
from ..dressing import (
    animated_meshes,
    dress,
    fit_surface,
    load_ladder,
    make_scene,
    wanted_clip,
)
from ..errors import PhysXNetError
from ..garment import FABRICS
from ..io import DEFAULT, AnimatedMesh, load_predictor, read_card
from ..models import Predictor
from ..motion import BLOCK, Motion, clip_transforms, stand_on_floor
from ..simulation import ACCURACY, Air, Effect, SelfContact, prepare_scene, simulate_batch
from ._live import Live
from ._maps import frame_maps

Progress = Callable[[str, int, int], None]


@dataclasses.dataclass(frozen=True)
class Choice:
    """Everything that can be chosen.

    Attributes:
        motion: A built-in clip or a motion file.
        wear: Templates and garment files.
        method: ``network``, ``lbs`` or ``simulate``.
        weights: Which network, and the ways behind its name (see `load_predictor`).
        push_out: Push vertices that end inside the body onto it.
        compare: Simulate the same clothes beside it, and colour by the distance.
        live: Ask the network for each frame in the moment it is shown, and tell what that
            takes.
        shape: Shape parameters by name; none for the default shape.
        accuracy: When simulated; the reference is always ``standard``, which taught the
            networks.
        fabric: Of all garments when simulated; their own if None.
        wind: Steady wind when simulated [m/s].
        self_contact: Garments collide with themselves when simulated.
        frames: Frames at most.
        fps: Frames a second.
        source_fps: True rate of a motion file [1/s], where its header is wrong or silent.
        skeleton: The ASF of an AMC file, if it doesn't lie beside it.
        joint_map: File of joint names for a motion file of unknown ones.
    """

    motion: str = "walk"
    wear: tuple[str, ...] = ("top", "bottom")
    method: str = "network"
    weights: str = DEFAULT
    push_out: bool = True
    compare: bool = False
    live: bool = False
    shape: tuple[tuple[str, float], ...] = ()
    accuracy: str = "standard"
    fabric: str | None = None
    wind: tuple[float, float, float] = (0.0, 0.0, 0.0)
    self_contact: bool = False
    frames: int = 150
    fps: float = 30.0
    source_fps: float | None = None
    skeleton: pathlib.Path | None = None
    joint_map: pathlib.Path | None = None


@dataclasses.dataclass(frozen=True)
class Shown:
    """A choice carried out.

    Attributes:
        choice: What was asked for.
        garments: The garments in motion.
        reference: The same garments simulated, or none.
        rest: Rest vertices of the body [m], shape [vertices, 3].
        world: World rotations of its joints, shape [frames, joints, 3, 3].
        shift: World translations of its joints [m], shape [frames, joints, 3].
        distances: By garment, distance to the reference [m], shape [frames, vertices].
        told: What was done, how fast and how well, as Markdown.
        clip: The motion.
        live: What computes the garments frame by frame; None if that isn't wanted.
    """

    choice: Choice
    garments: tuple[AnimatedMesh, ...]
    reference: tuple[AnimatedMesh, ...]
    rest: np.ndarray
    world: np.ndarray
    shift: np.ndarray
    distances: dict[str, np.ndarray]
    told: str
    clip: Motion
    live: Live | None = None

    @property
    def num_frames(self) -> int:
        """Number of frames."""
        return len(self.world)

    def meshes(self) -> tuple[AnimatedMesh, ...]:
        """The body and the garments, to be written."""
        positions = {m.name: m.positions for m in self.garments}
        body = animated_meshes(load_body(), self.clip, _shape(self.choice), (), positions)
        return (*body, *self.garments)

    def maps(self, frame: int, templates: tuple[str, ...]) -> dict[str, np.ndarray]:
        """The network's maps of a frame, as pictures."""
        choice = self.choice
        predictor = _predictor(
            choice.weights, choice.shape, str(read_card(choice.weights)["sha256"])
        )
        window = predictor.config.inputs.window
        rows = np.maximum(np.arange(frame + 1 - window, frame + 1), 0)
        return frame_maps(
            predictor,
            jnp.asarray(self.world[rows]),
            jnp.asarray(self.shift[rows]),
            self.clip.fps,
            templates,
        )


def check_choice(choice: Choice) -> None:
    """Refuses what no computation could carry out.

    Raises:
        PhysXNetError: No frame is asked for, or there is no such fabric, shape or network.
    """
    if choice.frames < 1:
        raise PhysXNetError(f"frames is {choice.frames}; ask for at least one.")
    if choice.fabric is not None and choice.fabric not in FABRICS:
        raise PhysXNetError(f"No fabric '{choice.fabric}'; there are {', '.join(FABRICS)}.")
    _shape(choice)
    if choice.method == "network":
        read_card(choice.weights)


def carry_out(choice: Choice, progress: Progress | None = None) -> Shown:
    """Dresses the person as chosen.

    Args:
        choice: What is wanted.
        progress: Called with a stage, frames done and frames in all.

    Raises:
        PhysXNetError: Anything that can't be read, bound or worn; the text says why.
    """
    check_choice(choice)
    # A page may be open for days.
    free_programs()
    body = load_body()
    shape = _shape(choice)
    clip = wanted_clip(
        choice.motion,
        fps=choice.fps,
        frames=choice.frames,
        source_fps=choice.source_fps,
        skeleton=choice.skeleton,
        joint_map=choice.joint_map,
        body=body,
        shape=shape,
    )
    rest = body.rest_vertices(body.default_shape() if shape is None else shape)
    if shape is not None:
        # As `dress` does with what is left of the clip: all stand on one floor.
        clip = stand_on_floor(body, clip, rest)
    garments: tuple[AnimatedMesh, ...] = ()
    reference: tuple[AnimatedMesh, ...] = ()
    lines = [f"{clip.num_frames} frames at {clip.fps:g} fps"]
    if choice.wear and choice.method == "simulate":
        garments, ms = _simulated(choice, clip, progress)
        lines.append(f"simulated ({choice.accuracy}): {ms:.0f} ms a frame, compilation included")
    elif choice.wear:
        dressed = dress(
            clip,
            choice.wear,
            method="lbs" if choice.method == "lbs" else "network",
            weights=choice.weights,
            fps=choice.fps,
            shape=shape,
            include_body=False,
            push_out=choice.push_out,
            progress=progress,
        )
        garments = dressed.garments
        stage = next(s for s in dressed.stages if s.name in ("network", "skinning"))
        cost = f"first {BLOCK} frames {stage.cold_ms:.0f} ms"
        if stage.warm_ms is not None:
            cost = f"{stage.warm_ms:.1f} ms a frame ({cost})"
        inside = 100 * float(np.mean(list(dressed.inside.values())))
        lines += [f"{choice.method}: {cost}", f"{inside:.2f} % of vertices inside the body"]
        lines.append(_known_error(choice))
        # A note may name a file; the page takes HTML.
        lines += [html.escape(note) for note in dressed.notes]
    distances = {}
    if choice.compare and choice.wear and choice.method != "simulate":
        taught = dataclasses.replace(choice, accuracy="standard")
        reference, _ = _simulated(taught, clip, progress)
        by_name = {m.name: m.positions for m in reference}
        for m in garments:
            distances[m.name] = np.linalg.norm(m.positions - by_name[m.name], axis=2)
            rmse = 1e3 * float(np.sqrt((distances[m.name] ** 2).mean()))
            # A garment's name comes from a file's; the page takes HTML.
            name = html.escape(m.name)
            lines.append(f"{name}: {rmse:.1f} mm RMSE from the simulation beside it")
    world, shift = clip_transforms(body, rest, clip)
    told = "\n".join(f"* {line}" for line in lines if line)
    live = None
    if choice.live and choice.wear and choice.method == "network":
        live = Live(
            clip, choice.wear, weights=choice.weights, shape=shape, push_out=choice.push_out
        )
    return Shown(
        choice,
        garments,
        reference,
        np.asarray(rest),
        np.asarray(world),
        np.asarray(shift),
        distances,
        told,
        clip,
        live,
    )


def _simulated(
    choice: Choice, clip: Motion, progress: Progress | None
) -> tuple[tuple[AnimatedMesh, ...], float]:
    also: list[Effect] = []
    if any(choice.wind):
        also.append(Air(wind=choice.wind))
    if choice.self_contact:
        also.append(SelfContact())
    job = make_scene(clip, choice.wear, fabric=choice.fabric, shape=_shape(choice), also=also)
    began = time.perf_counter()
    rollout = simulate_batch(
        prepare_scene(job.scene),
        [clip],
        solver=ACCURACY[choice.accuracy].at_rate(clip.fps),
        progress=None if progress is None else functools.partial(progress, "simulation"),
    )[0]
    rollout.check()
    took = 1e3 * (time.perf_counter() - began) / clip.num_frames
    names = [g.name for g in job.scene.garments]
    positions = dict(zip(names, rollout.positions, strict=True))
    meshes = animated_meshes(
        load_body(), clip, _shape(choice), job.scene.garments, positions, include_body=False
    )
    return meshes, took


def _known_error(choice: Choice) -> str:
    """The error that was measured for this way to dress, whatever is shown."""
    name = "lbs" if choice.method == "lbs" else choice.weights
    if choice.push_out and choice.method == "network":
        name += "+push"
    for rung in load_ladder():
        if rung.name == name:
            errors = ", ".join(f"{t} {e:.1f}" for t, e in rung.rmse_mm.items())
            return f"RMSE over the twelve test actions: {errors} mm"
    return ""


def _shape(choice: Choice) -> Any | None:
    return load_body().shape(**dict(choice.shape)) if choice.shape else None


@functools.lru_cache(4)
def _predictor(weights: str, shape: tuple[tuple[str, float], ...], sha256: str) -> Predictor:
    """Kept as long as the weights of that name stay what they are."""
    del sha256
    body = load_body()
    params = body.shape(**dict(shape)) if shape else None
    rest = body.rest_vertices(body.default_shape() if params is None else params)
    return fit_surface(load_predictor(weights), body, rest)
