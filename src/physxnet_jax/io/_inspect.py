"""What a garment file is like, and what is wrong with it."""

import contextlib
import dataclasses
import pathlib
import shlex
from typing import NamedTuple

import numpy as np
from scipy.spatial import KDTree

from ..body import Body, load_body
from ..errors import MeshError
from ..garment import (
    TEMPLATES,
    Garment,
    MeshHealth,
    Template,
    clearance,
    mesh_health,
    template,
)
from ..geometry import TriMesh, make_mesh
from ..uv import bind, garment_map_rows, make_atlas
from ._clip import StillMesh
from ._garment import (
    ELSEWHERE,
    HANGS,
    LONG,
    NEAREST,
    guess_template,
    hangs_off,
    load_garment,
)
from ._like import place_like
from ._mesh_file import mesh_name, read_mesh
from ._place import place_on_body

# Shares and lengths beyond which a garment is worth a word [1], [m].
_INSIDE, _FINE, _MISSED = 0.02, 0.003, 0.1
# How long a garment is at least, and how many meshes of a file are looked at [m].
_GARMENT, _MOST_PARTS = 0.25, 20
# How much nearer to the skin a garment that lies elsewhere has to be where it belongs, and the
# share of its rays below which one that is far from the skin may lie elsewhere [1].
_NEARER, _UNBOUND = 0.85, 0.5


@dataclasses.dataclass(frozen=True)
class Inspection:
    """What was found out about a garment file.

    Attributes:
        path: The file.
        unit: Its unit, or None if no unit and axis puts it on the body.
        up: Its up axis, likewise.
        size: What it measures along its own axes, in its own unit.
        health: What the mesh is like, in metres (in its own unit without one).
        polygons: Faces before they were cut into triangles.
        distance: Median distance to the skin [m].
        farthest: Largest distance to the skin [m].
        hangs: How far the highest tenth of it stays from the skin [m]: what rests on
            shoulders or hips touches them there.
        inside: Share of vertices inside the body or within 3 mm of it.
        outward: Share of faces that look away from the body.
        template: The template that dresses it: by what it covers.
        apart: How far it and each template lie apart on the body [m]: the mean distance of
            vertices of one from the nearest of the other, of the two ways the larger.
        hit_rate: Share of vertices whose ray meets the body.
        problems: What is wrong, a sentence each; what can't be mended first.
        notes: What is good to know but harms nothing.
        command: The command that mends it; None if nothing has to be.
    """

    path: pathlib.Path
    unit: str | None
    up: str | None
    size: tuple[float, ...]
    health: MeshHealth
    polygons: int
    distance: float
    farthest: float
    hangs: float
    inside: float
    outward: float
    template: Template | None
    apart: dict[Template, float]
    hit_rate: float
    problems: tuple[str, ...]
    notes: tuple[str, ...]
    command: str | None

    @property
    def verdict(self) -> str:
        """``ready``, or what to do."""
        if not self.problems:
            return "ready: it can be worn as it is."
        several = (self.command or "").startswith("physxnet inspect")
        return f"{'look at each' if several else 'mend it first'}: {self.command}"


