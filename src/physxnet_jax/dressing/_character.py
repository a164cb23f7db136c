"""Characters: animated meshes from other software, dressed by way of a registered body."""

import dataclasses
import pathlib
from collections.abc import Callable, Mapping, Sequence

import jax
import numpy as np
from jaxtyping import Array, Float, Int
from scipy.spatial import KDTree

from ..body import Body, clothed_vertices, load_body, register_body, skin_points
from ..errors import FormatError, MeshError
from ..frames import moved_frames
from ..garment import Garment, SkinnedGarment
from ..geometry import bridge_hollows, map_frames
from ..io import AnimatedMesh, GltfFile, smooth_normals, write_dressed_rig
from ..motion import (
    BLOCK,
    Motion,
    body_animation,
    fit_motion,
    load_motion,
    padded_block,
    read_joint_map,
    read_rig,
    resample,
    slice_motion,
)
from ._blocks import PosedClip, resolve_clip_layers
from ._character_file import RigClip, read_character
from ._dresser import Dresser
from .postprocess import (
    BodyCollider,
    carry_clip,
    clip_at_sites,
    faces_at_rest,
    resolve_collisions_with_skin,
)

# Skin vertices whose residuals a garment vertex averages, and the width of their weights [m].
_NUM_NEAREST, _WEIGHT_WIDTH = 24, 0.03
# Cloth deeper than this below the nearest skin belongs to another limb [m].
_MAX_DEPTH = 0.06
# Skin vertices with a larger residual are registered to another limb [m].
_MAX_RESIDUAL = 0.15
# Limit on the height of a coarse mesh's vertices above the registered surface [m].
_MAX_RISE = 0.015
# Nearest triangles examined for each vertex; maximum distance that cloth slides [m].
_NUM_CANDIDATES, _MAX_SLIDE = 40, 0.15
# Farther than this from the origin, positions are too coarse to compute with [m].
_FAR = 50.0
# Frames sampled for the share of a garment inside the character.
_NUM_SAMPLED = 40


@dataclasses.dataclass(frozen=True)
class Character:
    """An animated mesh and a body that follows its motion.

    Attributes:
        mesh: The character's mesh [m], Y up.
        fps: Frames per second.
        body: The built-in body in the character's proportions.
        motion: The motion with which that body follows the mesh.
        residual: Offset from the skinned body to the character's surface [m], shape
            [frames, 13380, 3]; zero where the surfaces don't correspond.
        surface: The body's vertices on the character's surface [m], same shape.
        rise: Height of the vertices of a coarse mesh above the surface through those
            vertices [m], shape [13380].
        apart: Mean distance between body and surface in clothed regions, after fitting
            shape and pose alone [m].
        missed: Share of vertices in clothed regions without a counterpart on the surface.
        notes: Remarks on the file.
        rig: The rig that a motion drives; None for other persons.
        place: What was subtracted from the mesh's positions before anything was computed [m]: the
            body, its motion and the surface are relative to it. Zero near the origin.
    """

    mesh: AnimatedMesh
    fps: float
    body: Body
    motion: Motion
    residual: Float[np.ndarray, "frames vertices 3"]
    surface: Float[np.ndarray, "frames vertices 3"]
    rise: Float[np.ndarray, " vertices"]
    apart: float
    missed: float
    notes: tuple[str, ...] = ()
    rig: RigClip | None = None
    place: Float[np.ndarray, "3"] = dataclasses.field(
        default_factory=lambda: np.zeros(3, np.float32)
    )

    def after(self, start: float) -> "Character":
        """The character from a time on.

        Args:
            start: Start time [s].

        Raises:
            MotionError: It is outside the motion.
        """
        if not start:
            return self
        motion = slice_motion(self.motion, start, None)[0]
        first = self.motion.num_frames - motion.num_frames
        mesh = dataclasses.replace(self.mesh, positions=self.mesh.positions[first:])
        return dataclasses.replace(
            self,
            mesh=mesh,
            motion=motion,
            residual=self.residual[first:],
            surface=self.surface[first:],
            rig=self.rig and self.rig._replace(world=self.rig.world[first:]),
        )


