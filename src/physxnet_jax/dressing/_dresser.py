"""Clothes as a layer: one pure function from joint rotations to clothed vertices."""

import dataclasses
import functools
import pathlib
from typing import Literal

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from ..body import NUM_BODY_VERTICES, Body, load_body
from ..garment import Garment
from ..geometry import each_frame, vertex_normals
from ..io import DEFAULT, load_predictor
from ..models import (
    Predictor,
    Stream,
    Wearable,
    at_precision,
    dress_frames,
    start_stream,
    stream_frame,
)
from ..motion import poses_before
from ..typing import pytree
from ._dress import as_on, bound_wearable, fit_surface
from ._layers import Layer, keep_apart, keep_layers_apart, make_layers
from ._meshes import Wear, worn_garments
from ._push_out import SkinPatch, make_patch, push_out, tuck_in

Precision = Literal["float32", "bfloat16"]


@pytree
@dataclasses.dataclass(frozen=True)
class Dresser:
    """A person's clothes, ready to be worn in any pose.

    Attributes:
        body: The body.
        rest: Its vertices at rest [m].
        predictor: The network, batch norm folded.
        wearables: What is worn.
        patches: The skin that each garment is pushed out of.
        layers: Which garments are kept over or beneath which, innermost first.
        garments: The same at rest on the body's default shape, and what carries them.
        push_out: Whether vertices inside the body are moved out of it.
        notes: What the reader should know about the garments' files; no part of the
            pytree, so gone from what a transformed function returns.
    """

    body: Body
    rest: Float[Array, "all 3"]
    predictor: Predictor
    wearables: tuple[Wearable, ...]
    patches: tuple[SkinPatch, ...]
    layers: tuple[Layer, ...]
    garments: tuple[Garment, ...]
    push_out: bool = dataclasses.field(metadata={"static": True})
    notes: tuple[str, ...] = dataclasses.field(default=(), metadata={"told": True})

    @property
    def faces(self) -> tuple[Int[Array, "faces 3"], ...]:
        """Triangles of each garment, shape [faces, 3]."""
        return tuple(g.mesh.faces for g in self.garments)


@pytree
@dataclasses.dataclass(frozen=True)
class Clothed:
    """Clothes in a pose, or in each of several frames.

    Attributes:
        vertices: Vertices of each garment by name [m], shape
            ``[*frames, vertices, 3]``.
        ok: Whether all of them are finite: a joint that isn't spoils the frames whose
            window holds it, and no other.
    """

    vertices: dict[str, Float[Array, "*frames vertices 3"]]
    ok: Bool[Array, "*frames"]

    def __getitem__(self, name: str) -> Float[Array, "*frames vertices 3"]:
        """Vertices of a garment [m]."""
        return self.vertices[name]


def _clothed(vertices: dict[str, Array]) -> Clothed:
    finite = [jnp.all(jnp.isfinite(x), axis=(-2, -1)) for x in vertices.values()]
    return Clothed(vertices, functools.reduce(jnp.logical_and, finite))


def _check_pose(body: Body, rotations: Array, root: Array, axes: tuple[str, ...]) -> None:
    """Shapes alone: fine under `jax.jit`."""
    many = rotations.shape[: len(axes)]
    wanted = (*many, len(body.parents), 4), (*many, 3)
    got = rotations.shape, root.shape
    if got != wanted or rotations.ndim != len(axes) + 2:
        names = ", ".join((*axes, "joints", "4"))
        raise ValueError(
            f"rotations [{names}] have the shape {got[0]} and root {got[1]}; the body has"
            f" {len(body.parents)} joints, so {wanted[0]} and {wanted[1]} are expected. Retarget a"
            " motion of another skeleton (load_motion), or add the axis of frames."
        )


