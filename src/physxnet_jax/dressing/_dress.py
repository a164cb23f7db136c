"""Dresses a motion in garments and returns animated meshes."""

import concurrent.futures
import contextlib
import dataclasses
import math
import pathlib
import time
from collections.abc import Callable
from typing import Any, Literal

import numpy as np
from jaxtyping import Array, Float

from .._environment import clear_caches_if_full
from ..body import NUM_BODY_VERTICES, Body, load_body
from ..devices import on_processor, prepared_on_processor
from ..errors import PhysXNetError
from ..files import claim
from ..frames import FrameStore, in_chunks, moved_frames
from ..garment import Garment
from ..io import AnimatedMesh
from ..models import BoundGarment, Predictor, load_predictor
from ..motion import BLOCK, Motion, ground_point, prepare_motion, slice_motion, sudden_turns
from ..simulation import Rollout, Status
from ._blocks import Block, PosedClip, infer_clip, inside_shares, pose_clip
from ._character import (
    Character,
    bind_to_character,
    character_penetration,
    dress_character,
)
from ._dresser import Dresser, dress_garments, move_to_body
from ._inference import Inference
from ._meshes import Wear, animated_meshes, resolve_garments
from ._simulate import EXTERNAL_ENGINES, Simulation, build_scene, run_simulation, with_floor
from ._stages import Stage, timed
from .postprocess import BodyCollider, clip_at_sites, make_colliders, prepare_layers

Method = Literal["network", "guided", "lbs", "simulate"]
METHODS: tuple[Method, ...] = ("network", "guided", "lbs", "simulate")
_STAGES: dict[Method, str] = {
    "lbs": "skinning",
    "network": "network",
    "guided": "guided simulation",
    "simulate": "simulation",
}
INFERENCE_STAGES = tuple(name for method, name in _STAGES.items() if method != "simulate")
"""Names of the stages in which cloth is inferred."""
Progress = Callable[[str, int, int], None]
# A character's lowest point within this of 0 stands on the floor at 0 [m].
_ON_FLOOR = 0.05
# Steps of single precision at the first frame beyond which a note is due [m].
_COARSE = 1e-3


@dataclasses.dataclass(frozen=True, kw_only=True)
class DressedClip:
    """A dressed person in motion.

    Attributes:
        meshes: The body (unless left out) and the garments in the order worn.
        fps: Frames per second.
        stages: Time of each stage.
        hit_rate: For each garment, share of vertices whose ray hit the body; None
            where no ray is cast (lbs, simulate).
        fallbacks: For each garment, number of vertices bound by the closest point; None
            likewise.
        inside_raw: For each garment, share of vertices below the nearby skin before
            collision resolution. Skin of another limb is ignored.
        inside: The same in the result; for a `Character` measured against the character's
            surface.
        method: How the cloth was computed.
        notes: Warnings and remarks.
        worst: For each garment, the frame with the largest share inside the body, and that
            share; empty for a `Character`.
        rollout: The simulation with its diagnostics; None for other methods.
        effects: Names of the effects that acted in the simulation; those of an external engine
            aren't listed.
    """

    meshes: tuple[AnimatedMesh, ...]
    fps: float
    stages: tuple[Stage, ...]
    hit_rate: dict[str, float | None]
    fallbacks: dict[str, int | None]
    inside_raw: dict[str, float]
    inside: dict[str, float]
    method: str
    notes: tuple[str, ...] = ()
    worst: dict[str, tuple[int, float]] = dataclasses.field(default_factory=dict)
    rollout: Rollout | None = None
    effects: tuple[str, ...] = ()

    @property
    def garments(self) -> tuple[AnimatedMesh, ...]:
        """The garments alone."""
        return tuple(m for m in self.meshes if m.name != "body")

    @property
    def came_off(self) -> bool:
        """Whether a simulated garment slid off the body in some frame."""
        return self.rollout is not None and bool((self.rollout.status & int(Status.OFF)).any())

    @property
    def num_frames(self) -> int:
        """Number of frames."""
        return len(self.meshes[0].positions)


