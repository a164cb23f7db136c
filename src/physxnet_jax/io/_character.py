"""Animated persons of other programs: point caches, USD, npz, glTF."""

import dataclasses
import functools
import math
import pathlib
from collections.abc import Mapping

import numpy as np
from jaxtyping import Float

from ..errors import FormatError
from ..files import is_file, read_arrays
from ..motion import GLTF_FORMATS, Motion, nominal_rate
from ._clip import AnimatedMesh
from ._mdd import read_mdd
from ._moving import Moving, joined, named
from ._obj import read_obj
from ._pc2 import read_pc2

CHARACTER_FORMATS = (".glb", ".gltf", ".vrm", ".usdc", ".usd", ".usda", ".pc2", ".mdd", ".npz")
"""Endings that `read_character` knows."""

# Coordinates of a clip that are read at most.
_MOST = 3e8
_FARTHEST = 1e18
# Frames a second that a file may say, at least: one an hour.
_SLOWEST = 1 / 3600
# Heights of a person [m], grown or a child, in units that programs write.
_HEIGHTS = (0.8, 2.6)
_UNITS = {"m": 1.0, "cm": 0.01, "mm": 0.001, "inches": 0.0254}


def read_character(
    path: str | pathlib.Path,
    *,
    fps: float | int = 30.0,
    source_fps: float | int | None = None,
    mesh: str | None = None,
    frames: int | None = None,
    motion: Motion | None = None,
    joint_map: Mapping[str, str] | None = None,
) -> tuple[AnimatedMesh, Float[np.ndarray, "vertices 3"] | None, tuple[str, ...]]:
    """A person of one's own, animated elsewhere.

    ``.glb``, ``.gltf``: skins with their first animation, or morph targets. ``.usd*``:
    points as time samples, skins of UsdSkel. ``.pc2``, ``.mdd``: caches, with the OBJ of
    their faces beside them. ``.npz``: ``positions``, ``faces`` and ``fps``, or with a
    mesh's name before the first two, as `write_clip` writes. Several meshes become one,
    but for files in which one is called body: that one is taken.

    Args:
        path: The file.
        fps: Frames a second of the result.
        source_fps: True rate of a file that doesn't say it; else 30 (USD: 24, as there). A
            glTF does.
        mesh: Name of the mesh to take.
        frames: Keep only this many frames.
        motion: What moves a rigged person (glTF, VRM) instead of the file's animation; at
            its own rate.
        joint_map: Body joint to the file's joint, for `motion` and unknown names.

    Returns:
        The person [m], Y up; the bind pose of a skin, else None; what was found out
        about unit and axes.

    Raises:
        FormatError: No such format, a damaged file, no such mesh, nothing as high as a
            person in any unit; a rate or a number of frames that isn't positive.
        MotionError: A damaged glTF.
        MissingDependencyError: Without the library that reads it.
    """
    path = pathlib.Path(path)
    suffix = path.suffix.lower()
    for name, value in (("fps", fps), ("source_fps", source_fps)):
        if value is not None and not (math.isfinite(value) and value > 0):
            raise FormatError(f"{name} is {value}, expected a positive number.")
    if frames is not None and frames < 1:
        raise FormatError(f"frames is {frames}; ask for at least one.")
    if suffix not in CHARACTER_FORMATS:
        raise FormatError(
            f"{path}: no animated person is read from '{suffix}', only from"
            f" {', '.join(CHARACTER_FORMATS)}."
        )
    if not is_file(path):
        raise FormatError(f"{path}: no such file. Check the path.")
    if motion is not None and suffix not in GLTF_FORMATS:
        raise FormatError(
            f"{path}: another motion can move a rig alone, from {', '.join(GLTF_FORMATS[:3])};"
            f" a {suffix} file brings its own."
        )
    if suffix in GLTF_FORMATS:
        from ._gltf_character import read_gltf_meshes

        read = functools.partial(read_gltf_meshes, motion=motion, joint_map=joint_map)
        fps = fps if motion is None else motion.fps
    elif suffix.startswith(".usd"):
        from ._usd_character import read_usd_meshes as read
    elif suffix == ".npz":
        read = _read_npz
    else:
        read = _read_cache
    # What a damaged file holds may be infinite; it is refused below.
    with np.errstate(all="ignore"):
        parts, rate, up = read(path, fps)
    if not parts:
        raise FormatError(f"{path}: no mesh that moves. Export the person with its animation.")
    if mesh is None:
        parts = [p for p in parts if p.name.lower() == "body"] or parts
    chosen = named(path, parts, mesh, "Say another (--body-mesh)")
    if len({len(p.positions) for p in chosen}) > 1 or not len(chosen[0].positions):
        counts = ", ".join(f"{p.name} {len(p.positions)}" for p in chosen[:6])
        raise FormatError(
            f"{path}: meshes with {counts} frames. Export them over one range, or choose one with"
            " --body-mesh."
        )
    whole = joined(chosen)
    if whole.positions.size > _MOST:
        raise FormatError(f"{path}: {whole.positions.size:,} coordinates. Cut the clip.")
    # Beyond that their squares aren't finite in float32.
    binds = np.zeros(1) if whole.bind is None else whole.bind
    chart = np.zeros(1) if whole.uv is None else whole.uv
    if not all((np.abs(x) < _FARTHEST).all() for x in (whole.positions, binds, chart)):
        raise FormatError(f"{path}: positions that aren't finite. Export it again.")
    # A glTF tells its times: it was read at the rate that is wanted.
    rate = (rate if suffix in GLTF_FORMATS else source_fps or rate) or 30.0
    seconds = (len(whole.positions) - 1) / rate
    count = seconds * fps + 1 if frames is None else min(seconds * fps + 1, frames)
    if count * whole.positions[0].size > _MOST:
        raise FormatError(
            f"{path}: {seconds:.0f} s at {fps:g} frames a second are more than are read. Say its"
            " true rate (--source-fps), or take fewer (--frames)."
        )
    return _in_metres(path, _at_rate(whole, float(rate), float(fps), frames), up)


