"""A body of the user's own, animated elsewhere, in clothes."""

import dataclasses
import pathlib
from collections.abc import Callable, Mapping

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int
from scipy.spatial import KDTree

from ..body import Body, clothed_vertices, load_body, register_body
from ..errors import MeshError
from ..garment import Garment
from ..geometry import each_frame
from ..io import AnimatedMesh, read_character, smooth_normals
from ..models import Wearable, skin_points
from ..motion import (
    BLOCK,
    Motion,
    body_animation,
    follow_surface,
    load_motion,
    padded_block,
    read_joint_map,
    resample,
)
from ._push_out import SkinPatch, faces_at_rest, push_out_of

# Skin whose leftover movement a garment vertex takes over: so many vertices, over so far [m].
_SKIN, _WIDTH = 24, 0.03
# Cloth deeper than this under the nearest skin is beneath another limb [m].
_DEEPEST = 0.06
# Skin that goes this far from where the joints take it isn't that skin [m].
_STRAY = 0.15
# Corners of a mesh stand no farther out of it than this [m].
_RISE = 0.015
# Triangles that are looked through for those near cloth; how far it slides at most [m].
_LOOKED_THROUGH, _SLIDE = 40, 0.15
# Frames that are looked at for how much of a garment is inside.
_LOOKED_AT = 40


@dataclasses.dataclass(frozen=True)
class Character:
    """A person of one's own: a mesh in motion and the body that moves as it does.

    Attributes:
        mesh: The person [m], Y up.
        fps: Frames a second.
        body: The package's body in the person's proportions.
        motion: How its joints turn to follow the person.
        leftover: What skinning that body leaves between it and the person's surface [m],
            shape [frames, 13380, 3]; zero where the surfaces don't meet.
        surface: The body's vertices on the person's surface [m], shape likewise.
        rise: How far corners of a coarse mesh stand out of the surface through those
            vertices [m], shape [13380].
        apart: Mean distance between the two, where clothes hang, fitted by shape and
            pose alone [m].
        missed: Share of the vertices there that found no surface.
        notes: What was found out about the file.
    """

    mesh: AnimatedMesh
    fps: float
    body: Body
    motion: Motion
    leftover: Float[np.ndarray, "frames vertices 3"]
    surface: Float[np.ndarray, "frames vertices 3"]
    rise: Float[np.ndarray, " vertices"]
    apart: float
    missed: float
    notes: tuple[str, ...] = ()


def load_character(
    path: str | pathlib.Path,
    *,
    fps: float | int = 30.0,
    source_fps: float | int | None = None,
    mesh: str | None = None,
    frames: int | None = None,
    motion: Motion | str | pathlib.Path | None = None,
    joint_map: Mapping[str, str] | str | pathlib.Path | None = None,
    progress: Callable[[str, int, int], None] | None = None,
) -> Character:
    """A person of one's own from a file, to be handed to `dress`.

    Args:
        path: Animated glTF (skin or morph targets), USD, PC2 or MDD with its OBJ, or npz,
            see `read_character`.
        fps: Frames a second.
        source_fps: True rate of a file that doesn't say it, or says it wrongly: of
            `motion`, where that is a file.
        mesh: Name of the body's mesh in the file.
        frames: Keep only this many frames.
        motion: What moves the person's skin instead of the file's own animation: a clip,
            or what `load_motion` takes. Of a rigged glTF or VRM, whose bones are known by
            their names, by VRM or by `joint_map`.
        joint_map: Body joint to the person's joint, or a file of them (`read_joint_map`).
        progress: Called with a stage, steps done and steps in all.

    Returns:
        The person, with the body that follows it.

    Raises:
        PhysXNetError: What can't be read, or no person whom the body fits.
    """
    if isinstance(motion, str | pathlib.Path):
        motion = load_motion(motion, fps=fps, source_fps=source_fps)
    if motion is not None:
        motion = motion if motion.fps == fps else resample(motion, fps)
        motion = Motion(motion.rotations[:frames], motion.root[:frames], motion.fps, motion.name)
    if isinstance(joint_map, str | pathlib.Path):
        joint_map = read_joint_map(joint_map)
    person, bind, notes = read_character(
        path,
        fps=fps,
        source_fps=source_fps,
        mesh=mesh,
        frames=frames,
        motion=motion,
        joint_map=joint_map,
    )
    character = make_character(person, float(fps), bind=bind, progress=progress)
    return dataclasses.replace(character, notes=(*notes, *character.notes))