def dress(
    motion: Motion | Character | str | pathlib.Path,
    wear: Wear = ("shirt", "trousers"),
    *,
    method: Method = "guided",
    inference: Inference | None = None,
    simulation: Simulation | None = None,
    fps: float | int = 30.0,
    start: float = 0.0,
    frames: int | None = None,
    body: Body | None = None,
    shape: Float[Array, " shapes"] | None = None,
    include_body: bool = True,
    progress: Progress | None = None,
    on_block: Callable[[Block], None] | None = None,
    on_size: Callable[[int, dict[str, int]], None] | None = None,
) -> DressedClip:
    """Dresses a moving person.

    Args:
        motion: A motion, a motion file, the name of a built-in clip, or a `Character`, which
            defines body, shape and frame rate.
        wear: Garments, garment files or template names, with options as in
            ``coat.obj:as=top,fabric=wool`` (see `Wear`).
        method: ``guided`` (a network, and a few substeps of simulation drawn to it), ``network``
            (without those), ``lbs`` (skinning alone) or ``simulate`` (the cloth simulator).
        inference: Weights and post-processing of ``network`` and ``lbs``; ``collisions`` also
            apply to cloth simulated on a character, guided or not.
        simulation: Options of ``simulate``, and effects and substeps of ``guided``.
        fps: Frames per second of the result.
        start: Start time within the motion [s].
        frames: Keep only this many frames.
        body: The body; the built-in one by default.
        shape: Shape parameters; the default shape if omitted.
        include_body: Whether the result contains the body's mesh.
        progress: Called with the stage, the frames done and the total number of frames.
        on_block: Called with each finished block of all methods but ``simulate``.
        on_size: Called with the number of frames and each mesh's number of vertices before the
            cloth is computed; what it raises ends the call.

    Returns:
        Animated meshes, with the time of each stage. Positions of more than 64 MB are kept in a
        nameless file among temporary files ($TMPDIR), read as they are used, and can't be written.

    Raises:
        PhysXNetError: An input can't be read, bound or worn; the message states the reason.
        DiskFullError: The clip fits neither in memory nor on the disk, see `FrameStore`.

    Example:
        >>> clip = dress("walk", ["bottom"], method="lbs", frames=2)
        >>> [m.name for m in clip.meshes]
        ['body', 'bottom']
    """
    stages: list[Stage] = []
    inference = Inference() if inference is None else inference
    simulation = Simulation() if simulation is None else simulation
    _check_options(method, motion, body, shape)
    clear_caches_if_full()
    person = _load_person(motion, body, shape, fps, start, frames, stages)
    garments, notes = _load_garments(wear, person, method, stages)
    if on_size is not None:
        sizes = {"body": person.num_vertices} if include_body else {}
        on_size(person.clip.num_frames, sizes | {g.name: g.num_vertices for g in garments})
    if method in ("guided", "simulate"):
        where = garments, person.body, person.shape, person.clip.motion, person.floor
        simulation = with_floor(simulation, *where)
    dresser = _make_dresser(garments, person, method, inference, simulation, stages)
    if progress is not None:
        progress(_STAGES[method], 0, person.clip.num_frames)
    with concurrent.futures.ThreadPoolExecutor(1) as pool:
        # Compiled while the cloth's own program is.
        colliders = pool.submit(_colliders, dresser, person)
        if method == "simulate":
            cloth = _simulate_cloth(garments, person, simulation, stages, progress)
        else:
            resume = simulation.resume
            cloth = _infer_cloth(
                dresser, person, method, stages, progress, on_block, resume, colliders
            )
        if not cloth.inside:
            cloth = _measured(cloth, dresser, person, colliders.result())
    if method == "guided" and person.character is not None and inference.collisions:
        dresser = _with_contacts(dresser, inference)
    return _assemble_clip(dresser, person, cloth, method, include_body, notes, stages)