def _read_npz(path: pathlib.Path, fps: float) -> tuple[list[Moving], float | None, str | None]:
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
                f"{path}: '{key}' has the shape {x.shape}; it takes [frames, vertices, 3], and"
                f" '{prefix}faces' beside it."
            )
        _check_faces(path, faces, x.shape[1])
        x = x.astype(np.float32, copy=False)
        parts.append(Moving(prefix.rstrip("_") or "body", x, faces.astype(np.int32)))
    told = data.get("fps")
    if told is None:
        return parts, None, None
    rate = float(told.reshape(())) if told.size == 1 and _numbers(told) else 0.0
    if not _SLOWEST <= rate < 1e4:
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


def _read_cache(path: pathlib.Path, fps: float) -> tuple[list[Moving], float | None, str | None]:
    beside = path.with_suffix(".obj")
    if not is_file(beside):
        raise FormatError(
            f"{path}: a cache has points alone; put the OBJ of its faces beside it, {beside.name}."
        )
    rate: float | None = None
    if path.suffix.lower() == ".pc2":
        positions = read_pc2(path)
    else:
        positions, times = read_mdd(path)
        # Over the whole clip: single steps are known to seven digits of their time alone.
        span = float(times[-1] - times[0])
        if np.isfinite(span) and span > 1e-4 * (len(times) - 1):
            rate = nominal_rate((len(times) - 1) / span)
    shape = read_obj(beside)
    if len(shape.vertices) != positions.shape[1]:
        raise FormatError(
            f"{path}: {positions.shape[1]} points, but {beside.name} has {len(shape.vertices)}"
            " vertices. Export both from one mesh, vertex order kept."
        )
    return [Moving("body", positions, shape.faces, shape.uv, shape.uv_faces)], rate, None


def _at_rate(moving: Moving, rate: float, fps: float, frames: int | None) -> Moving:
    """The clip at another rate, linear between its frames."""
    x = moving.positions
    count = int((len(x) - 1) * fps / rate + 1e-3) + 1
    count = count if frames is None else min(count, frames)
    at = np.arange(count) * rate / fps
    low = np.minimum(at.astype(int), len(x) - 1)
    high = np.minimum(low + 1, len(x) - 1)
    t = (at - low)[:, None, None]
    between = x[low] + t * (x[high] - x[low]) if t.any() else x[low]
    return dataclasses.replace(moving, positions=between.astype(np.float32))


def _in_metres(
    path: pathlib.Path, moving: Moving, up: str | None
) -> tuple[AnimatedMesh, Float[np.ndarray, "vertices 3"] | None, tuple[str, ...]]:
    """Metres and Y up, by what the file says or by how high a person is."""
    x = moving.positions
    extent = np.ptp(x[0], axis=0)
    notes = []
    if up is None:
        up = "Z" if extent[2] > extent[1] else "Y"
        if up == "Z":
            notes.append("Z is up: the person is higher along it than along Y")
    height = float(extent[2 if up == "Z" else 1])
    fitting = [n for n, s in _UNITS.items() if _HEIGHTS[0] <= s * height <= _HEIGHTS[1]]
    if not fitting:
        raise FormatError(
            f"{path}: {height:.3g} high in its first frame, which is no person's height in"
            f" {', '.join(_UNITS)}. Scale it, or choose its body with --body-mesh."
        )
    if fitting[0] != "m":
        notes.append(f"the unit is {fitting[0]}: the person is {height:.3g} high")
    scale = _UNITS[fitting[0]]

    def turned(p: np.ndarray) -> np.ndarray:
        p = p[..., [0, 2, 1]] * np.array([1.0, 1.0, -1.0], p.dtype) if up == "Z" else p
        return (p * p.dtype.type(scale)).astype(np.float32)

    bind = None if moving.bind is None else turned(moving.bind)
    mesh = AnimatedMesh(
        "body", turned(x), moving.faces, moving.uv, moving.uv_faces, (0.69, 0.46, 0.33)
    )
    return mesh, bind, tuple(notes)
