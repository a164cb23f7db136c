"""A body of the user's own, animated elsewhere, in clothes."""

import dataclasses
import pathlib
from collections.abc import Callable

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float
from scipy.spatial import KDTree

from ..body import Body, clothed_vertices, load_body, register_body
from ..errors import MeshError
from ..garment import Garment
from ..io import AnimatedMesh, read_character, smooth_normals
from ..motion import Motion, body_animation, follow_surface

# Skin whose leftover movement a garment vertex takes over: so many vertices, over so far [m].
_SKIN, _WIDTH = 24, 0.03
# Cloth deeper than this under the nearest skin is beneath another limb [m].
_DEEPEST = 0.06
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
    progress: Callable[[str, int, int], None] | None = None,
) -> Character:
    """A person of one's own from a file, to be handed to `dress`.

    Args:
        path: Animated glTF (skin or morph targets), USD, PC2 or MDD with its OBJ, or npz,
            see `read_character`.
        fps: Frames a second.
        source_fps: True rate of a file that doesn't say it.
        mesh: Name of the body's mesh in the file.
        frames: Keep only this many frames.
        progress: Called with a stage, steps done and steps in all.

    Returns:
        The person, with the body that follows it.

    Raises:
        PhysXNetError: What can't be read, or no person whom the body fits.
    """
    person, bind, notes = read_character(
        path, fps=fps, source_fps=source_fps, mesh=mesh, frames=frames
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
    motion = follow_surface(body, surface, found.sure & clothed, fps, name=mesh.name)
    skinned = np.asarray(body_animation(body, motion))
    leftover = np.where((found.sure & clothed)[None, :, None], surface - skinned, 0.0)
    notes = (
        f"the body lies {1e3 * float(found.distance[clothed & found.sure].mean()):.0f} mm from"
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
        float(found.distance[clothed & found.sure].mean()),
        float(1.0 - found.sure[clothed].mean()),
        notes,
    )


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
