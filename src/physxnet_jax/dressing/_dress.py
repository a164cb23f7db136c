"""From motion and garments to dressed, animated meshes."""

import dataclasses
import pathlib
from collections.abc import Callable
from typing import Literal

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from .._environment import free_programs
from ..body import Body, load_body
from ..errors import PhysXNetError
from ..garment import Garment
from ..geometry import Smoothing, make_springs
from ..io import DEFAULT, AnimatedMesh, load_predictor
from ..models import Predictor, Wearable, fold_batch_norm, make_surface, make_wearable
from ..motion import Motion, before_transforms, clip_transforms, sudden_turns
from ..simulation import ACCURACY
from ..uv import Binding, Transference, bind
from ._blocks import inside_shares, lead_frames, lift_clip, predict_clip, simulate_clip
from ._character import (
    Character,
    clear_of_character,
    follow_leftover,
    inside_character,
    on_character,
)
from ._layers import make_layers
from ._meshes import Wear, animated_meshes, worn_garments
from ._push_out import make_patch, tuck_in
from ._stages import Stage, Watch
from ._wanted_clip import cut_clip, wanted_clip

Method = Literal["network", "lbs", "simulate"]
METHODS: tuple[Method, ...] = ("network", "lbs", "simulate")


@dataclasses.dataclass(frozen=True)
class DressedClip:
    """A dressed person in motion.

    Attributes:
        meshes: The body (unless left out) and the garments in the order worn.
        fps: Frames a second.
        stages: Where the time went.
        hit_rate: For each garment, share of vertices whose ray met the body; None
            where no ray is cast (lbs, simulate).
        fallbacks: For each garment, vertices bound by the closest point; likewise.
        inside_raw: For each garment, share of vertices below the skin near them, as
            computed. Another limb's skin isn't looked at.
        inside: The same in the result, after the push-out; for a `Character` against the
            person's own surface, from which cloth is then moved.
        method: How the cloth was made.
        notes: What the reader should know about it.
        worst: For each garment by name the frame in which most of it is inside the body,
            and how much; empty on a person of one's own.
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

    @property
    def garments(self) -> tuple[AnimatedMesh, ...]:
        """The garments alone."""
        return tuple(m for m in self.meshes if m.name != "body")

    @property
    def num_frames(self) -> int:
        """Number of frames."""
        return len(self.meshes[0].positions)


def dress(
    motion: Motion | Character | str | pathlib.Path,
    wear: Wear = ("top", "bottom"),
    *,
    method: Method = "network",
    accuracy: str = "standard",
    fps: float | int = 30.0,
    start: float = 0.0,
    frames: int | None = None,
    weights: str | pathlib.Path | Predictor = DEFAULT,
    body: Body | None = None,
    shape: Float[Array, " shapes"] | None = None,
    include_body: bool = True,
    push_out: bool = True,
    progress: Callable[[str, int, int], None] | None = None,
) -> DressedClip:
    """Dresses a moving person.

    Args:
        motion: A motion, a motion file, the name of a built-in clip, or a person of one's
            own (`load_character`), who brings body, shape and frame rate along.
        wear: Garments, garment files or template names. Tops go over dresses, dresses over
            trousers; of two of one kind the first is beneath.
        method: ``network`` (packaged weights), ``lbs`` (skinning alone, the baseline)
            or ``simulate`` (the cloth simulator, the network's teacher).
        accuracy: Of ``simulate``: ``draft``, ``standard`` or ``fine``.
        fps: Frames a second of the result.
        start: Where in the motion to begin [s].
        frames: Keep only this many frames.
        weights: Name or folder of network weights, or a predictor.
        body: The body; the built-in one by default.
        shape: Shape parameters; the default shape if omitted.
        include_body: Put the body's mesh into the result.
        push_out: Push vertices that end inside the body onto it, and garments off those
            beneath them (network and lbs; on a character's skin simulated cloth, too).
        progress: Called with a stage, frames done and frames in all.

    Returns:
        Animated meshes with the time of every stage.

    Raises:
        PhysXNetError: Anything that can't be read, bound or worn; the text says why.

    Example:
        >>> clip = dress("walk", ["bottom"], method="lbs", frames=2)
        >>> [m.name for m in clip.meshes]
        ['body', 'bottom']
    """
    if method not in METHODS:
        raise PhysXNetError(f"No method '{method}'; there are {', '.join(METHODS)}.")
    if accuracy not in ACCURACY:
        raise PhysXNetError(f"No accuracy '{accuracy}'; there are {', '.join(ACCURACY)}.")
    person = motion if isinstance(motion, Character) else None
    if person is not None:
        if body is not None or shape is not None:
            raise PhysXNetError("A character has a body of its own: leave out body and shape.")
        if start:
            raise PhysXNetError("A character begins where its file does: leave out start.")
        motion, body, fps = person.motion, person.body, person.fps
    # Who dresses a folder of garments compiles for each of them.
    free_programs()
    stages: list[Stage] = []
    watch = Watch(stages)
    body = load_body() if body is None else body
    rest = body.rest_vertices(body.default_shape() if shape is None else shape)
    with watch("motion"):
        assert not isinstance(motion, Character)
        whole = wanted_clip(motion, fps=fps, body=body, shape=shape)
        clip, past = cut_clip(whole, start, frames)
        fault = sudden_turns(body, clip)
        world, shift = clip_transforms(body, rest, clip)
    with watch("garments"):
        # A character's clothes are modelled on the body as it is, and carried over.
        on = body if person is None else load_body()
        garments, notes = worn_garments(wear, on)
        if person is not None:
            garments = [on_character(g, person) for g in garments]
        else:
            garments = [as_on(body, g) for g in garments]
    hits: dict[str, float | None] = {g.name: None for g in garments}
    fallbacks: dict[str, int | None] = {g.name: None for g in garments}
    predictor = None
    if method == "network":
        with watch("weights"):
            known = weights if isinstance(weights, Predictor) else load_predictor(weights)
            predictor = fold_batch_norm(known)
            predictor = fit_surface(predictor, body, rest)
        with watch("binding"):
            wearables = [bound_wearable(predictor, body, rest, g) for g in garments]
        for w in wearables:
            hits[w.name] = float(w.binding.hit_rate)
            fallbacks[w.name] = int(w.binding.fallbacks)
    else:
        wearables = [unbound_wearable(body, rest, g) for g in garments]
    patches = tuck_in(
        [make_patch(body, rest, w, g.mesh) for w, g in zip(wearables, garments, strict=True)],
        wearables,
    )
    layers = make_layers(body, rest, wearables, garments)
    if method == "simulate":
        positions = simulate_clip(garments, clip, body, shape, accuracy, stages, progress)
        inside_raw = None
    else:
        before = before_transforms(body, rest, clip, lead_frames(predictor), past)
        positions, inside_raw = predict_clip(
            predictor,
            wearables,
            patches,
            layers,
            world,
            shift,
            before,
            clip.fps,
            push_out,
            stages,
            progress,
        )
    each = {
        w.name: inside_shares(p, positions[w.name], world, shift)
        for w, p in zip(wearables, patches, strict=True)
    }
    inside = {name: float(shares.mean()) for name, shares in each.items()}
    worst = {name: (int(x.argmax()), float(x.max())) for name, x in each.items()}
    with watch("body"):
        if person is not None:
            positions = {g.name: follow_leftover(g, person, positions[g.name]) for g in garments}
            # Both against the skin that is seen.
            inside_raw = {g.name: inside_character(person, positions[g.name]) for g in garments}
            if push_out:
                positions = {
                    w.name: clear_of_character(p, w, person, positions[w.name], world, shift)
                    for w, p in zip(wearables, patches, strict=True)
                }
                # What was moved off the person's skin may have moved through what is over it.
                positions = lift_clip(layers, wearables, positions)
            inside = {g.name: inside_character(person, positions[g.name]) for g in garments}
            worst = {}
        meshes = animated_meshes(body, clip, shape, garments, positions, include_body)
        if person is not None and include_body:
            whole = dataclasses.replace(
                person.mesh, positions=person.mesh.positions[: clip.num_frames]
            )
            meshes = (whole, *meshes[1:])
    return DressedClip(
        meshes,
        clip.fps,
        tuple(stages),
        hits,
        fallbacks,
        inside if inside_raw is None else inside_raw,
        inside,
        method,
        (
            *(() if fault is None else (fault,)),
            *(() if person is None else person.notes),
            *notes,
        ),
        worst,
    )


def fit_surface(predictor: Predictor, body: Body, rest: Float[Array, "all 3"]) -> Predictor:
    """The predictor with its texels on a body of a shape.

    Args:
        predictor: Of any shape.
        body: The body.
        rest: `Body.rest_vertices` of the shape [m].
    """
    surface = make_surface(predictor.atlas, body, rest, predictor.surface.valid)
    return dataclasses.replace(predictor, surface=surface)


def as_on(body: Body, garment: Garment) -> Garment:
    """A garment with its mesh where it lies on this body at rest.

    Templates come on the built-in one, whatever body they are carried by.
    """
    if body is load_body():
        return garment
    vertices = garment.rest_vertices(body.rest_vertices(body.default_shape()))
    return dataclasses.replace(garment, mesh=garment.mesh.replace(vertices=vertices))


def bound_wearable(
    predictor: Predictor, body: Body, rest: Float[Array, "all 3"], garment: Garment
) -> Wearable:
    """A garment bound to a predictor's atlas, on a body shape.

    Raises:
        PhysXNetError: The predictor has no decoder for the garment's template.
    """
    if garment.template not in predictor.config.templates:
        raise PhysXNetError(
            f"{garment.name}: the weights have no decoder for '{garment.template}', only"
            f" {', '.join(predictor.config.templates)}. Use other weights or --method lbs."
        )
    # Bound on the default shape, where garments are modelled; carried to others.
    base = body.rest_vertices(body.default_shape())
    tied = bind(predictor.atlas, body, base, garment, predictor.surface.valid[garment.template])
    return make_wearable(body, rest, garment, tied)


def unbound_wearable(body: Body, rest: Float[Array, "all 3"], garment: Garment) -> Wearable:
    """A garment for skinning alone, tied to no atlas."""
    n = garment.num_vertices
    rows = Transference(jnp.zeros((n, 3), jnp.int32), jnp.zeros((n, 3)), jnp.zeros((n,), bool))
    count = jnp.zeros((), jnp.int32)
    texel = jnp.zeros((n, 4), jnp.int32)
    none = Binding(rows, texel, jnp.zeros((n, 4)), jnp.ones(()), count, count)
    worn = garment.rest_vertices(rest)
    return Wearable(
        worn,
        garment.skin,
        none,
        worn,
        garment.skin,
        Smoothing(()),
        make_springs(np.asarray(worn), np.asarray(garment.mesh.faces)),
        garment.template,
        garment.name,
    )
