"""What a garment file is like, what is wrong with it, and the same made wearable."""

import dataclasses
import pathlib
import shlex
from collections.abc import Callable

import numpy as np
from scipy.spatial import KDTree

from ..body import Body, load_body
from ..errors import MeshError
from ..garment import (
    TEMPLATES,
    Garment,
    MeshHealth,
    Template,
    clean,
    clearance,
    decimate,
    lift_out,
    mesh_health,
    orient,
    subdivide,
    template,
    weld,
)
from ..geometry import make_mesh
from ..uv import bind, garment_map_rows, make_atlas
from ._drape import drape
from ._garment import (
    HANGS,
    LONG,
    NEAREST,
    carried,
    guess_template,
    hangs_off,
    load_garment,
    place_on_body,
)
from ._like import place_like
from ._mesh_file import mesh_name, read_mesh
from ._obj import write_obj

# Shares and lengths beyond which a garment is worth a word [1], [m].
_INSIDE, _FINE, _MISSED = 0.02, 0.003, 0.1
# Share inside the body from which a garment may lie elsewhere, and how much nearer to the skin
# it has to be where it belongs.
_ELSEWHERE, _NEARER = 0.1, 0.85
# Lifting ends a little short of what it aims at.
_LIFT = 1.3


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
        return f"mend it first: {self.command}"


def inspect_garment(path: str | pathlib.Path, *, body: Body | None = None) -> Inspection:
    """Looks at a garment file and changes nothing.

    Args:
        path: A file that `read_mesh` reads.
        body: The body; the built-in one by default.

    Raises:
        FormatError: A file that can't be read.
    """
    path = pathlib.Path(path)
    body = load_body() if body is None else body
    raw = read_mesh(path)
    size = tuple(float(s) for s in np.ptp(raw.vertices, axis=0))
    skin = body.rest_mesh()
    problems, notes, options = [], [], []
    try:
        v, unit, up = place_on_body(path, raw.vertices, body)
    except MeshError as error:
        problems.append(str(error).partition(": ")[2])
        # The template whose place it fills best; the user may know better.
        nearest = min(TEMPLATES, key=lambda t: place_like(raw.vertices, template(t), skin)[2])
        options.append(f"--like {nearest}")
        health = mesh_health(make_mesh(raw.vertices, raw.faces, raw.uv, raw.uv_faces))
        nan = float("nan")
        command = _command(path, options)
        return Inspection(
            path, None, None, size, health, raw.polygons, nan, nan, nan, nan, nan, None, {}, nan,
            tuple(problems), (), command,
        )  # fmt: skip
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
    counts = (
        (health.coincident_vertices, "vertices that coincide with another one: cloth tears there"),
        (health.degenerate_faces, "faces without an area"),
        (health.duplicate_faces, "faces that are there twice"),
        (health.unused_vertices, "vertices that no face uses"),
        (health.inconsistent_edges, "edges whose faces run in different senses"),
    )
    problems += [f"{n:,} {what}." for n, what in counts if n]
    if outward < 0.5:
        problems.append(f"its faces look inwards ({100 * outward:.0f} % look away from the body).")
    if health.non_manifold_edges:
        notes.append(
            f"{health.non_manifold_edges:,} edges have more than two faces; they are kept, and fold"
            " without resistance."
        )
    if inside > _INSIDE:
        problems.append(f"{100 * inside:.1f} % of its vertices lie in the body or on it.")
    if inside > _ELSEWHERE:
        # Worn the wrong way round or at another height: lifting it out would ruin it.
        placed, told, _ = place_like(raw.vertices, template(garment.template), skin)
        there, _ = clearance(skin, np.asarray(placed, np.float32))
        nearer = float(np.mean(np.abs(there))) < _NEARER * float(np.mean(np.abs(distance)))
        share = float(np.mean(there < NEAREST))
        if nearer and share < 0.7 * inside:
            problems.append(
                f"it lies or faces elsewhere than a {garment.template}: {told.rstrip('.')}, it has"
                f" {100 * share:.1f} % there."
            )
            options.append(f"--like {garment.template}")
    if hangs > HANGS:
        problems.append(
            f"its top stays {1e3 * hangs:.0f} mm off the skin, where nothing holds it up."
        )
        options.append("--drape")
    if health.longest_edge > LONG:
        problems.append(
            f"edges up to {1e3 * health.longest_edge:.0f} mm: too long to fold, and they cut"
            " corners off limbs."
        )
        options.append("--edge-length 20")
    elif health.median_edge < _FINE:
        notes.append(
            f"edges of {1e3 * health.median_edge:.1f} mm: finer than any map here; `physxnet fit"
            " --decimate 8` would make it quicker."
        )
    if len(raw.parts) > 1:
        notes.append(
            f"made of {len(raw.parts)} meshes ({', '.join(raw.parts)[:200]}): `{path}#NAME`"
            " takes one of them."
        )
    if health.components > 1:
        notes.append(f"{health.components} parts that nothing joins: each moves by itself.")
    if hit_rate < 1 - _MISSED:
        notes.append(
            f"{100 * (1 - hit_rate):.0f} % of the vertices' rays miss the body; they are bound to"
            " the closest skin."
        )
    return Inspection(
        path, unit, up, size, health, raw.polygons, float(np.median(np.abs(distance))),
        float(distance.max()), hangs, inside, outward, garment.template, _apart(v), hit_rate,
        tuple(problems), tuple(notes), _command(path, options) if problems else None,
    )  # fmt: skip