def make_character(
    mesh: AnimatedMesh,
    fps: float,
    *,
    bind: Float[np.ndarray, "vertices 3"] | None = None,
    progress: Callable[[str, int, int], None] | None = None,
) -> Character:
    """A person of one's own from arrays.

    The body is laid onto one pose (`register_body`): the bind pose, else frame 0, else a
    frame with the arms out. From there it goes where the mesh goes.

    Args:
        mesh: The person, closed or not, of any topology [m].
        fps: Frames a second.
        bind: A pose with limbs apart, whether or not the clip has it [m].
        progress: Called with a stage, steps done and steps in all.

    Raises:
        MeshError: No pose fits the body.
    """
    base = load_body()
    mesh = dataclasses.replace(mesh, name="body")
    found = None
    error: MeshError | None = None
    for pose in _poses(mesh.positions, bind):
        try:
            found = register_body(pose, mesh.faces, progress=progress)
            break
        except MeshError as problem:
            error = error or problem
    if found is None:
        assert error is not None
        raise error
    surface = found.carried(mesh.positions, mesh.faces)
    body = base.with_rest(jnp.asarray(found.rest))
    clothed = clothed_vertices(base)
    sure = found.sure & clothed
    for _ in range(2):
        motion = follow_surface(body, surface, sure, fps, name=mesh.name)
        leftover = surface - np.asarray(body_animation(body, motion))
        # Skin that goes elsewhere was laid onto another limb: a thigh onto a hand beside it.
        stray = sure & (np.linalg.norm(leftover, axis=2).max(axis=0) > _STRAY)
        if not stray.any():
            break
        sure = sure & ~stray
    leftover = np.where(sure[None, :, None], leftover, 0.0)
    notes = (
        f"the body lies {1e3 * float(found.distance[sure].mean()):.0f} mm from"
        f" yours by shape and pose; the rest, and {_mm(leftover[:, clothed])} that skinning"
        " leaves, is carried over",
    )
    return Character(
        mesh,
        fps,
        body,
        motion,
        leftover.astype(np.float32),
        surface,
        _corners(body, mesh.positions, surface),
        float(found.distance[sure].mean()),
        float(1.0 - sure[clothed].mean()),
        notes,
    )


