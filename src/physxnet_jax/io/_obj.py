"""Wavefront OBJ: polygons, texture coordinates, materials, several objects in a file."""

import contextlib
import pathlib
import re
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int

from ..errors import FormatError
from ..files import is_file, whole_file
from ..geometry import Material, Polygons, Texture, make_material
from ._chart import Move, make_move, moved_charts
from ._clip import StillMesh
from ._texture import texture_beside, write_textures

_MAX_BYTES = 500_000_000
_MAX_LIBRARY = 5_000_000
_FARTHEST = 1e18
_INDEX = re.compile(r"[+-]?[0-9]{1,18}")
_NONE = "default"
# Options of an image in a material file and how many words follow them, for some at most.
_OPTIONS = {"blendu": 1, "blendv": 1, "bm": 1, "boost": 1, "cc": 1, "clamp": 1, "imfchan": 1}
_OPTIONS |= {"mm": 2, "texres": 1, "type": 1}
_NUMBERS = {"o": 3, "s": 3, "t": 3}


def read_obj(path: str | pathlib.Path, part: str | None = None) -> StillMesh:
    """Reads an OBJ; quads are split along their shorter diagonal, others in a fan.

    Args:
        path: The file.
        part: Name of the object to take, or of the group in a file without objects; all
            of them if omitted.

    Returns:
        The mesh; vertex order is kept. Polygons keep the names of their materials, and the
        colours and images that a material file beside it tells.

    Raises:
        FormatError: Missing, empty, binary or malformed files; indices out of range;
            values that aren't finite; no part of that name. File, line and fix are named.
    """
    path = pathlib.Path(path)
    if not is_file(path):
        raise FormatError(f"{path}: no such file. Check the path.")
    if path.stat().st_size > _MAX_BYTES:
        raise FormatError(f"{path}: over 500 MB. Decimate the mesh first.")
    blob = path.read_bytes()
    if b"\0" in blob[:4096]:
        raise FormatError(f"{path}: binary data, not OBJ text. Export as OBJ.")
    told = _gathered(blob.decode("utf-8", "replace"))
    if not told.vertices or not told.faces:
        raise FormatError(
            f"{path}: {len(told.vertices)} vertices and {len(told.faces)} faces; a mesh needs"
            " both. Export the mesh with its faces."
        )
    v = _numbers(path, told.vertices, told.vertex_lines, 3)
    uv = _numbers(path, told.uv, told.uv_lines, 2)
    counts = np.asarray([len(words) for words in told.faces])
    corners = _corners(path, told, counts, (len(v), len(uv)))
    material = np.asarray(told.material, np.int32)
    owner = told.objects if any(told.objects) else told.groups
    parts = tuple(sorted({name for name in owner if name}))
    if part is not None:
        mine = np.asarray([name == part for name in owner])
        if not mine.any():
            there = ", ".join(parts)[:300] or "one mesh without a name"
            raise FormatError(f"{path}: no mesh '{part}'; there is {there}.")
        corners, counts, material = corners[np.repeat(mine, counts)], counts[mine], material[mine]
        # The others' vertices belong to no face any more; the order stays.
        kept, at = np.unique(corners[:, 0], return_inverse=True)
        v, corners = v[kept], np.column_stack([at.reshape(-1), corners[:, 1]])
        parts = (part,)
    table = corners[_split(counts, v[corners[:, 0]])]
    has_uv = len(uv) > 0 and bool((corners[:, 1] >= 0).all())
    looks = _looks(path, told.libraries)
    drawn = Polygons(
        counts.astype(np.int32),
        corners[:, 0].astype(np.int32),
        corners[:, 1].astype(np.int32) if has_uv else None,
        material,
        tuple(looks[n].material if n in looks else Material(n) for n in told.names),
    )
    chart, chart_faces = (uv, table[..., 1]) if has_uv else (None, None)
    if chart is not None and chart_faces is not None:
        moves = {k: looks[n].move for k, n in enumerate(told.names) if n in looks}
        chart, chart_faces, drawn = moved_charts(
            chart, chart_faces, drawn, {k: m for k, m in moves.items() if m is not None}
        )
    return StillMesh(v, table[..., 0], chart, chart_faces, drawn, len(counts), parts)


