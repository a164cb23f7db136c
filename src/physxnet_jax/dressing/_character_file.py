"""Reads animated persons of other programs: point caches, USD, npz and glTF."""

import dataclasses
import functools
import math
import pathlib
from collections.abc import Callable, Mapping
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from ..body import UNITS, unit_of_person
from ..errors import FormatError
from ..files import add_inputs, is_file, read_arrays
from ..io import (
    GLTF_FORMATS,
    AnimatedMesh,
    SourceMesh,
    joined,
    named,
    nominal_rate,
    read_mdd,
    read_obj,
    read_pc2,
    read_posed_gltf,
)
from ..motion import Motion, retarget_to_rig, split_animation

CHARACTER_FORMATS = (
    *(".glb", ".gltf", ".vrm", ".usdc", ".usd", ".usda", ".usdz"),
    *(".pc2", ".mdd", ".npz", ".obj"),
)
"""Extensions that `read_character` supports."""

# Largest number of coordinates of a clip.
_MAX_COORDINATES = 3e8
_MAX_COORDINATE = 1e18
# Smallest frame rate that a file may declare: one frame per hour [1/s].
_MIN_RATE = 1 / 3600


class RigClip(NamedTuple):
    """A rig that a motion drives.

    Attributes:
        path: Its glTF or VRM file.
        world: World matrices of all nodes in the file's unit, shape [frames, nodes, 4, 4].
        name: Name of the motion.
        unit: The file's unit [m].
    """

    path: pathlib.Path
    world: Float[np.ndarray, "frames nodes 4 4"]
    name: str
    unit: float


class Read(NamedTuple):
    """A person as read from a file.

    Attributes:
        mesh: The person [m], Y up.
        bind: Bind pose of a skin [m], else None.
        notes: Notes about the detected unit and axes.
        unit: The file's unit [m].
        rig: The rig that a motion drives, else None.
    """

    mesh: AnimatedMesh
    bind: Float[np.ndarray, "vertices 3"] | None
    notes: tuple[str, ...]
    unit: float
    rig: RigClip | None = None