def inspect_garment(path: str | pathlib.Path, *, body: Body | None = None) -> Inspection:
    """Looks at a garment file and changes nothing.

    Args:
        path: A file that `read_mesh` reads.
        body: The body; the built-in one by default.

    Returns:
        What was found, and the command that mends it.

    Raises:
        FormatError: A file that can't be read.
    """
    path = pathlib.Path(path)
    body = load_body() if body is None else body
    raw = read_mesh(path)
    skin = body.rest_mesh()
    try:
        v, unit, up, posed = place_on_body(path, raw.vertices, body, raw.faces)
    except MeshError as error:
        return _nowhere(path, raw, skin, str(error).partition(": ")[2])
    mesh = make_mesh(v, raw.faces, raw.uv, raw.uv_faces)
    health = mesh_health(mesh)
    distance, _ = clearance(skin, np.asarray(v, np.float32))
    inside = float(np.mean(distance < NEAREST))
    hangs = hangs_off(v, distance)
    corner = np.asarray(v)[raw.faces]
    normal = np.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0])
    _, away = clearance(skin, corner.mean(axis=1).astype(np.float32))
    outward = float(np.mean(np.einsum("fi,fi->f", normal, away) > 0))
    garment, _ = load_garment(path, body=body)
    hit_rate = _hit_rate(body, garment)
    found = _Found([], [], [])
    _tell_mesh(found, health, outward)
    _tell_place(found, raw, distance, inside, hit_rate, skin)
    _tell_size(found, health, hangs)
    outfit = _tell_parts(found, path, raw, body)
    _tell_images(found, raw)
    if posed:
        found.notes.append(
            "made for a T-pose: worn as it is, its sleeves are turned down with the arms."
        )
    if health.components > 1:
        found.notes.append(f"{health.components} parts that nothing joins: each moves by itself.")
    if hit_rate < 1 - _MISSED:
        found.notes.append(
            f"{100 * (1 - hit_rate):.0f} % of the vertices' rays miss the body; they are bound to"
            " the closest skin."
        )
    return Inspection(
        path,
        unit,
        up,
        _size(raw),
        health,
        raw.count,
        float(np.median(np.abs(distance))),
        float(distance.max()),
        hangs,
        inside,
        outward,
        garment.template,
        _apart(v),
        hit_rate,
        tuple(found.problems),
        tuple(found.notes),
        outfit or (_command(path, found.options) if found.problems else None),
    )


class _Found(NamedTuple):
    """What is told of a garment, and the options of `fit` that mend it."""

    problems: list[str]
    notes: list[str]
    options: list[str]


def _size(raw: StillMesh) -> tuple[float, ...]:
    return tuple(float(s) for s in np.ptp(raw.vertices, axis=0))


def _nowhere(path: pathlib.Path, raw: StillMesh, skin: TriMesh, problem: str) -> Inspection:
    """What can be said of a mesh that no unit and axis puts on the body."""
    # The template whose place it fills best; the user may know better.
    nearest = min(TEMPLATES, key=lambda t: place_like(raw.vertices, template(t), skin)[2])
    health = mesh_health(make_mesh(raw.vertices, raw.faces, raw.uv, raw.uv_faces))
    nan = float("nan")
    command = _command(path, [f"--like {nearest}"])
    return Inspection(
        path, None, None, _size(raw), health, raw.count, nan, nan, nan, nan, nan, None, {}, nan,
        (problem,), (), command,
    )  # fmt: skip


def _tell_mesh(found: _Found, health: MeshHealth, outward: float) -> None:
    counts = (
        (health.coincident_vertices, "vertices that coincide with another one: cloth tears there"),
        (health.degenerate_faces, "faces without an area"),
        (health.duplicate_faces, "faces that are there twice"),
        (health.unused_vertices, "vertices that no face uses"),
        (health.inconsistent_edges, "edges whose faces run in different senses"),
    )
    found.problems.extend(f"{n:,} {what}." for n, what in counts if n)
    if outward < 0.5:
        found.problems.append(
            f"its faces look inwards ({100 * outward:.0f} % look away from the body)."
        )
    if health.non_manifold_edges:
        found.notes.append(
            f"{health.non_manifold_edges:,} edges have more than two faces; they are kept, and fold"
            " without resistance."
        )


def _tell_place(
    found: _Found,
    raw: StillMesh,
    distance: np.ndarray,
    inside: float,
    hit_rate: float,
    skin: TriMesh,
) -> None:
    if inside > _INSIDE:
        found.problems.append(f"{100 * inside:.1f} % of its vertices lie in the body or on it.")
    loose = hit_rate < _UNBOUND and float(np.median(np.abs(distance))) > LONG
    if inside > ELSEWHERE or loose:
        # Worn the wrong way round or in another place: lifting it out would ruin it.
        better = _elsewhere(raw.vertices, distance, skin)
        if better is not None:
            name, told = better
            found.problems.append(f"it lies or faces elsewhere than a {name}: {told}")
            found.options.append(f"--like {name}")


