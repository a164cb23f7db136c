"""Inspects garment files: their properties, problems and the command that repairs them."""

import contextlib
import dataclasses
import pathlib
import shlex
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from scipy.spatial import KDTree

from ..body import Body, load_body
from ..errors import MeshError
from ..garment import (
    ELSEWHERE,
    HANGS,
    LONG,
    NEAREST,
    TEMPLATES,
    Garment,
    MeshHealth,
    Opening,
    Template,
    clearance,
    garment_of,
    guess_template,
    hangs_off,
    locate_on_body,
    mesh_health,
    most_alike,
    parse_wear,
    place_mesh,
    template,
)
from ..geometry import TriMesh, make_mesh, vertex_normals, visible_skin
from ..io import StaticMesh, mesh_name, read_mesh
from ..uv import hit_rate

# Share of vertices inside [1], median edge [m] and share of missing rays [1] worth reporting.
_INSIDE, _FINE, _MAX_MISSED = 0.02, 0.003, 0.1
# Cloth is over skin up to this distance, and this much aside of the normal [m]; share of the skin
# that something worn covers, and share of visible skin worth reporting [1]; size of the pictures.
_OVER, _ASIDE, _BARE, _SHOWS, _PIXELS = 0.15, 0.02, 0.005, 0.01, 256
# Smallest extent of a garment [m]; largest numbers of meshes, faces and vertices to examine.
_MIN_EXTENT, _MAX_PARTS, _MOST_FACES, _MOST_VERTICES = 0.25, 20, 5000, 10_000
# A better placement has to bring a garment nearer to the skin by this factor; below this hit
# rate, a garment far from the skin may be misplaced [1].
_DISTANCE_RATIO, _MIN_HIT_RATE = 0.85, 0.5