def read_character(
    path: str | pathlib.Path,
    *,
    fps: float | int = 30.0,
    source_fps: float | int | None = None,
    mesh: str | None = None,
    start: float = 0.0,
    frames: int | None = None,
    motion: Motion | None = None,
    joint_map: Mapping[str, str] | None = None,
) -> Read:
    """Reads a person animated in another program.

    ``.glb``, ``.gltf``: skins with their longest animation (or ``file.glb#Run``), or morph
    targets. ``.usd*``:
    points as time samples, or UsdSkel skins. ``.pc2``, ``.mdd``: caches, with the OBJ of
    their faces beside them. ``.npz``: ``positions``, ``faces`` and ``fps``; the first two may
    have a mesh's name as prefix, as `write_clip` writes, and ``bind`` may give a pose with limbs
    apart. Several meshes are joined, unless one
    is called body: then only that one is read.

    Args:
        path: The file.
        fps: Frames per second of the result.
        source_fps: True rate of the file. If omitted, the one that the file declares, else 30
            (USD: 24, its default). Ignored for glTF, which stores times.
        mesh: Name of the mesh to read.
        start: Start time in the animation [s].
        frames: Keep only this many frames.
        motion: Motion of a rigged person (glTF, VRM) in place of the file's animation; the
            result has its rate.
        joint_map: Maps body joints to the file's joints, for `motion` and unknown names.

    Returns:
        The person, the bind pose of a skin, the rig that a motion drives, and notes about
        the detected unit and axes.

    Raises:
        FormatError: The format is unknown, the file is damaged, the mesh doesn't exist, its
            height is no person's in any unit, or a rate or number of frames isn't positive.
        MotionError: A glTF is damaged.
        MissingDependencyError: The library that reads the format isn't installed.
    """
    path, animation = split_animation(path)
    suffix = path.suffix.lower()
    for name, value in (("fps", fps), ("source_fps", source_fps)):
        if value is not None and not (math.isfinite(value) and value > 0):
            raise FormatError(f"{name} is {value}, expected a positive number.")
    if frames is not None and frames < 1:
        raise FormatError(f"frames is {frames}, expected at least 1.")
    if suffix not in CHARACTER_FORMATS:
        raise FormatError(
            f"{path}: '{suffix}' isn't a format of animated persons; these are:"
            f" {', '.join(CHARACTER_FORMATS)}."
        )
    if not is_file(path):
        raise FormatError(f"{path}: no such file. Check the path.")
    add_inputs(path)
    if motion is not None and suffix not in GLTF_FORMATS:
        raise FormatError(
            f"{path}: only rigs take another motion, from {', '.join(GLTF_FORMATS[:3])};"
            f" a {suffix} file has its own."
        )
    world = None
    read: Callable[[pathlib.Path, float], tuple[list[SourceMesh], float | None, str | None]]
    if motion is not None:
        fps = motion.fps
        pose = functools.partial(retarget_to_rig, motion=motion, joint_map=joint_map)
        with np.errstate(all="ignore"):
            posed, world = read_posed_gltf(path, motion.num_frames, pose)
        read = lambda path, fps: (posed, fps, "Y")  # noqa: E731
    elif suffix in GLTF_FORMATS:
        from ..io import read_gltf_meshes

        read = functools.partial(read_gltf_meshes, animation=animation)
    elif suffix.startswith(".usd"):
        from ..io import read_usd_meshes as read
    elif suffix == ".npz":
        read = _read_npz
    elif suffix == ".obj":
        read = _read_still
    else:
        read = _read_cache
    # Damaged files may contain infinities, which are rejected below.
    with np.errstate(all="ignore"):
        parts, rate, up = read(path, fps)
    if not parts:
        raise FormatError(f"{path}: no mesh that moves. Export the person with its animation.")
    if mesh is None:
        parts = [p for p in parts if p.name.lower() == "body"] or parts
    chosen = named(path, parts, mesh, "Choose another (--body-mesh)")
    if len({len(p.positions) for p in chosen}) > 1 or not len(chosen[0].positions):
        counts = ", ".join(f"{p.name} {len(p.positions)}" for p in chosen[:6])
        raise FormatError(
            f"{path}: meshes with {counts} frames. Export them over one range, or choose one with"
            " --body-mesh."
        )
    whole = joined(chosen)
    if whole.positions.size > _MAX_COORDINATES:
        raise FormatError(f"{path}: {whole.positions.size:,} coordinates. Cut the clip.")
    # Squares of larger coordinates may overflow float32.
    binds = np.zeros(1) if whole.bind is None else whole.bind
    chart = np.zeros(1) if whole.uv is None else whole.uv
    if not all((np.abs(x) < _MAX_COORDINATE).all() for x in (whole.positions, binds, chart)):
        raise FormatError(f"{path}: positions that aren't finite. Export it again.")
    # glTF stores times and was sampled at the requested rate.
    rate = (rate if suffix in GLTF_FORMATS else source_fps or rate) or 30.0
    seconds = (len(whole.positions) - 1) / rate
    if not 0.0 <= start <= seconds + 1e-6:
        raise FormatError(f"{path}: start is {start} s, but it lasts from 0 to {seconds:.2f} s.")
    count = (seconds - start) * fps + 1
    count = count if frames is None else min(count, frames)
    if count * whole.positions[0].size > _MAX_COORDINATES:
        raise FormatError(
            f"{path}: {seconds:.0f} s at {fps:g} frames per second exceed the limit. Set its"
            " true rate (--source-fps), or read fewer frames (--frames)."
        )
    found = _in_metres(path, _at_rate(whole, float(rate), float(fps), start, frames), up)
    if world is None or motion is None:
        return found
    return found._replace(rig=RigClip(path, world, motion.name, found.unit))


def _read_still(path: pathlib.Path, fps: float) -> tuple[list[SourceMesh], float | None, None]:
    """An OBJ as a person who stands still for one frame."""
    m = read_obj(path)
    x = m.vertices[None].astype(np.float32)
    return [SourceMesh(path.stem, x, m.faces, m.uv, m.uv_faces, None, m.polygons)], None, None


def _read_npz(path: pathlib.Path, fps: float) -> tuple[list[SourceMesh], float | None, str | None]:
    try:
        data = read_arrays(path)
    except ValueError as error:
        raise FormatError(f"{path}: not an archive of arrays ({error})"[:300] + ".") from None
    parts = []
    for key in data:
        if not key.endswith("positions"):
            continue
        prefix = key.removesuffix("positions")
        faces = data.get(f"{prefix}faces")
        x = data[key]
        if faces is None or x.ndim != 3 or x.shape[2] != 3 or not _numbers(x):
            raise FormatError(
                f"{path}: '{key}' has shape {x.shape}; it needs [frames, vertices, 3], and"
                f" '{prefix}faces' beside it."
            )
        _check_faces(path, faces, x.shape[1])
        bind = data.get(f"{prefix}bind")
        if bind is not None and (bind.shape != x.shape[1:] or not _numbers(bind)):
            raise FormatError(f"{path}: '{prefix}bind' has shape {bind.shape}, not {x.shape[1:]}.")
        part = SourceMesh(
            prefix.rstrip("_") or "body",
            x.astype(np.float32, copy=False),
            faces.astype(np.int32),
            bind=None if bind is None else bind.astype(np.float32),
        )
        parts.append(part)
    declared = data.get("fps")
    if declared is None:
        return parts, None, None
    rate = float(declared.reshape(())) if declared.size == 1 and _numbers(declared) else 0.0
    if not _MIN_RATE <= rate < 1e4:
        raise FormatError(f"{path}: fps isn't a positive number.")
    return parts, rate, None


