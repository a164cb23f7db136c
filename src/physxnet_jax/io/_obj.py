"""Wavefront OBJ: polygons, texture coordinates, materials, several objects in a file."""

import contextlib
import itertools
import pathlib
import re
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int

from ..errors import FormatError, visible
from ..files import add_inputs, atomic_write, is_file
from ..geometry import Material, Polygons, Texture, make_material
from ._animated_mesh import StaticMesh
from ._source_mesh import chosen_names
from ._texture import texture_beside, write_textures
from ._uv_transform import UvTransform, make_uv_transform, transform_uvs

_MAX_BYTES = 500_000_000
_MAX_LIBRARY = 5_000_000
_MAX_COORDINATE = 1e18
_INDEX = re.compile(r"[+-]?[0-9]{1,18}")
_NONE = "default"
# Options of an image in a material file, with their number of arguments (the largest for some).
_OPTIONS = {"blendu": 1, "blendv": 1, "bm": 1, "boost": 1, "cc": 1, "clamp": 1, "imfchan": 1}
_OPTIONS |= {"mm": 2, "texres": 1, "type": 1}
_NUMBERS = {"o": 3, "s": 3, "t": 3}


def read_obj(path: str | pathlib.Path, part: str | None = None) -> StaticMesh:
    """Reads an OBJ; quads are split along their shorter diagonal, other polygons as fans.

    Args:
        path: The file.
        part: Name of the object to read, or of the group in a file without objects, or
            several joined by ``+``; all of them if omitted.

    Returns:
        The mesh; vertex order is kept. Polygons keep the names of their materials, and the
        colours and images that the material files beside it define.

    Raises:
        FormatError: The file is missing, empty, binary or malformed, an index is out of
            range, a value isn't finite, or no part has that name. The message names the file,
            the line and a remedy.
    """
    path = pathlib.Path(path)
    if not is_file(path):
        raise FormatError(f"{path}: no such file. Check the path.")
    add_inputs(path)
    if path.stat().st_size > _MAX_BYTES:
        raise FormatError(f"{path}: over 500 MB. Decimate the mesh first.")
    blob = path.read_bytes()
    if b"\0" in blob[:4096]:
        raise FormatError(f"{path}: binary data, not OBJ text. Export as OBJ.")
    parsed = _parse_lines(blob.decode("utf-8", "replace"))
    if not parsed.vertices or not parsed.faces:
        raise FormatError(
            f"{path}: {len(parsed.vertices)} vertices and {len(parsed.faces)} faces; a mesh needs"
            " both. Export the mesh with its faces."
        )
    v = _numbers(path, parsed.vertices, parsed.vertex_lines, 3)
    uv = _numbers(path, parsed.uv, parsed.uv_lines, 2)
    counts = np.asarray([len(words) for words in parsed.faces])
    corners = _corners(path, parsed, counts, (len(v), len(uv)))
    material = np.asarray(parsed.material, np.int32)
    owner = parsed.objects if any(parsed.objects) else parsed.groups
    parts = tuple(sorted({name for name in owner if name}))
    if part is not None:
        wanted = chosen_names(part, parts)
        selected = np.asarray([name in wanted for name in owner])
        if wanted - set(parts):
            there = ", ".join(parts)[:300] or "one mesh without a name"
            raise FormatError(f"{path}: no mesh '{part}'; there is {there}.")
        corners, counts, material = (
            corners[np.repeat(selected, counts)],
            counts[selected],
            material[selected],
        )
        # Vertices of other parts are dropped; the order is kept.
        kept, at = np.unique(corners[:, 0], return_inverse=True)
        v, corners = v[kept], np.column_stack([at.reshape(-1), corners[:, 1]])
        parts = tuple(sorted(wanted))
    table = corners[_split(counts, v[corners[:, 0]])]
    has_uv = len(uv) > 0 and bool((corners[:, 1] >= 0).all())
    looks = _looks(path, parsed.libraries)
    drawn = Polygons(
        counts.astype(np.int32),
        corners[:, 0].astype(np.int32),
        corners[:, 1].astype(np.int32) if has_uv else None,
        material,
        tuple(looks[n].material if n in looks else Material(n) for n in parsed.names),
    )
    chart, chart_faces = (uv, table[..., 1]) if has_uv else (None, None)
    if chart is not None and chart_faces is not None:
        moves = {k: looks[n].move for k, n in enumerate(parsed.names) if n in looks}
        chart, chart_faces, drawn = transform_uvs(
            chart, chart_faces, drawn, {k: m for k, m in moves.items() if m is not None}
        )
    return StaticMesh(v, table[..., 0], chart, chart_faces, drawn, len(counts), parts)


