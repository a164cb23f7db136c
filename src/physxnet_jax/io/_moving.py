"""Meshes of a file, moving or still, before they are brought to metres."""

import dataclasses
import pathlib
from collections.abc import Sequence

import numpy as np
from jaxtyping import Float, Int

from ..errors import FormatError
from ..geometry import Polygons, joined_polygons

# Vertices within this share of a mesh's size of each other, in all frames, are one.
_TOGETHER = 3e-6
# As many ways from one place are told apart.
_PARTINGS = 100


@dataclasses.dataclass(frozen=True)
class Moving:
    """A part of a file: a mesh that moves, in the file's own unit and axes.

    Attributes:
        name: Its name there.
        positions: Shape [frames, vertices, 3].
        faces: Triangles.
        uv: Texture coordinates; or None.
        uv_faces: Corners in ``uv``; or None.
        bind: The pose in which a skin was bound, shape [vertices, 3]; or None.
        polygons: What the triangles were cut from; or None.
    """

    name: str
    positions: Float[np.ndarray, "frames vertices 3"]
    faces: Int[np.ndarray, "faces 3"]
    uv: Float[np.ndarray, "uvs 2"] | None = None
    uv_faces: Int[np.ndarray, "faces 3"] | None = None
    bind: Float[np.ndarray, "vertices 3"] | None = None
    polygons: Polygons | None = None

    def reversed(self) -> "Moving":
        """The same with its faces the other way round: what is mirrored shows its inside."""
        p = self.polygons
        return dataclasses.replace(
            self,
            faces=self.faces[:, ::-1],
            uv_faces=None if self.uv_faces is None else self.uv_faces[:, ::-1],
            polygons=None if p is None else p.reversed(np.arange(len(p.counts))),
        )


def named(
    path: pathlib.Path, parts: Sequence[Moving], name: str | None, advice: str
) -> Sequence[Moving]:
    """The meshes of this name, all without one.

    Raises:
        FormatError: None is called that.
    """
    if name is None:
        return parts
    chosen = [p for p in parts if p.name == name]
    if not chosen:
        names = ", ".join(sorted({p.name for p in parts}))[:300]
        raise FormatError(f"{path}: no mesh '{name}'; there are {names}. {advice}.")
    return chosen


def joined(parts: Sequence[Moving]) -> Moving:
    """Several meshes as one."""
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
    return Moving(
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


def _parted(
    x: Float[np.ndarray, "frames vertices 3"],
    first: Int[np.ndarray, " groups"],
    index: Int[np.ndarray, " vertices"],
) -> tuple[Int[np.ndarray, " more"], Int[np.ndarray, " vertices"]]:
    """Groups of vertices of one place, split where members go different ways in any frame.

    Lips or hands that touch are no seam.
    """
    size = max(float(np.ptp(x[0], axis=0).max()), 1e-9)
    rows = np.flatnonzero(np.bincount(index)[index] > 1)
    for _ in range(_PARTINGS):
        leads = first[index[rows]]
        far = np.zeros(len(rows), dtype=bool)
        for frame in x:
            far |= np.abs(frame[rows] - frame[leads]).max(axis=1) > _TOGETHER * size
        rows = rows[far]
        # Those that left a group may belong together.
        _, begin, group = np.unique(index[rows], return_index=True, return_inverse=True)
        index[rows] = len(first) + group
        first = np.concatenate([first, rows[begin]])
        if not len(rows):
            return first, index
    # Many in one place that all go their own ways were never one.
    index[rows] = len(first) + np.arange(len(rows))
    return np.concatenate([first, rows]), index


def welded(part: Moving) -> Moving:
    """Vertices that were doubled at texture seams become one again."""
    place = part.positions[0] if part.bind is None else part.bind
    size = max(float(np.ptp(place, axis=0).max()), 1e-9)
    _, first, index = np.unique(
        np.round(place / size * 1e6), axis=0, return_index=True, return_inverse=True
    )
    first, index = _parted(part.positions, first, index.reshape(-1))
    # In the file's order, so that a mesh without seams stays as it was.
    order = np.argsort(first)
    first, rank = first[order], np.argsort(order)
    row = rank[index]
    faces = row[part.faces].astype(np.int32)
    whole = (
        (faces[:, 0] != faces[:, 1]) & (faces[:, 1] != faces[:, 2]) & (faces[:, 2] != faces[:, 0])
    )
    return Moving(
        part.name,
        part.positions[:, first],
        faces[whole],
        part.uv,
        None if part.uv_faces is None else part.uv_faces[whole],
        None if part.bind is None else part.bind[first],
        None if part.polygons is None or not whole.all() else part.polygons.at(row),
    )