def _numbers(x: np.ndarray) -> bool:
    return x.dtype.kind in "fiu" and x.dtype.itemsize <= 8


def _check_faces(path: pathlib.Path, faces: np.ndarray, vertices: int) -> None:
    if (
        faces.ndim != 2
        or faces.shape[1:] != (3,)
        or not len(faces)
        or not np.issubdtype(faces.dtype, np.integer)
        or faces.min() < 0
        or faces.max() >= vertices
    ):
        raise FormatError(f"{path}: its faces aren't triangles over {vertices} vertices.")


def _read_cache(
    path: pathlib.Path, fps: float
) -> tuple[list[SourceMesh], float | None, str | None]:
    beside = path.with_suffix(".obj")
    if not is_file(beside):
        raise FormatError(
            f"{path}: a cache has only points; put the OBJ of its faces beside it, {beside.name}."
        )
    add_inputs(beside)
    rate: float | None = None
    if path.suffix.lower() == ".pc2":
        positions = read_pc2(path)
    else:
        positions, times = read_mdd(path)
        # Measured over the whole clip: single steps are differences of times with seven digits.
        span = float(times[-1] - times[0])
        if np.isfinite(span) and span > 1e-4 * (len(times) - 1):
            rate = nominal_rate((len(times) - 1) / span)
    shape = read_obj(beside)
    if len(shape.vertices) != positions.shape[1]:
        raise FormatError(
            f"{path}: {positions.shape[1]} points, but {beside.name} has {len(shape.vertices)}"
            " vertices. Export both from one mesh, with the same vertex order."
        )
    return [SourceMesh("body", positions, shape.faces, shape.uv, shape.uv_faces)], rate, None


def _at_rate(
    moving: SourceMesh, rate: float, fps: float, start: float, frames: int | None
) -> SourceMesh:
    """Cuts a clip and resamples it at another rate, linearly between its frames."""
    x = moving.positions
    first = start * rate
    count = int((len(x) - 1 - first) * fps / rate + 1e-3) + 1
    count = count if frames is None else min(count, frames)
    at = first + np.arange(count) * rate / fps
    low = np.minimum(at.astype(int), len(x) - 1)
    high = np.minimum(low + 1, len(x) - 1)
    t = (at - low)[:, None, None]
    between = x[low] + t * (x[high] - x[low]) if t.any() else x[low]
    return dataclasses.replace(moving, positions=between.astype(np.float32))


def _in_metres(path: pathlib.Path, moving: SourceMesh, up: str | None) -> Read:
    """Converts to metres, by the height of a person, and to Y up, as declared or by extents."""
    x = moving.positions
    extent = np.ptp(x[0], axis=0)
    notes = []
    if up is None:
        up = "Z" if extent[2] > extent[1] else "Y"
        if up == "Z":
            notes.append("Z is up: the person is higher along it than along Y")
    height = float(extent[2 if up == "Z" else 1])
    unit = unit_of_person(height)
    if unit is None:
        raise FormatError(
            f"{path}: its height is {height:.3g} in its first frame, which is no person's height in"
            f" {', '.join(UNITS)}. Scale it, or choose its body with --body-mesh."
        )
    if unit != "m":
        notes.append(f"the unit is {unit}: the person is {height:.3g} high")
    scale = UNITS[unit]

    def turned(p: np.ndarray) -> np.ndarray:
        p = p[..., [0, 2, 1]] * np.array([1.0, 1.0, -1.0], p.dtype) if up == "Z" else p
        return (p * p.dtype.type(scale)).astype(np.float32)

    bind = None if moving.bind is None else turned(moving.bind)
    mesh = AnimatedMesh(
        "body", turned(x), moving.faces, moving.uv, moving.uv_faces, (0.69, 0.46, 0.33)
    )
    return Read(mesh, bind, tuple(notes), scale)