class _ObjData(NamedTuple):
    """The words of a file's lines, by keyword.

    Attributes:
        vertices: Words of each vertex.
        vertex_lines: Their line numbers, from 1.
        uv: Words of each texture coordinate.
        uv_lines: Their line numbers.
        faces: Words of each face's corners.
        face_lines: Their line numbers.
        before: Number of vertices and of texture coordinates before each face.
        material: Index of each face's material in ``names``; -1 without one.
        objects: Name of each face's object.
        groups: Name of each face's group.
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


def _parse_lines(text: str) -> _ObjData:
    parsed = _ObjData(*([] for _ in _ObjData._fields))
    places: dict[str, int] = {}
    used, current = -1, {"o": "", "g": ""}
    for n, line in enumerate(text.splitlines(), start=1):
        words = line.split("#")[0].split()
        if not words:
            continue
        key = words[0]
        if key == "v":
            parsed.vertices.append(words[1:4])
            parsed.vertex_lines.append(n)
        elif key == "vt":
            parsed.uv.append([*words[1:3], "0"][:2])
            parsed.uv_lines.append(n)
        elif key == "f":
            parsed.faces.append(words[1:])
            parsed.face_lines.append(n)
            parsed.before.append((len(parsed.vertices), len(parsed.uv)))
            parsed.material.append(used)
            parsed.objects.append(current["o"])
            parsed.groups.append(current["g"])
        elif key in current:
            current[key] = _after_keyword(line)
        elif key == "usemtl":
            used = places.setdefault(_after_keyword(line), len(places))
        elif key == "mtllib":
            parsed.libraries.append(_after_keyword(line))
    parsed.names.extend(places)
    return parsed


def _numbers(
    path: pathlib.Path, rows: list[list[str]], lines: list[int], count: int
) -> Float[np.ndarray, "rows numbers"]:
    """Parses the numbers of all lines at once; after an error line by line, to locate it."""
    try:
        flat = np.array([float(w) for words in rows for w in words])
    except ValueError:
        flat = np.zeros(0)
    # Squares of larger numbers may overflow float32.
    whole = all(len(words) == count for words in rows) and len(flat) == count * len(rows)
    if whole and (np.abs(flat) < _MAX_COORDINATE).all():
        return flat.reshape(-1, count)
    for n, words in zip(lines, rows, strict=True):
        try:
            values = [float(w) for w in words]
        except ValueError:
            raise FormatError(
                f"{path}:{n}: '{' '.join(words)[:60]}' aren't numbers. Export again."
            ) from None
        if len(values) != count or not all(abs(x) < _MAX_COORDINATE for x in values):
            raise FormatError(
                f"{path}:{n}: expected {count} finite numbers, got {values}. Export again."
            )
    return flat.reshape(-1, count)


def _corners(
    path: pathlib.Path, parsed: _ObjData, counts: Int[np.ndarray, " faces"], there: tuple[int, int]
) -> Int[np.ndarray, "corners 2"]:
    """Indices of every corner's vertex and texture coordinate, from 0; -1 without one."""
    words = [word for face in parsed.faces for word in face]
    face = np.repeat(np.arange(len(counts)), counts)

    def fail(corner: int, problem: str) -> FormatError:
        line, word = parsed.face_lines[face[corner]], words[corner][:40]
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
    before = np.asarray(parsed.before)[face]
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
        line = parsed.face_lines[int(few.argmax())]
        raise FormatError(f"{path}:{line}: a face of fewer than three vertices. Delete it.")
    out_of_range = (out[:, 0] < 0) | (out[:, 0] >= there[0]) | (out[:, 1] >= there[1])
    if out_of_range.any():
        k = int(out_of_range.argmax())
        raise FormatError(
            f"{path}:{parsed.face_lines[face[k]]}: a face refers to vertex {out[k, 0] + 1} or uv"
            f" {out[k, 1] + 1}, but there are {there[0]} and {there[1]}. Export the file again."
        )
    return out