@dataclasses.dataclass(frozen=True, kw_only=True)
class Inspection:
    """Result of inspecting a garment file.

    Attributes:
        path: The file.
        unit: Its unit; None if no unit and up axis places it on the body.
        up: Its up axis, likewise.
        size: Its extent along its own axes, in its own unit.
        health: Statistics of the mesh in metres, or in its own unit if `unit` is None.
        polygons: Number of faces before triangulation.
        distance: Median distance to the skin [m].
        farthest: Largest distance to the skin [m].
        hangs: Smallest distance of its highest tenth from the skin [m]; a garment that rests
            on shoulders or hips touches the skin there.
        inside: Share of vertices inside the body or within 3 mm of it.
        outward: Share of faces whose normals point away from the body.
        template: Template that dresses it, guessed from what it covers.
        apart: Distance from each template on the body [m]: the mean distance from vertices of
            one mesh to the nearest of the other, the larger of both directions.
        hit_rate: Share of vertices whose ray meets the body.
        openings: Openings and the limbs that pass through them, longest first.
        covered: Share of the skin that it covers.
        visible_skin: Share of a dressed person at rest that shows skin which came through, see
            `geometry.visible_skin`.
        problems: Problems, a sentence each.
        notes: Remarks that need no action.
        command: The command that repairs it, or lists the garments of a file with several; None
            if nothing has to be done.
        several: Whether the file holds several garments.
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
    openings: tuple[Opening, ...]
    covered: float
    visible_skin: float
    problems: tuple[str, ...]
    notes: tuple[str, ...]
    command: str | None
    several: bool = False

    @property
    def verdict(self) -> str:
        """``ready``, or the next step."""
        if not self.problems:
            limbs = sorted({limb for o in self.openings for limb in o.limbs})
            through = f"{', '.join(limbs)} pass through its openings and " if limbs else ""
            return (
                f"ready: it can be worn as it is; {through}it covers"
                f" {100 * self.covered:.0f} % of the skin."
            )
        return f"{'inspect each' if self.several else 'repair it first'}: {self.command}"


def inspect_garment(path: str | pathlib.Path, *, body: Body | None = None) -> Inspection:
    """Inspects a garment file without changing it.

    Args:
        path: A file that `read_mesh` reads.
        body: The body; the built-in one by default.

    Returns:
        The findings, and the command that repairs it.

    Raises:
        FormatError: The file can't be read.
    """
    item = parse_wear(path)
    path = pathlib.Path(item.name)
    body = load_body() if body is None else body
    raw = read_mesh(path)
    skin = body.rest_mesh()
    try:
        placement = place_mesh(item, raw, body)
    except MeshError as error:
        return _misplaced(path, raw, body, str(error).partition(": ")[2])
    v = placement.vertices
    mesh = make_mesh(v, raw.faces, raw.uv, raw.uv_faces)
    health = mesh_health(mesh)
    distance, _ = clearance(skin, np.asarray(v, np.float32))
    inside = float(np.mean(distance < NEAREST))
    hangs = hangs_off(v, distance)
    some = np.unique(np.linspace(0, len(raw.faces) - 1, _MOST_FACES).astype(int))
    corner = np.asarray(v)[raw.faces[some]]
    normal = np.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0])
    _, away = clearance(skin, corner.mean(axis=1).astype(np.float32))
    outward = float(np.mean(np.einsum("fi,fi->f", normal, away) > 0))
    garment, _ = garment_of(path, raw, placement, item.template, body)
    rate = hit_rate(garment, body=body, rest=body.rest_vertices(body.default_shape()))
    found = _Findings([], [], [])
    _report_mesh(found, health, outward)
    _report_placement(found, raw, distance, inside, rate, body)
    _report_size(found, health, hangs)
    outfit = _report_parts(found, path, raw, body)
    _report_images(found, raw)
    found.notes.extend(placement.notes)
    covered = covered_share(garment, skin)
    worn = np.asarray(garment.mesh.vertices), np.asarray(garment.mesh.faces)
    seen = visible_skin(
        np.asarray(skin.vertices), np.asarray(skin.faces), [worn], pixels=_PIXELS
    ).share
    _report_worn(found, placement.openings, covered, seen)
    if health.components > 1:
        found.notes.append(f"{health.components} disconnected parts: each moves independently.")
    if rate < 1 - _MAX_MISSED:
        found.notes.append(
            f"{100 * (1 - rate):.0f} % of the vertices' rays miss the body; these vertices are"
            " bound to the closest skin."
        )
    return Inspection(
        path=path,
        unit=placement.unit,
        up=placement.up,
        size=_size(raw),
        health=health,
        polygons=raw.count,
        distance=float(np.median(np.abs(distance))),
        farthest=float(distance.max()),
        hangs=hangs,
        inside=inside,
        outward=outward,
        template=garment.template,
        apart=_template_distances(v),
        hit_rate=rate,
        openings=placement.openings,
        covered=covered,
        visible_skin=seen,
        problems=tuple(found.problems),
        notes=tuple(found.notes),
        command=outfit or (_command(path, found.options) if found.problems else None),
        several=outfit is not None,
    )


class _Findings(NamedTuple):
    """Findings about a garment, and the options of ``physxnet fit`` that repair it."""

    problems: list[str]
    notes: list[str]
    options: list[str]


def _size(raw: StaticMesh) -> tuple[float, ...]:
    return tuple(float(s) for s in np.ptp(raw.vertices, axis=0))


def _misplaced(path: pathlib.Path, raw: StaticMesh, body: Body, problem: str) -> Inspection:
    """The inspection of a mesh that no unit and up axis places on the body."""
    # Suggests the template whose place it fits best; the user may choose another.
    nearest, _, _ = most_alike(raw, [template(t) for t in TEMPLATES], body)
    health = mesh_health(make_mesh(raw.vertices, raw.faces, raw.uv, raw.uv_faces))
    nan = float("nan")
    return Inspection(
        path=path,
        unit=None,
        up=None,
        size=_size(raw),
        health=health,
        polygons=raw.count,
        distance=nan,
        farthest=nan,
        hangs=nan,
        inside=nan,
        outward=nan,
        template=None,
        apart={},
        hit_rate=nan,
        openings=(),
        covered=nan,
        visible_skin=nan,
        problems=(problem,),
        notes=(),
        command=_command(path, [f"--like {nearest}"]),
    )


def _report_mesh(found: _Findings, health: MeshHealth, outward: float) -> None:
    counts = (
        (health.coincident_vertices, "vertices that coincide with another one: cloth tears there"),
        (health.degenerate_faces, "faces of zero area"),
        (health.duplicate_faces, "faces that occur twice"),
        (health.unused_vertices, "vertices that no face uses"),
        (health.inconsistent_edges, "edges whose faces have inconsistent winding"),
    )
    found.problems.extend(f"{n:,} {what}." for n, what in counts if n)
    if outward < 0.5:
        found.problems.append(
            f"its faces point inwards ({100 * outward:.0f} % point away from the body)."
        )
    if health.non_manifold_edges:
        found.notes.append(
            f"{health.non_manifold_edges:,} edges have more than two faces; they are kept, and bend"
            " without resistance."
        )


def _report_placement(
    found: _Findings,
    raw: StaticMesh,
    distance: np.ndarray,
    inside: float,
    hit_rate: float,
    body: Body,
) -> None:
    if inside > _INSIDE:
        found.problems.append(f"{100 * inside:.1f} % of its vertices lie in the body or on it.")
    loose = hit_rate < _MIN_HIT_RATE and float(np.median(np.abs(distance))) > LONG
    if inside > ELSEWHERE or loose:
        # It may be reversed or misplaced: lifting it out of the body would ruin it.
        better = _better_placement(raw, distance, body)
        if better is not None:
            name, description = better
            found.problems.append(f"it lies or faces elsewhere than a {name}: {description}")
            found.options.append(f"--like {name}")


def covered_share(garment: Garment, skin: TriMesh) -> float:
    """Share of the skin's area that cloth lies over, at most `_OVER` away."""
    faces = np.asarray(skin.faces)
    points = np.asarray(skin.vertices)
    normals = vertex_normals(points, faces)
    tree = KDTree(np.asarray(garment.mesh.vertices))
    distance, nearest = tree.query(points)
    height = np.einsum("vc,vc->v", tree.data[nearest] - points, normals)
    lateral = np.sqrt(np.maximum(distance**2 - height**2, 0.0))
    over = (height > 0.0) & (distance < _OVER) & (lateral < _ASIDE + 0.7 * height)
    corner = points[faces]
    area = np.linalg.norm(
        np.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0]), axis=1
    )
    return float(np.sum(area * over[faces].mean(axis=1)) / area.sum())