def load_character(
    path: str | pathlib.Path,
    *,
    fps: float | int = 30.0,
    source_fps: float | int | None = None,
    mesh: str | None = None,
    start: float = 0.0,
    frames: int | None = None,
    motion: Motion | str | pathlib.Path | None = None,
    joint_map: Mapping[str, str] | str | pathlib.Path | None = None,
    progress: Callable[[str, int, int], None] | None = None,
) -> Character:
    """Loads a character from a file, as input of `dress`.

    Args:
        path: Animated glTF (skin or morph targets; ``file.glb#Run`` for one of several
            animations), USD, PC2 or MDD with its OBJ, or npz, see `read_character`.
        fps: Frames per second.
        source_fps: True frame rate of a file that states none or a wrong one; that of
            `motion`, if it is a file.
        mesh: Name of the body's mesh in the file.
        start: Start time in the motion [s].
        frames: Keep only this many frames.
        motion: A clip, or what `load_motion` takes, that replaces the file's animation.
            It requires a rigged glTF or VRM whose bones are identified by their names, by
            VRM or by `joint_map`.
        joint_map: Maps body joints to joints of the character, or a file that does
            (`read_joint_map`).
        progress: Called with the stage, the steps done and the total number of steps.

    Returns:
        The character, with the body that follows it.

    Raises:
        PhysXNetError: The file can't be read, or the body doesn't fit its mesh.
    """
    if isinstance(motion, str | pathlib.Path):
        motion = load_motion(motion, fps=fps, source_fps=source_fps)
    if motion is not None:
        motion = motion if motion.fps == fps else resample(motion, fps)
        motion = slice_motion(motion, start, frames)[0]
        start = 0.0
    if isinstance(joint_map, str | pathlib.Path):
        joint_map = read_joint_map(joint_map)
    read = read_character(
        path,
        fps=fps,
        source_fps=source_fps,
        mesh=mesh,
        start=start,
        frames=frames,
        motion=motion,
        joint_map=joint_map,
    )
    character = make_character(read.mesh, float(fps), bind=read.bind, progress=progress)
    return dataclasses.replace(character, notes=(*read.notes, *character.notes), rig=read.rig)


def make_character(
    mesh: AnimatedMesh,
    fps: float,
    *,
    bind: Float[np.ndarray, "vertices 3"] | None = None,
    progress: Callable[[str, int, int], None] | None = None,
) -> Character:
    """Makes a character from arrays.

    The body is registered to one pose (`register_body`): the bind pose, else frame 0, else a
    frame with the arms out. In all other frames it follows the mesh.

    Args:
        mesh: The character's mesh, closed or not, of any topology [m].
        fps: Frames per second.
        bind: A pose with limbs apart, which needn't occur in the clip [m].
        progress: Called with the stage, the steps done and the total number of steps.

    Raises:
        MeshError: The body fits none of these poses.
    """
    base = load_body()
    mesh = dataclasses.replace(mesh, name="body")
    place = _far_place(mesh.positions[0])
    positions = moved_frames(mesh.positions, -place)
    if bind is not None:
        bind = bind - _far_place(bind)
    found = None
    error: MeshError | None = None
    for pose in _poses(positions, bind):
        try:
            found = register_body(pose, mesh.faces, progress=progress)
            break
        except MeshError as problem:
            error = error or problem
    if found is None:
        assert error is not None
        raise error
    surface = found.carried(positions, mesh.faces)
    body = base.with_rest(jax.device_put(found.rest))
    clothed = clothed_vertices(base)
    sure = found.sure & clothed
    for _ in range(2):
        motion = fit_motion(body, surface, sure, fps, name=mesh.name)
        residual = surface - np.asarray(body_animation(body, motion))
        # A large residual means registration to another limb: of a thigh to a hand beside it.
        stray = sure & (np.linalg.norm(residual, axis=2).max(axis=0) > _MAX_RESIDUAL)
        if not stray.any():
            break
        sure = sure & ~stray
    residual = np.where(sure[None, :, None], residual, 0.0)
    notes = (
        f"shape and pose bring the body to {1e3 * float(found.distance[sure].mean()):.0f} mm from"
        f" the mesh; this rest and the skinning residual of {_mm(residual[:, clothed])} are"
        " added to the garments",
    )
    return Character(
        mesh,
        fps,
        body,
        motion,
        residual.astype(np.float32),
        surface,
        _corners(body, positions, surface),
        float(found.distance[sure].mean()),
        float(1.0 - sure[clothed].mean()),
        notes,
        place=place,
    )