def make_dresser(
    wear: Wear = ("top", "bottom"),
    *,
    weights: str | pathlib.Path | Predictor = DEFAULT,
    body: Body | None = None,
    shape: Float[Array, " shapes"] | None = None,
    push_out: bool = True,
    precision: Precision = "float32",
) -> Dresser:
    """Loads weights and binds garments, once for all poses.

    Args:
        wear: Garments, garment files or template names. Tops go over dresses, dresses over
            trousers; of two of one kind the first is beneath.
        weights: Name or folder of network weights, or a predictor.
        body: The body; the built-in one by default.
        shape: Shape parameters; the default shape if omitted.
        push_out: Push vertices that end inside the body onto it, and garments off those
            beneath them.
        precision: Of the network's arithmetic; all else stays float32.

    Returns:
        What `clothe` and `clothe_frame` take: a pytree.

    Raises:
        PhysXNetError: Anything that can't be read or bound; the text says why.
    """
    body = load_body() if body is None else body
    rest = body.rest_vertices(body.default_shape() if shape is None else shape)
    garments, notes = worn_garments(wear, body)
    garments = [as_on(body, g) for g in garments]
    predictor = weights if isinstance(weights, Predictor) else load_predictor(weights)
    predictor = at_precision(fit_surface(predictor, body, rest), precision)
    wearables = tuple(bound_wearable(predictor, body, rest, g) for g in garments)
    patches = tuck_in(
        [make_patch(body, rest, w, g.mesh) for w, g in zip(wearables, garments, strict=True)],
        wearables,
    )
    layers = make_layers(body, rest, wearables, garments)
    return Dresser(
        body, rest, predictor, wearables, patches, layers, tuple(garments), push_out, notes
    )


def with_shape(dresser: Dresser, shape: Float[Array, " shapes"]) -> Dresser:
    """The same clothes on a body of another shape; pure, for `jax.vmap` and `jax.grad` by it.

    Garments follow the shape as `Garment.rest_vertices` carries them. A garment alone is what
    `make_dresser` gives for the shape; of several, how much room is left between them is
    that of the shape before.

    Args:
        dresser: From `make_dresser`.
        shape: Shape parameters, see `Body.shape`.

    Returns:
        The dresser for that shape.

    Raises:
        ValueError: Another number of parameters; a dress by a network of the paper's
            family, whose offsets begin on a body with joined legs: make a dresser for the
            shape instead.

    Example:
        >>> person = make_dresser(["bottom"])
        >>> tall = with_shape(person, person.body.shape(height_up=0.5))
        >>> bool(tall.wearables[0].rest[:, 1].max() > person.wearables[0].rest[:, 1].max())
        True
    """
    body, predictor = dresser.body, dresser.predictor
    skirts = any(w.template == "dress" for w in dresser.wearables)
    if skirts and predictor.config.family == "paper":
        raise ValueError("dresses of the paper's family: use make_dresser(..., shape=shape).")
    rest = body.rest_vertices(shape)
    surface = dataclasses.replace(predictor.surface, rest=predictor.atlas.to_body @ rest)
    worn = [g.rest_vertices(rest) for g in dresser.garments]
    wearables = tuple(
        dataclasses.replace(
            w, rest=x, anchor=w.binding.to_body @ rest, springs=w.springs.at_rest(x)
        )
        for w, x in zip(dresser.wearables, worn, strict=True)
    )
    mesh = body.mesh(rest[:NUM_BODY_VERTICES])
    normals = vertex_normals(mesh.vertices, mesh.faces)
    patches = tuple(
        dataclasses.replace(p, rest=rest[p.used], normals=normals[p.used]) for p in dresser.patches
    )
    return dataclasses.replace(
        dresser,
        rest=rest,
        predictor=dataclasses.replace(predictor, surface=surface),
        wearables=wearables,
        patches=patches,
    )