class _Told(NamedTuple):
    """What the lines of a file say, word by word.

    Attributes:
        vertices: Words of each vertex.
        vertex_lines: Lines they stand in, from 1.
        uv: Words of each texture coordinate.
        uv_lines: Their lines.
        faces: Words of each face's corners.
        face_lines: Their lines.
        before: Vertices and texture coordinates that there were before each face.
        material: Place of each face's material in ``names``; -1 without one.
        objects: Name of the object each face is in.
        groups: Name of its group.
        names: Materials, in the order of their first use.
        libraries: Material files.
    """

    vertices: list[list[str]]
    vertex_lines: list[int]
    uv: list[list[str]]
    uv_lines: list[int]
    faces: list[list[str]]
    face_lines: list[int]
    before: list[tuple[int, int]]
    material: list[int]
    objects: list[str]
    groups: list[str]
    names: list[str]
    libraries: list[str]


def _gathered(text: str) -> _Told:
    told = _Told(*([] for _ in _Told._fields))
    places: dict[str, int] = {}
    used, current = -1, {"o": "", "g": ""}
    for n, line in enumerate(text.splitlines(), start=1):
        words = line.split("#")[0].split()
        if not words:
            continue
        key = words[0]
        if key == "v":
            told.vertices.append(words[1:4])
            told.vertex_lines.append(n)
        elif key == "vt":
            told.uv.append([*words[1:3], "0"][:2])
            told.uv_lines.append(n)
        elif key == "f":
            told.faces.append(words[1:])
            told.face_lines.append(n)
            told.before.append((len(told.vertices), len(told.uv)))
            told.material.append(used)
            told.objects.append(current["o"])
            told.groups.append(current["g"])
        elif key in current:
            current[key] = _rest(line)
        elif key == "usemtl":
            used = places.setdefault(_rest(line), len(places))
        elif key == "mtllib":
            told.libraries.append(_rest(line))
    told.names.extend(places)
    return told


def _numbers(
    path: pathlib.Path, rows: list[list[str]], lines: list[int], count: int
) -> Float[np.ndarray, "rows numbers"]:
    """Numbers of lines, all at once; one by one where something is wrong, to say where."""
    try:
        flat = np.array([float(w) for words in rows for w in words])
    except ValueError:
        flat = np.zeros(0)
    # Beyond that their squares aren't finite in float32.
    whole = all(len(words) == count for words in rows) and len(flat) == count * len(rows)
    if whole and (np.abs(flat) < _FARTHEST).all():
        return flat.reshape(-1, count)
    for n, words in zip(lines, rows, strict=True):
        try:
            values = [float(w) for w in words]
        except ValueError:
            raise FormatError(
                f"{path}:{n}: '{' '.join(words)[:60]}' aren't numbers. Export again."
            ) from None
        if len(values) != count or not all(abs(x) < _FARTHEST for x in values):
            raise FormatError(
                f"{path}:{n}: expected {count} finite numbers, got {values}. Export again."
            )
    return flat.reshape(-1, count)