def _report_worn(
    found: _Findings, openings: Sequence[Opening], covered: float, seen: float
) -> None:
    """Reports openings that no limb passes through, and skin that comes through."""
    if covered < _BARE:
        found.problems.append(f"it covers {100 * covered:.1f} % of the skin: it isn't worn.")
    if seen > _SHOWS:
        found.problems.append(f"{100 * seen:.1f} % of what is seen of it is skin: cloth is inside.")
    empty = [o for o in openings if not o.limbs]
    if empty and len(empty) < len(openings):
        around = ", ".join(f"{o.around:.2f}" for o in empty)
        found.notes.append(f"no limb passes through openings of {around} m around.")
    elif empty and len(openings) > 1:
        found.problems.append("no limb passes through any of its openings: it isn't worn.")


def _report_size(found: _Findings, health: MeshHealth, hangs: float) -> None:
    if hangs > HANGS:
        found.problems.append(
            f"its top stays {1e3 * hangs:.0f} mm off the skin, where nothing holds it up."
        )
        found.options.append("--drape")
    if health.longest_edge > LONG:
        found.problems.append(
            f"edges up to {1e3 * health.longest_edge:.0f} mm: too long to fold, and they cut"
            " through limbs."
        )
        found.options.append("--edge-length 20")
    elif health.median_edge < _FINE:
        found.notes.append(
            f"edges of {1e3 * health.median_edge:.1f} mm: finer than any map; `physxnet fit"
            " --decimate 8` would make it faster."
        )