def _tell_size(found: _Found, health: MeshHealth, hangs: float) -> None:
    if hangs > HANGS:
        found.problems.append(
            f"its top stays {1e3 * hangs:.0f} mm off the skin, where nothing holds it up."
        )
        found.options.append("--drape")
    if health.longest_edge > LONG:
        found.problems.append(
            f"edges up to {1e3 * health.longest_edge:.0f} mm: too long to fold, and they cut"
            " corners off limbs."
        )
        found.options.append("--edge-length 20")
    elif health.median_edge < _FINE:
        found.notes.append(
            f"edges of {1e3 * health.median_edge:.1f} mm: finer than any map here; `physxnet fit"
            " --decimate 8` would make it quicker."
        )


def _tell_parts(found: _Found, path: pathlib.Path, raw: StillMesh, body: Body) -> str | None:
    """Says of what meshes the file consists; the command that looks at each, if it has to be."""
    if len(raw.parts) < 2:
        return None
    kinds = _kinds(path, raw.parts, body)
    if len(set(kinds.values())) > 1:
        told = ", ".join(f"{name} is dressed by {kind}" for name, kind in kinds.items())
        found.problems.append(f"it holds several garments, which are worn apart: {told}.")
        return f"physxnet inspect {' '.join(shlex.quote(f'{path}#{name}') for name in kinds)}"
    found.notes.append(
        f"made of {len(raw.parts)} meshes ({', '.join(raw.parts)[:200]}): `{path}#NAME`"
        " takes one of them."
    )
    return None


def _tell_images(found: _Found, raw: StillMesh) -> None:
    looks = () if raw.polygons is None else raw.polygons.materials
    images = [m.texture for m in looks if m.texture is not None]
    lost = sorted({t.name for t in images if t.data is None})
    if lost:
        found.notes.append(
            f"images that won't be put on it: {', '.join(lost)[:200]}. PNG or JPEG in the file's"
            " folder are."
        )
    elif images and raw.uv is None:
        found.notes.append("its images won't be put on it: faces without texture coordinates.")


def _kinds(path: pathlib.Path, parts: tuple[str, ...], body: Body) -> dict[str, Template]:
    """What each mesh of a file would be dressed by, as far as it is large and on the body."""
    found: dict[str, Template] = {}
    for name in parts[:_MOST_PARTS]:
        mesh = read_mesh(f"{path}#{name}")
        with contextlib.suppress(MeshError):
            v, *_ = place_on_body(path, mesh.vertices, body, mesh.faces)
            if np.ptp(v, axis=0).max() > _GARMENT:
                found[name] = guess_template(v, mesh.faces)
    return found


def _elsewhere(
    vertices: np.ndarray, distance: np.ndarray, skin: TriMesh
) -> tuple[Template, str] | None:
    """The template whose place a garment fits better than where it is, and how it fits there."""
    tried = {name: place_like(vertices, template(name), skin) for name in TEMPLATES}
    name: Template = min(TEMPLATES, key=lambda n: tried[n][2])
    placed, told, _ = tried[name]
    there, _ = clearance(skin, np.asarray(placed, np.float32))
    now, then = (float(np.mean(x < NEAREST)) for x in (distance, there))
    nearer = float(np.mean(np.abs(there))) < _NEARER * float(np.mean(np.abs(distance)))
    better = then <= max(0.7 * now, _INSIDE) if nearer else then <= 0.25 * now and now > ELSEWHERE
    if not better:
        return None
    return name, f"{told.rstrip('.')}, it has {100 * then:.1f} % of its vertices in the body."


def _apart(vertices: np.ndarray) -> dict[Template, float]:
    out: dict[Template, float] = {}
    for name in TEMPLATES:
        other = np.asarray(template(name).mesh.vertices)
        ways = ((vertices, other), (other, vertices))
        out[name] = max(float(KDTree(a).query(b)[0].mean()) for a, b in ways)
    return out


def _hit_rate(body: Body, garment: Garment) -> float:
    rest = body.rest_vertices(body.default_shape())
    atlas = make_atlas(32)
    valid = garment_map_rows(atlas, body, rest, template(garment.template)).valid
    return float(bind(atlas, body, rest, garment, valid).hit_rate)


def _command(path: pathlib.Path, options: list[str]) -> str:
    out = path.with_name(f"{mesh_name(path)}_fitted.obj")
    words = ["physxnet", "fit", shlex.quote(str(path)), *options, "-o", shlex.quote(str(out))]
    return " ".join(words)