@dataclasses.dataclass(frozen=True, kw_only=True)
class _Person:
    """The person to dress: a character, or a body with shape parameters.

    All is computed with the first frame above the origin, as far from it positions are coarse;
    ``place`` is added to the result.
    """

    body: Body
    shape: Float[Array, " shapes"] | None
    clip: PosedClip
    character: Character | None
    place: Float[np.ndarray, "3"]

    @property
    def num_vertices(self) -> int:
        """Number of vertices that are written of the person."""
        if self.character is None:
            return NUM_BODY_VERTICES
        return self.character.mesh.positions.shape[1]

    @property
    def floor(self) -> float:
        """Height of the floor [m]: that of a character's lowest point, if it isn't near 0."""
        if self.character is None:
            return 0.0
        lowest = float(self.character.mesh.positions[..., 1].min())
        return lowest if abs(lowest) > _ON_FLOOR else 0.0


@dataclasses.dataclass(frozen=True, kw_only=True)
class _Cloth:
    """Garments by name [m], and for each the share inside the body in every frame.

    The shares before collision resolution come first; there are none for a character. A rollout has
    the same garments in the same order.
    """

    positions: dict[str, np.ndarray]
    inside: dict[str, tuple[np.ndarray, np.ndarray]] = dataclasses.field(default_factory=dict)
    milliseconds: float = 0.0
    rollout: Rollout | None = None
    effects: tuple[str, ...] = ()


def _check_options(method: str, motion: Any, body: Any, shape: Any) -> None:
    if method not in METHODS:
        raise PhysXNetError(f"No method '{method}'; there are {', '.join(METHODS)}.")
    if isinstance(motion, Character):
        if body is not None or shape is not None:
            raise PhysXNetError("A character has its own body: leave out body and shape.")


def _load_person(
    motion: Motion | Character | str | pathlib.Path,
    body: Body | None,
    shape: Float[Array, " shapes"] | None,
    fps: float | int,
    start: float,
    frames: int | None,
    stages: list[Stage],
) -> _Person:
    character = None
    if isinstance(motion, Character):
        motion = character = motion.after(start)
        start = 0.0
    with timed(stages, "motion"):
        if isinstance(motion, Character):
            body, fps, motion = motion.body, motion.fps, motion.motion
        body = load_body() if body is None else body
        whole = prepare_motion(motion, fps=fps, body=body, shape=shape)
        part, past = slice_motion(whole, start, frames)
        rest = body.rest_vertices(body.checked_shape(shape))
        place = ground_point(part) if character is None else character.place
        if character is None:
            part, past = (m and m.moved(-place) for m in (part, past))
        clip = pose_clip(body, rest, part, past)
    return _Person(body=body, shape=shape, clip=clip, character=character, place=place)


def _load_garments(
    wear: Wear, person: _Person, method: Method, stages: list[Stage]
) -> tuple[list[Garment], tuple[str, ...]]:
    character = person.character
    with timed(stages, "garments"):
        # Garments are modelled on the built-in body, then transferred to the character.
        body, shape = (person.body, person.shape) if character is None else (load_body(), None)
        garments, notes = resolve_garments(wear, body, shape)
        if character is not None:
            return [bind_to_character(g, character) for g in garments], notes
        return [move_to_body(person.body, g) for g in garments], notes


def _make_dresser(
    garments: list[Garment],
    person: _Person,
    method: Method,
    inference: Inference,
    simulation: Simulation,
    stages: list[Stage],
) -> Dresser:
    if method in ("network", "guided") and not isinstance(inference.weights, Predictor):
        with timed(stages, "weights"):
            weights = load_predictor(inference.weights)
            inference = dataclasses.replace(inference, weights=weights)
    with timed(stages, "binding"):
        return dress_garments(
            garments,
            method="lbs" if method == "simulate" else method,
            inference=inference,
            simulation=simulation,
            body=person.body,
            shape=person.shape,
        )