def clothe(
    dresser: Dresser,
    rotations: Float[Array, "frames joints 4"],
    root: Float[Array, "frames 3"],
    fps: float,
) -> Clothed:
    """Clothes in successive frames; pure, for `jax.jit`, `jax.vmap` and `jax.grad`.

    Before the first frame the person is taken to have moved as the clip begins, see
    `poses_before`.

    Args:
        dresser: From `make_dresser`.
        rotations: Joint rotations relative to their parents, unit quaternions wxyz, as in
            `Motion`.
        root: Position of the root joint [m].
        fps: Frames a second; static under `jax.jit`.

    Returns:
        Vertices of each garment, and which frames are usable.

    Raises:
        ValueError: A clip of no frames, or of another skeleton than the body's.

    Example:
        >>> from physxnet_jax.motion import load_motion
        >>> motion = load_motion("walk", fps=30)
        >>> cloth = jax.jit(clothe, static_argnames="fps")(
        ...     make_dresser(["bottom"]), motion.rotations[:2], motion.root[:2], fps=30.0
        ... )
        >>> cloth["bottom"].shape
        (2, 2726, 3)
    """
    _check_pose(dresser.body, rotations, root, ("frames",))
    if rotations.shape[0] == 0:
        raise ValueError("a clip of no frames; clothe takes one or more.")
    lead = dresser.predictor.config.inputs.window - 1
    before = poses_before(rotations, root, lead)
    joints = (jnp.concatenate(pair) for pair in zip(before, (rotations, root), strict=True))
    led = jax.vmap(lambda q, p: dresser.body.transforms(dresser.rest, q, p))(*joints)
    raw = dress_frames(dresser.predictor, dresser.wearables, *led, fps)
    world, shift = (x[lead:] for x in led)
    if dresser.push_out:
        raw = keep_layers_apart(
            dresser.layers,
            [
                each_frame(functools.partial(push_out, patch), x, world, shift)
                for x, patch in zip(raw, dresser.patches, strict=True)
            ],
        )
    return _clothed({w.name: x for w, x in zip(dresser.wearables, raw, strict=True)})


def start_clothing(
    dresser: Dresser,
    rotations: Float[Array, "joints 4"] | Float[Array, "frames joints 4"],
    root: Float[Array, "3"] | Float[Array, "frames 3"],
) -> Stream:
    """The state from which `clothe_frame` goes on.

    Args:
        dresser: From `make_dresser`.
        rotations: Joint rotations of the first frame, of a person who stood still until
            now; or of the first frames, where they are known, of which two are enough:
            the person then moved as they begin, as in `clothe`.
        root: Position of the root joint [m], likewise.

    Returns:
        The stream before the first frame.

    Raises:
        ValueError: Of another skeleton than the body's, or no pose.
    """
    if rotations.ndim == 2:
        rotations, root = rotations[None], root[None]
    _check_pose(dresser.body, rotations, root, ("frames",))
    if not rotations.shape[0]:
        raise ValueError("no pose: give the first one, or the first two.")
    before = poses_before(rotations, root, dresser.predictor.config.inputs.window - 1)
    world, shift = jax.vmap(lambda q, p: dresser.body.transforms(dresser.rest, q, p))(*before)
    return start_stream(dresser.predictor, world, shift)


def clothe_frame(
    dresser: Dresser,
    stream: Stream,
    rotations: Float[Array, "joints 4"],
    root: Float[Array, "3"],
    fps: float,
) -> tuple[Stream, Clothed]:
    """The next frame's clothes, for live use; the same as `clothe` of the whole clip.

    Under `jax.jit` make ``fps`` static and donate ``stream``.

    Args:
        dresser: From `make_dresser`.
        stream: From `start_clothing` or the frame before.
        rotations: Joint rotations of this frame.
        root: Position of the root joint [m].
        fps: Frames a second.

    Returns:
        The stream for the next frame, and this frame's clothes.

    Raises:
        ValueError: Of another skeleton than the body's.
    """
    _check_pose(dresser.body, rotations, root, ())
    world, shift = dresser.body.transforms(dresser.rest, rotations, root)
    stream, raw = stream_frame(dresser.predictor, dresser.wearables, stream, world, shift, fps)
    worn = list(raw)
    if dresser.push_out:
        worn = [push_out(p, x, world, shift) for x, p in zip(raw, dresser.patches, strict=True)]
        for layer in dresser.layers:
            worn[layer.moved] = keep_apart(layer, worn[layer.still], worn[layer.moved])
    return stream, _clothed({w.name: x for w, x in zip(dresser.wearables, worn, strict=True)})