def _far_place(positions: Float[np.ndarray, "vertices 3"]) -> Float[np.ndarray, "3"]:
    """The point on the ground below a person who stands far from the origin [m], else zero."""
    middle = positions.astype(np.float64).mean(axis=0) * [1.0, 0.0, 1.0]
    far = np.isfinite(middle).all() and np.linalg.norm(middle) > _FAR
    return np.asarray(np.round(middle) if far else np.zeros(3), np.float32)


def _corners(
    body: Body,
    positions: Float[np.ndarray, "frames points 3"],
    surface: Float[np.ndarray, "frames vertices 3"],
) -> Float[np.ndarray, " vertices"]:
    """Height of a mesh's vertices above the surface through the body's vertices [m]."""
    frames = np.linspace(0, len(positions) - 1, _NUM_SAMPLED // 4).astype(int)
    normals = smooth_normals(surface[frames], np.asarray(body.rest_mesh().faces))
    out = np.zeros(surface.shape[1], np.float32)
    for k, f in enumerate(frames):
        distance, near = map(np.asarray, KDTree(surface[f]).query(positions[f]))
        height = np.einsum("vc,vc->v", positions[f] - surface[f, near], normals[k, near])
        np.maximum.at(
            out, near, np.where(distance < 2 * _MAX_RISE, height, 0.0).clip(0.0, _MAX_RISE)
        )
    return out


def _mm(gap: np.ndarray) -> str:
    return f"{1e3 * float(np.linalg.norm(gap, axis=2).mean()):.0f} mm"


def _poses(positions: np.ndarray, bind: np.ndarray | None) -> list[np.ndarray]:
    """Poses to register the body to, those most likely to have limbs apart first."""
    first = [positions[0]] if bind is None else [bind, positions[0]]
    extent = np.ptp(positions[:, :, 0], axis=1) * np.ptp(positions[:, :, 2], axis=1)
    widest = int(np.argmax(extent))
    return first + ([positions[widest]] if widest else [])


def write_dressed_character(
    path: str | pathlib.Path,
    character: Character,
    garments: Sequence[AnimatedMesh],
) -> pathlib.Path:
    """Writes a copy of a rigged character's file with its new motion, and the garments.

    Skins, materials, images, morph targets, animations and extensions (VRM) are kept.

    Args:
        path: The ``.glb`` to write.
        character: A character from `load_character` with a `motion`.
        garments: The garments of its `DressedClip`.

    Raises:
        FormatError: The character isn't driven by a motion, the file has another extension,
            or there are too many frames for morph targets.

    ::

        person = px.load_character("hero.vrm", motion="walk", frames=60)
        clip = px.dress(person, ["shirt", "trousers"])
        px.write_dressed_character("hero_dressed.glb", person, clip.garments)
    """
    path = pathlib.Path(path)
    if character.rig is None:
        raise FormatError(
            f"{path}: only a rig that a motion drives keeps its skin; use write_clip for others."
        )
    if path.suffix.lower() != ".glb":
        raise FormatError(f"{path}: a rig is written as .glb, not {path.suffix}.")
    rig = character.rig
    frames = len(garments[0].positions) if garments else len(rig.world)
    write_dressed_rig(
        path,
        rig.path,
        rig.world[:frames],
        read_rig(GltfFile(rig.path)).nodes,
        garments,
        character.fps,
        unit=rig.unit,
        name=rig.name,
    )
    return path


def bind_to_character(garment: Garment, character: Character) -> Garment:
    """Transfers a garment from the built-in body to the character's proportions.

    Hollows of the character that the built-in body lacks are bridged.
    """
    rest = character.body.rest_vertices(character.body.default_shape())
    carried, made = garment.rest_vertices(rest), np.asarray(garment.mesh.vertices)
    faces = np.asarray(garment.mesh.faces)
    # The inner side of a thick garment faces the skin.
    outwards = smooth_normals(made[None], faces)[0] * np.asarray(garment.offset)
    free = outwards.sum(axis=1) > 0.0
    taut = jax.device_put(bridge_hollows(np.asarray(carried), made, faces, free))
    mesh = dataclasses.replace(garment.mesh, vertices=taut)
    return dataclasses.replace(garment, mesh=mesh, offset=garment.offset + (taut - carried))


def apply_residual(
    garment: Garment,
    character: Character,
    positions: Float[np.ndarray, "frames vertices 3"],
) -> Float[np.ndarray, "frames vertices 3"]:
    """Moves a garment from the skinned body onto the character's surface.

    Args:
        garment: The garment, from `bind_to_character`.
        character: The character.
        positions: Positions of the garment on the skinned body [m].

    Returns:
        Positions [m], each displaced by the residual of the nearby skin.
    """
    rest = np.asarray(character.body.rest_vertices(character.body.default_shape()))
    rows = np.flatnonzero(clothed_vertices(character.body))
    points = np.asarray(garment.mesh.vertices)
    distance, near = map(np.asarray, KDTree(rest[rows]).query(points, k=_NUM_NEAREST))
    weight = np.exp(-0.5 * ((distance - distance[:, :1]) / _WEIGHT_WIDTH) ** 2)
    weight = (weight / weight.sum(axis=1, keepdims=True)).astype(np.float32)
    out = np.array(positions, np.float32)
    for k in range(_NUM_NEAREST):
        out += weight[:, k, None] * character.residual[: len(out), rows[near[:, k]]]
    return out


def dress_character(
    character: Character,
    dresser: Dresser,
    clip: PosedClip,
    positions: dict[str, np.ndarray],
) -> tuple[dict[str, np.ndarray], dict[str, np.ndarray]]:
    """Moves garments from the skinned body onto the character's surface.

    Args:
        character: The character.
        dresser: A dresser with garments from `bind_to_character`.
        clip: The motion.
        positions: Garments by name on the skinned body [m].

    Returns:
        Garments on the surface [m], before and after resolving collisions with it.
    """
    raw = {g.name: apply_residual(g, character, positions[g.name]) for g in dresser.garments}
    if dresser.colliders is None:
        return raw, raw
    world, shift = clip.rotations, clip.translations
    sites = dict(zip(raw, dresser.sites, strict=True))
    coarse = {n: clip_at_sites(s, raw[n]) for n, s in sites.items()}
    out = {
        w.name: resolve_character_collisions(c, w, character, coarse[w.name], world, shift)
        for c, w in zip(dresser.colliders, dresser.worn, strict=True)
    }
    # Resolving collisions with the skin may move a garment through the one over it.
    out = resolve_clip_layers(dresser.layers or (), out)
    return raw, {n: carry_clip(s, raw[n], out[n]) for n, s in sites.items()}


def resolve_character_collisions(
    collider: BodyCollider,
    worn: SkinnedGarment,
    character: Character,
    positions: Float[np.ndarray, "frames vertices 3"],
    world: Float[np.ndarray, "frames joints 3 3"],
    shift: Float[np.ndarray, "frames joints 3"],
) -> Float[np.ndarray, "frames vertices 3"]:
    """Resolves collisions of a garment with the character's surface (`resolve_collisions`).

    Candidate triangles are searched near the garment in each frame, not near its rest
    position, because cloth slides over knees and elbows that another rig bends.

    Args:
        collider: The skin near each garment vertex.
        worn: The garment at rest.
        character: The character.
        positions: Positions of the garment [m].
        world: World rotations of the joints.
        shift: World translations of the joints [m].
    """
    frames = len(positions)
    residual = character.residual[:frames, np.asarray(collider.used)]
    lying = np.arange(positions.shape[1])
    lying = lying if collider.skirt is None else np.asarray(collider.skirt.lying)
    rest_points = np.asarray(worn.rest)[lying]
    rise = character.rise[np.asarray(collider.used)][np.asarray(collider.faces)].max(axis=1)
    least = np.array(collider.least)
    least += np.quantile(rise, 0.95).astype(least.dtype)
    least[lying] = np.asarray(collider.least)[lying] + rise[
        np.asarray(faces_at_rest(collider))
    ].max(axis=1)
    most = np.maximum(np.asarray(collider.most), least)
    collider = dataclasses.replace(collider, least=jax.device_put(least), most=jax.device_put(most))
    blocks = []
    for at in range(0, frames, BLOCK):
        x, r, t, offset = (padded_block(v, at, 0) for v in (positions, world, shift, residual))
        skin = np.asarray(
            _skin_block(collider, jax.device_put(r), jax.device_put(t), jax.device_put(offset))
        )
        near = np.stack(
            [_near(collider, rest_points, s, p[lying]) for s, p in zip(skin, x, strict=True)]
        )
        out = _resolve_block(collider, *(jax.device_put(v) for v in (x, r, skin, near)))
        blocks.append(np.asarray(out))
    return np.concatenate(blocks)[:frames]


def _near(
    collider: BodyCollider,
    rest_points: Float[np.ndarray, "lying 3"],
    skin: Float[np.ndarray, "skin 3"],
    points: Float[np.ndarray, "lying 3"],
) -> Int[np.ndarray, "lying k"]:
    """The nearest triangles, without those of other limbs, which are farther away at rest."""
    faces, rest_candidates = np.asarray(collider.faces), np.asarray(faces_at_rest(collider))
    count = min(_NUM_CANDIDATES, len(faces))
    found = np.asarray(KDTree(skin[faces].mean(axis=1)).query(points, k=count)[1])
    centroids = np.asarray(collider.rest)[faces].mean(axis=1)
    same_limb = np.linalg.norm(centroids[found] - rest_points[:, None], axis=2) < _MAX_SLIDE
    first = np.argsort(~same_limb, axis=1, kind="stable")[:, : rest_candidates.shape[1]]
    found, same_limb = (np.take_along_axis(v, first, axis=1) for v in (found, same_limb))
    return np.where(same_limb, found, rest_candidates).astype(np.int32)


@jax.jit
def _skin_block(collider: BodyCollider, world: Array, shift: Array, residual: Array) -> Array:
    def one(r: Array, t: Array, offset: Array) -> Array:
        return skin_points(collider.rest, collider.weights, r, t)[0] + offset

    return jax.vmap(one)(world, shift, residual)


@jax.jit
def _resolve_block(
    collider: BodyCollider, positions: Array, world: Array, skin: Array, near: Array
) -> Array:
    def one(x: Array, r: Array, s: Array, k: Array) -> Array:
        return resolve_collisions_with_skin(collider, x, r, s, k)

    return map_frames(one, positions, world, skin, near)


def character_penetration(
    character: Character, positions: Float[np.ndarray, "frames vertices 3"]
) -> float:
    """Mean share of a garment's vertices below the character's nearby skin, over the clip."""
    frames = [int(f) for f in np.linspace(0, len(positions) - 1, _NUM_SAMPLED)]
    rows = np.flatnonzero(clothed_vertices(character.body))
    faces = np.asarray(character.body.rest_mesh().faces)
    normals = smooth_normals(character.surface[frames], faces)[:, rows]
    share = []
    for k, f in enumerate(frames):
        skin = character.surface[f, rows]
        near = np.asarray(KDTree(skin).query(positions[f])[1])
        height = np.einsum("vc,vc->v", positions[f] - skin[near], normals[k, near])
        share.append(((height < 0) & (height > -_MAX_DEPTH)).mean())
    return float(np.mean(share))