def _corners(
    body: Body,
    positions: Float[np.ndarray, "frames points 3"],
    surface: Float[np.ndarray, "frames vertices 3"],
) -> Float[np.ndarray, " vertices"]:
    """How far a person's own vertices stand above the surface through the body's [m]."""
    frames = np.linspace(0, len(positions) - 1, _LOOKED_AT // 4).astype(int)
    normals = smooth_normals(surface[frames], np.asarray(body.rest_mesh().faces))
    out = np.zeros(surface.shape[1], np.float32)
    for k, f in enumerate(frames):
        distance, near = map(np.asarray, KDTree(surface[f]).query(positions[f]))
        height = np.einsum("vc,vc->v", positions[f] - surface[f, near], normals[k, near])
        np.maximum.at(out, near, np.where(distance < 2 * _RISE, height, 0.0).clip(0.0, _RISE))
    return out


def _mm(gap: np.ndarray) -> str:
    return f"{1e3 * float(np.linalg.norm(gap, axis=2).mean()):.0f} mm"


def _poses(positions: np.ndarray, bind: np.ndarray | None) -> list[np.ndarray]:
    """Poses in which limbs may be apart, the likeliest first."""
    first = [positions[0]] if bind is None else [bind, positions[0]]
    breadth = np.ptp(positions[:, :, 0], axis=1) * np.ptp(positions[:, :, 2], axis=1)
    widest = int(np.argmax(breadth))
    return first + ([positions[widest]] if widest else [])


def on_character(garment: Garment, character: Character) -> Garment:
    """A garment modelled on the package's body, carried onto the person's proportions."""
    rest = character.body.rest_vertices(character.body.default_shape())
    mesh = dataclasses.replace(garment.mesh, vertices=garment.rest_vertices(rest))
    return dataclasses.replace(garment, mesh=mesh)


def follow_leftover(
    garment: Garment,
    character: Character,
    positions: Float[np.ndarray, "frames vertices 3"],
) -> Float[np.ndarray, "frames vertices 3"]:
    """A garment on the person's own surface instead of on the skinned body.

    Args:
        garment: The garment, from `on_character`.
        character: The person.
        positions: Of the garment on the skinned body [m].

    Returns:
        Positions [m]: each vertex moved as the skin near it is.
    """
    rest = np.asarray(character.body.rest_vertices(character.body.default_shape()))
    rows = np.flatnonzero(clothed_vertices(character.body))
    points = np.asarray(garment.mesh.vertices)
    distance, near = map(np.asarray, KDTree(rest[rows]).query(points, k=_SKIN))
    weight = np.exp(-0.5 * ((distance - distance[:, :1]) / _WIDTH) ** 2)
    weight = (weight / weight.sum(axis=1, keepdims=True)).astype(np.float32)
    out = np.array(positions, np.float32)
    for k in range(_SKIN):
        out += weight[:, k, None] * character.leftover[: len(out), rows[near[:, k]]]
    return out


def clear_of_character(
    patch: SkinPatch,
    wearable: Wearable,
    character: Character,
    positions: Float[np.ndarray, "frames vertices 3"],
    world: Float[np.ndarray, "frames joints 3 3"],
    shift: Float[np.ndarray, "frames joints 3"],
) -> Float[np.ndarray, "frames vertices 3"]:
    """A garment moved out of the person's own surface, see `push_out`.

    The surface is looked for where the garment is, not where it lay at rest: on knees and
    elbows that another rig bends, cloth slides.

    Args:
        patch: The skin near each of its vertices.
        wearable: The garment at rest.
        character: The person.
        positions: Of the garment [m].
        world: World rotations of the joints.
        shift: World translations of the joints [m].
    """
    frames = len(positions)
    leftover = character.leftover[:frames, np.asarray(patch.used)]
    lying = np.arange(positions.shape[1])
    lying = lying if patch.skirt is None else np.asarray(patch.skirt.lying)
    still = np.asarray(wearable.rest)[lying]
    rise = character.rise[np.asarray(patch.used)][np.asarray(patch.faces)].max(axis=1)
    least = np.array(patch.least)
    least += np.quantile(rise, 0.95).astype(least.dtype)
    least[lying] = np.asarray(patch.least)[lying] + rise[np.asarray(faces_at_rest(patch))].max(
        axis=1
    )
    most = np.maximum(np.asarray(patch.most), least)
    patch = dataclasses.replace(patch, least=jnp.asarray(least), most=jnp.asarray(most))
    blocks = []
    for at in range(0, frames, BLOCK):
        x, r, t, left = (padded_block(v, at, 0) for v in (positions, world, shift, leftover))
        skin = np.asarray(_skin_block(patch, jnp.asarray(r), jnp.asarray(t), jnp.asarray(left)))
        near = np.stack([_near(patch, still, s, p[lying]) for s, p in zip(skin, x, strict=True)])
        out = _clear_block(patch, *(jnp.asarray(v) for v in (x, r, skin, near)))
        blocks.append(np.asarray(out))
    return np.concatenate(blocks)[:frames]


def _near(
    patch: SkinPatch,
    still: Float[np.ndarray, "lying 3"],
    skin: Float[np.ndarray, "skin 3"],
    points: Float[np.ndarray, "lying 3"],
) -> Int[np.ndarray, "lying k"]:
    """The nearest triangles that aren't another limb's: those lay farther off at rest."""
    faces, usual = np.asarray(patch.faces), np.asarray(faces_at_rest(patch))
    count = min(_LOOKED_THROUGH, len(faces))
    found = np.asarray(KDTree(skin[faces].mean(axis=1)).query(points, k=count)[1])
    place = np.asarray(patch.rest)[faces].mean(axis=1)
    own = np.linalg.norm(place[found] - still[:, None], axis=2) < _SLIDE
    first = np.argsort(~own, axis=1, kind="stable")[:, : usual.shape[1]]
    found, own = (np.take_along_axis(v, first, axis=1) for v in (found, own))
    return np.where(own, found, usual).astype(np.int32)


@jax.jit
def _skin_block(patch: SkinPatch, world: Array, shift: Array, leftover: Array) -> Array:
    def one(r: Array, t: Array, left: Array) -> Array:
        return skin_points(patch.rest, patch.weights, r, t)[0] + left

    return jax.vmap(one)(world, shift, leftover)


@jax.jit
def _clear_block(
    patch: SkinPatch, positions: Array, world: Array, skin: Array, near: Array
) -> Array:
    def one(x: Array, r: Array, s: Array, k: Array) -> Array:
        return push_out_of(patch, x, r, s, k)

    return each_frame(one, positions, world, skin, near)


def inside_character(
    character: Character, positions: Float[np.ndarray, "frames vertices 3"]
) -> float:
    """Share of a garment's vertices below the person's skin near them, over the clip."""
    frames = [int(f) for f in np.linspace(0, len(positions) - 1, _LOOKED_AT)]
    rows = np.flatnonzero(clothed_vertices(character.body))
    faces = np.asarray(character.body.rest_mesh().faces)
    normals = smooth_normals(character.surface[frames], faces)[:, rows]
    share = []
    for k, f in enumerate(frames):
        skin = character.surface[f, rows]
        near = np.asarray(KDTree(skin).query(positions[f])[1])
        height = np.einsum("vc,vc->v", positions[f] - skin[near], normals[k, near])
        share.append(((height < 0) & (height > -_DEEPEST)).mean())
    return float(np.mean(share))