def fit_garment(
    path: str | pathlib.Path,
    out: str | pathlib.Path,
    *,
    like: Template | None = None,
    edge_length: float | None = None,
    coarser: float | None = None,
    draped: bool = False,
    body: Body | None = None,
    progress: Callable[[int, int], None] | None = None,
) -> tuple[list[str], Inspection]:
    """Writes a garment that can be worn: on the body, clean, oriented and out of the skin.

    Args:
        path: A file that `read_mesh` reads.
        out: The ``.obj`` to write: metres, Y up, on the body at rest.
        like: Turn, scale and move it onto this template's place instead of guessing its unit.
        edge_length: Split edges longer than this [m].
        coarser: Before that, decimate to about this edge length [m]; texture coordinates
            are lost.
        draped: At last let it down onto the body, by `drape`.
        body: The body; the built-in one by default.
        progress: Called by `drape`.

    Returns:
        What was done, a sentence each, and how the result looks.

    Raises:
        FormatError: A file that can't be read.
        MeshError: No unit and axis puts it on the body, and ``like`` isn't given; ``out``
            is the file itself; it falls off the body.
        MissingDependencyError: Decimation without fast-simplification.
    """
    path, out = pathlib.Path(path), pathlib.Path(out)
    if out.suffix.lower() != ".obj":
        raise MeshError(f"{out}: garments are written as .obj.")
    if out.resolve() == path.resolve():
        raise MeshError(f"{out}: would overwrite the file it is made from. Name another one.")
    body = load_body() if body is None else body
    raw = read_mesh(path)
    skin = body.rest_mesh()
    done = []
    if like is None:
        v, unit, up = place_on_body(path, raw.vertices, body)
        done.append(f"read as {unit}, {up} up.")
    else:
        v, told, _ = place_like(raw.vertices, template(like), skin)
        done.append(told)
    mesh = make_mesh(v, raw.faces, raw.uv, raw.uv_faces)
    before = mesh_health(mesh)
    if before.coincident_vertices:
        mesh = weld(mesh)
        done.append(f"welded {before.coincident_vertices:,} vertices onto their neighbours.")
    faces, vertices = int(mesh.faces.shape[0]), int(mesh.vertices.shape[0])
    mesh = clean(mesh)
    gone = faces - int(mesh.faces.shape[0]), vertices - int(mesh.vertices.shape[0])
    if any(gone):
        done.append(f"removed {gone[0]:,} faces and {gone[1]:,} vertices.")
    turned = orient(mesh, skin)
    count = int(np.sum(np.any(np.asarray(turned.faces) != np.asarray(mesh.faces), axis=1)))
    if count:
        done.append(f"turned {count:,} faces round.")
    mesh = turned
    count = int(mesh.faces.shape[0])
    if coarser is not None:
        textured = mesh.uv is not None
        mesh = decimate(mesh, coarser)
        if int(mesh.faces.shape[0]) < count:
            lost = ", without its texture coordinates" if textured else ""
            done.append(f"decimated {count:,} faces to {mesh.faces.shape[0]:,}{lost}.")
    count = int(mesh.faces.shape[0])
    if edge_length is not None:
        mesh = subdivide(mesh, edge_length)
        if int(mesh.faces.shape[0]) > count:
            done.append(f"split {count:,} faces into {mesh.faces.shape[0]:,}.")
    moved, low = lift_out(
        skin, np.asarray(mesh.vertices), np.asarray(mesh.faces), _LIFT * NEAREST, iterations=12
    )
    if low.any():
        done.append(f"lifted {int(low.sum()):,} vertices out of the body or off it.")
    if draped:
        kind = guess_template(moved, np.asarray(mesh.faces)) if like is None else like
        # Lifted over what it will slide down from, its edges are longer than it was made.
        hung = carried(mesh, kind, path.name, body)
        lain = drape(hung, start=moved, body=body, progress=progress)
        far = np.linalg.norm(lain - moved, axis=1)
        done.append(f"let it down: it moved by {1e3 * float(np.median(far)):.0f} mm.")
        moved, _ = lift_out(skin, lain, np.asarray(mesh.faces), _LIFT * NEAREST, iterations=12)
    write_obj(
        out,
        moved,
        np.asarray(mesh.faces),
        None if mesh.uv is None else np.asarray(mesh.uv),
        None if mesh.uv_faces is None else np.asarray(mesh.uv_faces),
    )
    return done, inspect_garment(out, body=body)


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