def _corners(
    path: pathlib.Path, told: _Told, counts: Int[np.ndarray, " faces"], there: tuple[int, int]
) -> Int[np.ndarray, "corners 2"]:
    """Vertex and texture coordinate of every corner, from 0; -1 without one."""
    words = [word for face in told.faces for word in face]
    face = np.repeat(np.arange(len(counts)), counts)

    def fail(corner: int, problem: str) -> FormatError:
        line, word = told.face_lines[face[corner]], words[corner][:40]
        return FormatError(f"{path}:{line}: '{word}' {problem}. Export again.")

    pairs = [[*word.split("/"), ""][:2] for word in words]
    try:
        index = np.array([(int(a), int(t) if t else 0) for a, t in pairs], np.int64)
    except (ValueError, OverflowError):
        for k, (a, t) in enumerate(pairs):
            if not (_INDEX.fullmatch(a) and (not t or _INDEX.fullmatch(t))):
                raise fail(k, "isn't a face corner") from None
        raise FormatError(f"{path}: faces that can't be read. Export again.") from None
    index = index.reshape(-1, 2)
    before = np.asarray(told.before)[face]
    given = np.array([bool(t) for _, t in pairs], bool)
    wrong = (index[:, 0] == 0) | (given & (index[:, 1] == 0)) | (index[:, 1] < -before[:, 1])
    if wrong.any():
        raise fail(int(wrong.argmax()), "isn't an index from 1")
    out = np.where(index > 0, index - 1, before + index)
    out[~given, 1] = -1
    order = np.lexsort((out[:, 0], face))
    new = np.diff(out[order, 0], prepend=-1) != 0
    new |= np.diff(face[order], prepend=-1) != 0
    few = np.bincount(face[order][new], minlength=len(counts)) < 3
    if few.any():
        line = told.face_lines[int(few.argmax())]
        raise FormatError(f"{path}:{line}: a face of fewer than three vertices. Delete it.")
    lost = (out[:, 0] < 0) | (out[:, 0] >= there[0]) | (out[:, 1] >= there[1])
    if lost.any():
        k = int(lost.argmax())
        raise FormatError(
            f"{path}:{told.face_lines[face[k]]}: a face names vertex {out[k, 0] + 1} or uv"
            f" {out[k, 1] + 1}, but there are {there[0]} and {there[1]}. Export the file again."
        )
    return out


def _split(
    counts: Int[np.ndarray, " faces"], points: Float[np.ndarray, "corners 3"]
) -> Int[np.ndarray, "triangles 3"]:
    """Triangles of faces, as rows of their corners: a quad along its shorter diagonal."""
    starts = np.cumsum(counts) - counts
    turned = np.zeros(len(counts), np.int64)
    quads = np.flatnonzero(counts == 4)
    p = points[starts[quads][:, None] + np.arange(4)]
    across = [np.sum((p[:, k] - p[:, k + 2]) ** 2, axis=1) for k in range(2)]
    turned[quads] = across[0] > across[1]
    face = np.repeat(np.arange(len(counts)), counts - 2)
    k = np.arange(len(face)) - np.repeat(np.cumsum(counts - 2) - (counts - 2), counts - 2) + 1
    fan = np.stack([np.zeros_like(k), k, k + 1], axis=1) + turned[face][:, None]
    return starts[face][:, None] + fan % counts[face][:, None]


class _Look(NamedTuple):
    """A material, and how it moves texture coordinates."""

    material: Material
    move: Move | None


def _looks(path: pathlib.Path, libraries: list[str]) -> dict[str, _Look]:
    """Materials of the material files beside a mesh; what can't be read tells nothing."""
    found: dict[str, _Look] = {}
    images: dict[str, Texture] = {}
    for library in dict.fromkeys(libraries):
        # Only what lies beside it: a name may lead anywhere.
        file = path.parent / pathlib.PurePath(library.replace("\\", "/")).name
        if not is_file(file) or file.stat().st_size > _MAX_LIBRARY:
            continue
        name, colour, image, move = None, None, None, None
        for line in file.read_bytes().decode("utf-8", "replace").splitlines():
            words = line.split("#")[0].split()
            if words[:1] == ["newmtl"]:
                name, colour, image, move = _rest(line), None, None, None
            elif words[:1] == ["Kd"]:
                with contextlib.suppress(ValueError):
                    colour = [float(w) for w in words[1:4]]
            elif words[:1] == ["map_Kd"] and words[1:]:
                named, move = _image(line)
                image = images.get(named)
                if image is None:
                    image = images[named] = texture_beside(file, named)
            if name is not None:
                # Beside an image most programs write a grey that none of them multiplies by.
                plain = image is None or image.data is None
                material = make_material(name, colour if plain else None, image)
                found[name] = _Look(material, None if plain else move)
    return found