def _split(
    counts: Int[np.ndarray, " faces"], points: Float[np.ndarray, "corners 3"]
) -> Int[np.ndarray, "triangles 3"]:
    """Splits faces into triangles of corner rows, quads along their shorter diagonal."""
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
    """A material, and its transform of texture coordinates."""

    material: Material
    move: UvTransform | None


def _looks(path: pathlib.Path, libraries: list[str]) -> dict[str, _Look]:
    """Materials of the material files beside a mesh; unreadable ones are ignored."""
    found: dict[str, _Look] = {}
    images: dict[str, Texture] = {}
    for library in dict.fromkeys(libraries):
        # Only files in the same folder: the name may be any path.
        file = path.parent / pathlib.PurePath(library.replace("\\", "/")).name
        if not is_file(file) or file.stat().st_size > _MAX_LIBRARY:
            continue
        add_inputs(file)
        name, colour, image, move = None, None, None, None
        for line in file.read_bytes().decode("utf-8", "replace").splitlines():
            words = line.split("#")[0].split()
            if words[:1] == ["newmtl"]:
                name, colour, image, move = _after_keyword(line), None, None, None
            elif words[:1] == ["Kd"]:
                with contextlib.suppress(ValueError):
                    colour = [float(w) for w in words[1:4]]
            elif words[:1] == ["map_Kd"] and words[1:]:
                named, move = _image(line)
                image = images.get(named)
                if image is None:
                    image = images[named] = texture_beside(file, named)
            if name is not None:
                # Most programs write a grey beside an image, but none multiplies the image by it.
                plain = image is None or image.data is None
                material = make_material(name, colour if plain else None, image)
                found[name] = _Look(material, None if plain else move)
    return found


def _image(line: str) -> tuple[str, UvTransform | None]:
    """Image and coordinate transform of a `map_Kd` line; names may contain spaces."""
    rest = _after_keyword(line)
    words = rest.split()
    parsed = {"s": [1.0, 1.0], "o": [0.0, 0.0]}
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
            if key in parsed and k < 2:
                parsed[key][k] = value
        if after >= len(words):
            break
        at = after
    return rest.split(None, at)[-1], make_uv_transform(parsed["s"], parsed["o"])


def _after_keyword(line: str) -> str:
    """The line after its first word; names may contain spaces."""
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
        polygons: Polygons to write instead of the triangles, with names of materials.
        library: Name of the material file beside it, see `write_materials`.
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
    used, names = -1, _material_names(polygons.materials)
    for start, count, which in zip(
        polygons.starts, polygons.counts, polygons.material, strict=True
    ):
        if which != used:
            # Without this line, faces without a material would inherit the previous one.
            lines.append(f"usemtl {names[which] if which >= 0 else _NONE}")
        used = which
        lines.append("f " + " ".join(words[start : start + count]))
    with atomic_write(path) as part:
        part.write_text("\n".join(lines) + "\n", encoding="utf-8")


def _material_names(materials: Sequence[Material]) -> list[str]:
    """A name of one line for each material, which no other has."""
    out: list[str] = []
    for m in materials:
        name = " ".join(visible(m.name).split()) or "material"
        same = (f"{name}_{k}" for k in itertools.count(2))
        out.append(name if name not in out else next(n for n in same if n not in out))
    return out


def write_materials(path: str | pathlib.Path, materials: Sequence[Material]) -> list[pathlib.Path]:
    """Writes an MTL of the materials' names and colours, and their images beside it.

    Returns:
        The files written, each atomically.
    """
    path = pathlib.Path(path)
    images = write_textures(path, [m.texture for m in materials])
    lines = []
    for m, name in zip(materials, _material_names(materials), strict=True):
        lines.append(f"newmtl {name}")
        image = None if m.texture is None else images.get(m.texture)
        colour = (1.0, 1.0, 1.0) if m.colour is None and image is not None else m.colour
        if colour is not None:
            lines.append("Kd " + " ".join(f"{c:.6g}" for c in colour))
        if image is not None:
            lines.append(f"map_Kd {image.name}")
    with atomic_write(path) as part:
        part.write_text("\n".join(lines) + "\n", encoding="utf-8")
    return [path, *images.values()]