def _simulate_cloth(
    garments: list[Garment],
    person: _Person,
    simulation: Simulation,
    stages: list[Stage],
    progress: Progress | None,
) -> _Cloth:
    scene = build_scene(garments, person.body, person.shape, simulation)
    rollout = run_simulation(
        scene, person.clip.motion, simulation, progress=progress, stages=stages
    )
    cloth = dict(zip([g.name for g in scene.garments], rollout.positions, strict=True))
    own = simulation.engine not in EXTERNAL_ENGINES
    effects = tuple(type(e).__name__ for e in scene.effects) if own else ()
    return _Cloth(positions=cloth, rollout=rollout, effects=effects)


def _infer_cloth(
    dresser: Dresser,
    person: _Person,
    method: Method,
    stages: list[Stage],
    progress: Progress | None,
    on_block: Callable[[Block], None] | None,
    resume: pathlib.Path | None,
    colliders: "concurrent.futures.Future[tuple[BodyCollider, ...]]",
) -> _Cloth:
    clip = person.clip
    names = [w.name for w in dresser.worn]
    stores = {n: FrameStore(clip.num_frames) for n in names}
    inside: dict[str, list[tuple[np.ndarray, np.ndarray]]] = {n: [] for n in names}
    measuring = 0.0
    name = _STAGES[method]
    times: list[float] = []
    with contextlib.nullcontext() if resume is None else claim(resume):
        for block in infer_clip(dresser, clip, resume):
            times += [] if math.isnan(block.milliseconds) else [block.milliseconds]
            for n, x in block.positions.items():
                stores[n].append(x)
            if on_block is not None:
                on_block(block.moved(person.place))
            if progress is not None:
                progress(name, min(block.start + BLOCK, clip.num_frames), clip.num_frames)
            begun = time.perf_counter()
            for n, s, c in zip(names, dresser.sites, colliders.result(), strict=False):
                after = before = inside_shares(
                    c, clip_at_sites(s, block.positions[n]), clip, block.start
                )
                if dresser.colliders is not None:
                    before = inside_shares(c, block.raw[n], clip, block.start)
                inside[n].append((before, after))
            measuring += 1e3 * (time.perf_counter() - begun)
    warm = float(np.median(times[1:])) / BLOCK if len(times) > 1 else None
    stages.append(Stage(name, times[0] if times else 0.0, warm))
    return _Cloth(
        positions={n: s.array() for n, s in stores.items()},
        inside={
            n: (np.concatenate([x for x, _ in found]), np.concatenate([x for _, x in found]))
            for n, found in inside.items()
            if found
        },
        milliseconds=measuring,
    )


@prepared_on_processor
def _with_contacts(dresser: Dresser, inference: Inference) -> Dresser:
    """A dresser of guided cloth that keeps it off a character's own surface.

    The simulation met the skinned body alone.
    """
    outfit = dresser.outfit
    layers = prepare_layers(outfit, inference)
    return dataclasses.replace(dresser, colliders=make_colliders(outfit), layers=layers)


def _colliders(dresser: Dresser, person: _Person) -> tuple[BodyCollider, ...]:
    """Colliders by which penetration is measured, with their programs compiled."""
    if person.character is not None:
        return ()
    with on_processor():
        colliders = dresser.colliders
        if colliders is None:
            colliders = make_colliders(dresser.outfit)
    for w, c in zip(dresser.worn, colliders, strict=True):
        inside_shares(c, np.asarray(w.rest)[None], person.clip)
    return tuple(colliders)


