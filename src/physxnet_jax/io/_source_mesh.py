"""Animated or static meshes of a file, before conversion to metres."""

import dataclasses
import pathlib
from collections.abc import Collection, Sequence

import numpy as np
from jaxtyping import Float, Int

from ..errors import FormatError
from ..geometry import Polygons, joined_polygons

# Vertices closer in all frames than this share of the mesh's size are merged.
_MERGE_TOLERANCE = 3e-6
# Largest number of passes that split vertices at one position by their motion.
_MAX_PASSES = 100


@dataclasses.dataclass(frozen=True)
class SourceMesh:
    """A mesh of a file, in the file's unit and axes.

    Attributes:
        name: Its name in the file.
        positions: Shape [frames, vertices, 3].
        faces: Triangles.
        uv: Texture coordinates; or None.
        uv_faces: Corners in ``uv``; or None.
        bind: Bind pose of a skin, shape [vertices, 3]; or None.
        polygons: Polygons that the triangles were cut from; or None.
    """

    name: str
    positions: Float[np.ndarray, "frames vertices 3"]
    faces: Int[np.ndarray, "faces 3"]
    uv: Float[np.ndarray, "uvs 2"] | None = None
    uv_faces: Int[np.ndarray, "faces 3"] | None = None
    bind: Float[np.ndarray, "vertices 3"] | None = None
    polygons: Polygons | None = None

    def reversed(self) -> "SourceMesh":
        """The mesh with its winding flipped, as reflections require."""
        p = self.polygons
        return dataclasses.replace(
            self,
            faces=self.faces[:, ::-1],
            uv_faces=None if self.uv_faces is None else self.uv_faces[:, ::-1],
            polygons=None if p is None else p.reversed(np.arange(len(p.counts))),
        )


def chosen_names(name: str, have: Collection[str]) -> set[str]:
    """Names of the meshes that ``a+b`` selects; a mesh may itself be called so."""
    return {name} if name in have else set(name.split("+"))


def named(
    path: pathlib.Path, parts: Sequence[SourceMesh], name: str | None, advice: str
) -> Sequence[SourceMesh]:
    """The meshes of this name (``a+b`` for two), or all if it is None.

    Raises:
        FormatError: No mesh has this name.
    """
    if name is None:
        return parts
    wanted = chosen_names(name, {p.name for p in parts})
    chosen = [p for p in parts if p.name in wanted]
    if wanted - {p.name for p in chosen}:
        names = ", ".join(sorted({p.name for p in parts}))[:300]
        raise FormatError(f"{path}: no mesh '{name}'; there are {names}. {advice}.")
    return chosen


def joined(parts: Sequence[SourceMesh]) -> SourceMesh:
    """Joins several meshes into one."""
    if len(parts) == 1:
        return parts[0]
    first = np.cumsum([0, *(p.positions.shape[1] for p in parts)])
    faces = [p.faces + n for p, n in zip(parts, first[:-1], strict=True)]
    binds = [p.bind for p in parts]
    drawn = [
        (p.polygons, p.positions.shape[1], 0 if p.uv is None else len(p.uv))
        for p in parts
        if p.polygons is not None
    ]
    uv = uv_faces = None
    if all(p.uv is not None and p.uv_faces is not None for p in parts):
        starts = np.cumsum([0, *(len(p.uv) for p in parts if p.uv is not None)])
        uv = np.concatenate([p.uv for p in parts if p.uv is not None])
        uv_faces = np.concatenate(
            [p.uv_faces + n for p, n in zip(parts, starts) if p.uv_faces is not None]
        )
    return SourceMesh(
        "body",
        np.concatenate([p.positions for p in parts], axis=1),
        np.concatenate(faces),
        uv,
        uv_faces,
        None
        if any(b is None for b in binds)
        else np.concatenate([b for b in binds if b is not None]),
        None if len(drawn) < len(parts) else joined_polygons(drawn),
    )


def _split_groups(
    x: Float[np.ndarray, "frames vertices 3"],
    first: Int[np.ndarray, " groups"],
    index: Int[np.ndarray, " vertices"],
) -> tuple[Int[np.ndarray, " more"], Int[np.ndarray, " vertices"]]:
    """Splits groups of coincident vertices whose members separate in any frame.

    Touching lips or hands aren't seams.
    """
    size = max(float(np.ptp(x[0], axis=0).max()), 1e-9)
    rows = np.flatnonzero(np.bincount(index)[index] > 1)
    for _ in range(_MAX_PASSES):
        leads = first[index[rows]]
        far = np.zeros(len(rows), dtype=bool)
        for frame in x:
            far |= np.abs(frame[rows] - frame[leads]).max(axis=1) > _MERGE_TOLERANCE * size
        rows = rows[far]
        # Vertices that left a group may form a new one.
        _, begin, group = np.unique(index[rows], return_index=True, return_inverse=True)
        index[rows] = len(first) + group
        first = np.concatenate([first, rows[begin]])
        if not len(rows):
            return first, index
    # Coincident vertices that still separate aren't merged.
    index[rows] = len(first) + np.arange(len(rows))
    return np.concatenate([first, rows]), index


def welded(part: SourceMesh) -> SourceMesh:
    """Merges vertices that were duplicated at texture seams."""
    place = part.positions[0] if part.bind is None else part.bind
    size = max(float(np.ptp(place, axis=0).max()), 1e-9)
    _, first, index = np.unique(
        np.round(place / size * 1e6), axis=0, return_index=True, return_inverse=True
    )
    first, index = _split_groups(part.positions, first, index.reshape(-1))
    # In the file's order, so that a mesh without seams stays unchanged.
    order = np.argsort(first)
    first, rank = first[order], np.argsort(order)
    row = rank[index]
    faces = row[part.faces].astype(np.int32)
    whole = (
        (faces[:, 0] != faces[:, 1]) & (faces[:, 1] != faces[:, 2]) & (faces[:, 2] != faces[:, 0])
    )
    return SourceMesh(
        part.name,
        part.positions[:, first],
        faces[whole],
        part.uv,
        None if part.uv_faces is None else part.uv_faces[whole],
        None if part.bind is None else part.bind[first],
        None if part.polygons is None or not whole.all() else part.polygons.at(row),
    )