def _report_parts(found: _Findings, path: pathlib.Path, raw: StaticMesh, body: Body) -> str | None:
    """Reports the meshes of a file; returns the command that inspects each, if needed."""
    if len(raw.parts) < 2:
        return None
    kinds = _kinds(path, raw.parts, body)
    if len(set(kinds.values())) > 1:
        description = ", ".join(f"{name} is dressed by {kind}" for name, kind in kinds.items())
        found.problems.append(
            f"it contains several garments: {description}. `dress` wears each; inspect them"
            " separately."
        )
        return f"physxnet inspect {' '.join(shlex.quote(f'{path}#{name}') for name in kinds)}"
    found.notes.append(
        f"made of {len(raw.parts)} meshes ({', '.join(raw.parts)[:200]}): `{path}#NAME`"
        " selects one of them."
    )
    return None


def _report_images(found: _Findings, raw: StaticMesh) -> None:
    looks = () if raw.polygons is None else raw.polygons.materials
    images = [m.texture for m in looks if m.texture is not None]
    lost = () if raw.polygons is None else raw.polygons.lost_images
    if lost:
        found.notes.append(
            f"images that can't be used: {', '.join(lost)[:200]}. Only PNG and JPEG in the file's"
            " folder are read."
        )
    elif images and raw.uv is None:
        found.notes.append("its images can't be used: faces have no texture coordinates.")


def _kinds(path: pathlib.Path, parts: tuple[str, ...], body: Body) -> dict[str, Template]:
    """Template of each mesh of a file that is large enough and on the body."""
    found: dict[str, Template] = {}
    for name in parts[:_MAX_PARTS]:
        mesh = read_mesh(f"{path}#{name}")
        with contextlib.suppress(MeshError):
            v = locate_on_body(path, mesh, body).vertices
            if np.ptp(v, axis=0).max() > _MIN_EXTENT:
                found[name] = guess_template(v, mesh.faces)
    return found


def _better_placement(
    raw: StaticMesh, distance: np.ndarray, body: Body
) -> tuple[Template, str] | None:
    """A template whose place a garment fits better than its own, and how; None if there is none."""
    name, placed, description = most_alike(raw, [template(t) for t in TEMPLATES], body)
    some = np.unique(np.linspace(0, len(distance) - 1, _MOST_VERTICES).astype(int))
    distance = distance[some]
    there, _ = clearance(body.rest_mesh(), np.asarray(placed.vertices, np.float32)[some])
    now, then = (float(np.mean(x < NEAREST)) for x in (distance, there))
    nearer = float(np.mean(np.abs(there))) < _DISTANCE_RATIO * float(np.mean(np.abs(distance)))
    better = then <= max(0.7 * now, _INSIDE) if nearer else then <= 0.25 * now and now > ELSEWHERE
    if not better:
        return None
    return (
        name,
        f"{description.rstrip('.')}, there {100 * then:.1f} % of its vertices are in the body.",
    )


def _template_distances(vertices: np.ndarray) -> dict[Template, float]:
    out: dict[Template, float] = {}
    for name in TEMPLATES:
        other = np.asarray(template(name).mesh.vertices)
        ways = ((vertices, other), (other, vertices))
        out[name] = max(float(KDTree(a).query(b)[0].mean()) for a, b in ways)
    return out


def _command(path: pathlib.Path, options: list[str]) -> str:
    out = f"{mesh_name(path)}_fitted.obj"
    words = ["physxnet", "fit", shlex.quote(str(path)), *options, "-o", shlex.quote(out)]
    return " ".join(words)