def _measured(
    cloth: _Cloth, dresser: Dresser, person: _Person, colliders: tuple[BodyCollider, ...]
) -> _Cloth:
    """Simulated cloth with its shares inside the body; a character is measured differently."""
    begun = time.perf_counter()
    inside = {}
    for w, s, c in zip(dresser.worn, dresser.sites, colliders, strict=False):
        shares: list[np.ndarray] = []
        start = 0
        for x in in_chunks(cloth.positions[w.name]):
            shares.append(inside_shares(c, clip_at_sites(s, x), person.clip, start))
            start += len(x)
        inside[w.name] = (np.concatenate(shares),) * 2
    elapsed = 1e3 * (time.perf_counter() - begun)
    return dataclasses.replace(cloth, inside=inside, milliseconds=elapsed)


def _assemble_clip(
    dresser: Dresser,
    person: _Person,
    cloth: _Cloth,
    method: Method,
    include_body: bool,
    notes: tuple[str, ...],
    stages: list[Stage],
) -> DressedClip:
    """Assembles the result, at the person's place."""
    character, clip, rollout = person.character, person.clip, cloth.rollout
    worst = {}
    begun = time.perf_counter()
    positions = {n: moved_frames(x, person.place) for n, x in cloth.positions.items()}
    if rollout is not None:
        rollout = dataclasses.replace(rollout, positions=tuple(positions.values()))
    if character is not None:
        raw, worn = dress_character(character, dresser, clip, cloth.positions)
        inside_raw, inside = (
            {n: character_penetration(character, x) for n, x in part.items()}
            for part in (raw, worn)
        )
        positions = {n: moved_frames(x, person.place) for n, x in worn.items()}
    else:
        inside_raw, inside = (
            {n: float(shares[k].mean()) for n, shares in cloth.inside.items()} for k in (0, 1)
        )
        for n, (_, shares) in cloth.inside.items():
            worst[n] = (int(shares.argmax()), float(shares.max()))
    meshes = animated_meshes(
        person.body, clip.motion, person.shape, dresser.garments, positions, include_body
    )
    if include_body:
        meshes = (meshes[0].moved(person.place), *meshes[1:])
    if character is not None and include_body:
        moving = character.mesh.positions[: clip.num_frames]
        meshes = (dataclasses.replace(character.mesh, positions=moving), *meshes[1:])
    elapsed = 1e3 * (time.perf_counter() - begun)
    stages.append(Stage("body", cloth.milliseconds + elapsed))
    fault = sudden_turns(person.body, clip.motion)
    bound = {w.name: w.binding if isinstance(w, BoundGarment) else None for w in dresser.worn}
    return DressedClip(
        meshes=meshes,
        fps=clip.motion.fps,
        stages=tuple(stages),
        hit_rate={n: None if b is None else float(b.hit_rate) for n, b in bound.items()},
        fallbacks={n: None if b is None else int(b.fallbacks) for n, b in bound.items()},
        inside_raw=inside_raw,
        inside=inside,
        method=method,
        notes=(
            *(() if fault is None else (fault,)),
            *(() if character is None else character.notes),
            *_far_note(person.place),
            *_slide_note(cloth.rollout),
            *notes,
        ),
        worst=worst,
        rollout=rollout,
        effects=cloth.effects,
    )


def _far_note(place: Float[np.ndarray, "3"]) -> tuple[str, ...]:
    """A note if single precision is coarse where the person stands."""
    farthest = float(np.abs(place).max())
    apart = float(np.spacing(np.float32(farthest)))
    if apart <= _COARSE:
        return ()
    return (
        f"the person starts {farthest / 1e3:.0f} km from the origin, where single precision has"
        f" steps of {1e3 * apart:.0f} mm; move the motion nearer",
    )


def _slide_note(rollout: Rollout | None) -> tuple[str, ...]:
    """A warning if a garment slid off in a simulation."""
    off = np.zeros(0) if rollout is None else rollout.status & int(Status.OFF)
    if rollout is None or not off.any():
        return ()
    far, first = rollout.diagnostics["slipped"].max(), int(np.argmax(off > 0))
    return (
        f"a garment comes off: from frame {first} on its waist, upper border or neckline slides up"
        f" to {100 * far:.0f} cm along the body; {Status.OFF.advice}",
    )
