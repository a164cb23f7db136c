"""Wavefront OBJ: polygons, texture coordinates, materials, several objects in a file."""

import contextlib
import pathlib
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
    vertices: list[list[float]] = []
    uv: list[list[float]] = []
    polygons: list[list[tuple[int, int]]] = []
    where: list[int] = []
    names: dict[str, int] = {}
    used, material = -1, list[int]()
    owners: dict[str, list[str]] = {"o": [], "g": []}
    current = {"o": "", "g": ""}
    libraries: list[str] = []
    for n, line in enumerate(blob.decode("utf-8", "replace").splitlines(), start=1):
        words = line.split("#")[0].split()
        if not words:
            continue
        if words[0] == "v":
            vertices.append(_floats(path, n, words[1:4], 3))
        elif words[0] == "vt":
            uv.append(_floats(path, n, [*words[1:3], "0"][:2], 2))
        elif words[0] == "f":
            polygons.append([_corner(path, n, w, len(vertices), len(uv)) for w in words[1:]])
            where.append(n)
            material.append(used)
            for kind, owner in owners.items():
                owner.append(current[kind])
            if len({c[0] for c in polygons[-1]}) < 3:
                raise FormatError(f"{path}:{n}: a face of fewer than three vertices. Delete it.")
        elif words[0] in current:
            current[words[0]] = _rest(line)
        elif words[0] == "usemtl":
            used = names.setdefault(_rest(line), len(names))
        elif words[0] == "mtllib":
            libraries.append(_rest(line))
    if not vertices or not polygons:
        raise FormatError(
            f"{path}: {len(vertices)} vertices and {len(polygons)} faces; a mesh needs both."
            " Export the mesh with its faces."
        )
    v = np.asarray(vertices)
    for n, polygon in zip(where, polygons, strict=True):
        for a, t in polygon:
            if not 0 <= a < len(v) or t >= len(uv):
                raise FormatError(
                    f"{path}:{n}: a face names vertex {a + 1} or uv {t + 1}, but there"
                    f" are {len(v)} and {len(uv)}. Export the file again."
                )
    owner = owners["o"] if len(set(owners["o"])) > 1 or any(owners["o"]) else owners["g"]
    parts = tuple(sorted({name for name in owner if name}))
    if part is not None:
        rows = [k for k, name in enumerate(owner) if name == part]
        if not rows:
            there = ", ".join(parts)[:300] or "one mesh without a name"
            raise FormatError(f"{path}: no mesh '{part}'; there is {there}.")
        polygons, material = [polygons[k] for k in rows], [material[k] for k in rows]
        # The others' vertices belong to no face any more; the order stays.
        kept, at = np.unique([c[0] for p in polygons for c in p], return_inverse=True)
        v, new = v[kept], iter(at.tolist())
        polygons = [[(next(new), t) for _, t in p] for p in polygons]
        parts = (part,)
    corners = [c for p in polygons for c in _split(p, v)]
    table = np.asarray(corners)
    has_uv = bool(uv) and bool((table[..., 1] >= 0).all())
    looks = _looks(path, libraries)
    drawn = _drawn(polygons, material, names, looks, textured=has_uv)
    chart, chart_faces = (np.asarray(uv), table[..., 1]) if has_uv else (None, None)
    if chart is not None and chart_faces is not None:
        moves = {k: looks[n].move for n, k in names.items() if n in looks}
        chart, chart_faces, drawn = moved_charts(
            chart, chart_faces, drawn, {k: m for k, m in moves.items() if m is not None}
        )
    return StillMesh(v, table[..., 0], chart, chart_faces, drawn, len(polygons), parts)


def _drawn(
    polygons: list[list[tuple[int, int]]],
    material: list[int],
    names: dict[str, int],
    looks: dict[str, "_Look"],
    *,
    textured: bool,
) -> Polygons:
    corners = np.asarray([c for p in polygons for c in p], np.int32)
    return Polygons(
        np.asarray([len(p) for p in polygons], np.int32),
        corners[:, 0],
        corners[:, 1] if textured else None,
        np.asarray(material, np.int32),
        tuple(looks[n].material if n in looks else Material(n) for n in names),
    )


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


def _floats(path: pathlib.Path, n: int, words: list[str], count: int) -> list[float]:
    try:
        out = [float(w) for w in words]
    except ValueError:
        raise FormatError(
            f"{path}:{n}: '{' '.join(words)[:60]}' aren't numbers. Export again."
        ) from None
    # Beyond that their squares aren't finite in float32.
    if len(out) != count or not (np.abs(out) < 1e18).all():
        raise FormatError(f"{path}:{n}: expected {count} finite numbers, got {out}. Export again.")
    return out


def _corner(path: pathlib.Path, n: int, word: str, vertices: int, uvs: int) -> tuple[int, int]:
    parts = word.split("/")
    try:
        a = int(parts[0])
        t = int(parts[1]) if len(parts) > 1 and parts[1] else 0
    except ValueError:
        raise FormatError(f"{path}:{n}: '{word[:40]}' isn't a face corner. Export again.") from None
    if a == 0 or (len(parts) > 1 and parts[1] and t == 0) or t < -uvs:
        raise FormatError(f"{path}:{n}: '{word[:40]}' isn't an index from 1. Export again.")
    a = a - 1 if a > 0 else vertices + a
    t = t - 1 if t > 0 else (uvs + t if t < 0 else -1)
    return a, t


def _split(polygon: list[tuple[int, int]], v: np.ndarray) -> list[list[tuple[int, int]]]:
    if len(polygon) == 4:
        p = v[[c[0] for c in polygon]]
        if np.sum((p[0] - p[2]) ** 2) > np.sum((p[1] - p[3]) ** 2):
            polygon = polygon[1:] + polygon[:1]
    return [[polygon[0], polygon[k], polygon[k + 1]] for k in range(1, len(polygon) - 1)]