def _image(line: str) -> tuple[str, Move | None]:
    """What `map_Kd` names, and how its options move coordinates; names may have spaces."""
    rest = _rest(line)
    words = rest.split()
    told = {"s": [1.0, 1.0], "o": [0.0, 0.0]}
    at = 0
    while words[at].startswith("-"):
        key = words[at][1:].lower()
        after = at + 1 + _OPTIONS.get(key, 0)
        for k, word in enumerate(words[after : after + _NUMBERS.get(key, 0)]):
            try:
                value = float(word)
            except ValueError:
                break
            after += 1
            if key in told and k < 2:
                told[key][k] = value
        if after >= len(words):
            break
        at = after
    return rest.split(None, at)[-1], make_move(told["s"], told["o"])


def _rest(line: str) -> str:
    """What follows the first word; names may have spaces."""
    return "".join(line.strip().split(None, 1)[1:]).strip()


def write_obj(
    path: str | pathlib.Path,
    vertices: Float[np.ndarray, "vertices 3"],
    faces: Int[np.ndarray, "faces 3"],
    uv: Float[np.ndarray, "uvs 2"] | None = None,
    uv_faces: Int[np.ndarray, "faces 3"] | None = None,
    *,
    polygons: Polygons | None = None,
    library: str | None = None,
) -> None:
    """Writes one mesh, atomically.

    Args:
        path: The file.
        vertices: Positions [m].
        faces: Triangles.
        uv: Texture coordinates.
        uv_faces: Corners in ``uv``.
        polygons: What is written in place of the triangles, with names of materials.
        library: Name of the material file beside it, by `write_materials`.
    """
    lines = [] if library is None else [f"mtllib {library}"]
    lines += [f"v {x:.7g} {y:.7g} {z:.7g}" for x, y, z in np.asarray(vertices)]
    textured = uv is not None and uv_faces is not None
    if textured:
        lines += [f"vt {a:.6g} {b:.6g}" for a, b in np.asarray(uv)]
    if polygons is None:
        polygons = Polygons(
            np.full(len(faces), 3),
            np.asarray(faces).reshape(-1),
            np.asarray(uv_faces).reshape(-1) if textured else None,
            np.full(len(faces), -1),
        )
    words = [str(a + 1) for a in polygons.corners]
    if textured and polygons.uv_corners is not None:
        words = [f"{a}/{t + 1}" for a, t in zip(words, polygons.uv_corners, strict=True)]
    used = -1
    for start, count, which in zip(
        polygons.starts, polygons.counts, polygons.material, strict=True
    ):
        if which != used:
            # What has none would otherwise be taken for what was before it.
            lines.append(f"usemtl {polygons.materials[which].name if which >= 0 else _NONE}")
        used = which
        lines.append("f " + " ".join(words[start : start + count]))
    with whole_file(path) as part:
        part.write_text("\n".join(lines) + "\n", encoding="utf-8")


def write_materials(path: str | pathlib.Path, materials: Sequence[Material]) -> list[pathlib.Path]:
    """Writes an MTL of the materials' names and colours, and their images beside it.

    Returns:
        The files written, each whole or not at all.
    """
    path = pathlib.Path(path)
    images = write_textures(path, [m.texture for m in materials])
    lines = []
    for m in materials:
        lines.append(f"newmtl {m.name}")
        image = None if m.texture is None else images.get(m.texture)
        colour = (1.0, 1.0, 1.0) if m.colour is None and image is not None else m.colour
        if colour is not None:
            lines.append("Kd " + " ".join(f"{c:.6g}" for c in colour))
        if image is not None:
            lines.append(f"map_Kd {image.name}")
    with whole_file(path) as part:
        part.write_text("\n".join(lines) + "\n", encoding="utf-8")
    return [path, *images.values()]
