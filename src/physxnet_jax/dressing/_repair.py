"""Repairs a garment and writes it as a new file."""

import pathlib
from collections.abc import Callable

import jax.numpy as jnp
import numpy as np
from jaxtyping import Int

from ..body import Body, load_body
from ..errors import MeshError
from ..garment import (
    NEAREST,
    Hints,
    Template,
    align_to_template,
    carried,
    clean,
    decimate,
    guess_template,
    lift_out,
    locate_on_body,
    mesh_health,
    orient,
    parse_wear,
    polygons_left,
    subdivide,
    template,
    weld,
)
from ..geometry import Polygons, TriMesh, make_mesh
from ..io import read_mesh, write_materials, write_obj
from ._inspect import Inspection, inspect_garment
from ._settle import settle_on_body

# `lift_out` ends slightly below its target distance, so the target is scaled up.
_OVERSHOOT = 1.3
# Largest number of passes that split edges stretched by lifting.
_ROUNDS = 5


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
    """Repairs a garment file: places it on the body, cleans and orients it, clears the skin.

    Args:
        path: A file that `read_mesh` reads.
        out: The ``.obj`` to write: metres, Y up, on the body at rest.
        like: Template to align it with, instead of guessing its unit.
        edge_length: Split edges longer than this [m].
        coarser: Before that, decimate to about this edge length [m].
        draped: Finally settle it on the body, see `settle_on_body`.
        body: The body; the built-in one by default.
        progress: Called by `settle_on_body`.

    Returns:
        The steps taken, a sentence each, and the inspection of the result.

    Raises:
        FormatError: The file can't be read.
        MeshError: No unit and up axis places it on the body and ``like`` isn't given, ``out``
            is the file itself, or the garment falls off the body.
        MissingDependencyError: fast-simplification isn't installed, and is needed to decimate.
    """
    item, out = parse_wear(path), pathlib.Path(out)
    path = pathlib.Path(item.name)
    if out.suffix.lower() != ".obj":
        raise MeshError(f"{out}: garments are written as .obj.")
    if out.resolve() == path.resolve():
        raise MeshError(f"{out}: would overwrite its source file. Choose another name.")
    body = load_body() if body is None else body
    raw = read_mesh(path)
    skin = body.rest_mesh()
    hints = Hints(unit=item.unit, up=item.up, front=item.front)
    done: list[str] = []
    if like is None:
        placement = locate_on_body(path, raw, body, hints)
        done.append(f"read as {placement.unit}, {placement.up} up.")
    else:
        placement, description, _ = align_to_template(raw, template(like), body, hints)
        done.append(description)
    done += placement.notes
    v = placement.vertices
    mesh = make_mesh(v, raw.faces, raw.uv, raw.uv_faces)
    before = mesh_health(mesh)
    if before.coincident_vertices:
        mesh = weld(mesh)
        done.append(f"welded {before.coincident_vertices:,} vertices onto their neighbours.")
    faces, vertices = int(mesh.faces.shape[0]), int(mesh.vertices.shape[0])
    mesh = clean(mesh)
    removed = faces - int(mesh.faces.shape[0]), vertices - int(mesh.vertices.shape[0])
    if any(removed):
        done.append(f"removed {removed[0]:,} faces and {removed[1]:,} vertices.")
    turned = orient(mesh, skin)
    count = int(np.sum(np.any(np.asarray(turned.faces) != np.asarray(mesh.faces), axis=1)))
    if count:
        done.append(f"flipped {count:,} faces.")
    mesh, cut, origin = turned, np.asarray(turned.faces), np.arange(len(turned.faces))
    drawn = None if raw.polygons is None else polygons_left(raw.polygons, v, mesh)
    count = int(mesh.faces.shape[0])
    if coarser is not None:
        mesh, origin = decimate(mesh, coarser)
        if len(origin) < count:
            done.append(f"decimated {count:,} faces to {len(origin):,}.")
    count = int(mesh.faces.shape[0])
    mesh, low, part_of = _split_and_lift(mesh, skin, edge_length)
    moved = np.asarray(mesh.vertices)
    if int(mesh.faces.shape[0]) > count:
        done.append(f"split {count:,} faces into {mesh.faces.shape[0]:,}.")
    if low:
        done.append(f"lifted {low:,} vertices out of the body or off it.")
    if draped:
        kind = guess_template(moved, np.asarray(mesh.faces)) if like is None else like
        # Edges that lifting stretched keep that length.
        lifted = carried(mesh, kind, path.name, body)
        settled = settle_on_body(lifted, start=moved, body=body, progress=progress)
        far = np.linalg.norm(settled - moved, axis=1)
        done.append(f"settled it on the body: it moved by {1e3 * float(np.median(far)):.0f} mm.")
        moved, _ = lift_out(
            skin, settled, np.asarray(mesh.faces), _OVERSHOOT * NEAREST, iterations=12
        )
    # Decimation and subdivision work on triangles alone.
    if drawn is not None and not np.array_equal(origin[part_of], np.arange(len(cut))):
        drawn = _triangles(drawn, origin[part_of], mesh)
        if raw.count < len(raw.faces):
            done.append("polygons are triangles now.")
    _write(out, mesh.replace(vertices=moved), drawn)
    return done, inspect_garment(out, body=body)


def _split_and_lift(
    mesh: TriMesh, skin: TriMesh, edge_length: float | None
) -> tuple[TriMesh, int, Int[np.ndarray, " faces"]]:
    """Splits long edges and moves vertices out of the body, in alternation.

    Lifting stretches edges, which are then split again; midpoints lie lower than the ends.

    Returns the mesh, how many vertices lay in the body, and the original face of each face.
    """
    count, part_of = 0, np.arange(len(mesh.faces))
    for again in range(_ROUNDS):
        if edge_length is not None:
            finer, cut = subdivide(mesh, edge_length)
            if again and finer.faces.shape == mesh.faces.shape:
                break
            mesh, part_of = finer, part_of[cut]
        x, faces = np.asarray(mesh.vertices), np.asarray(mesh.faces)
        moved, low = lift_out(skin, x, faces, _OVERSHOOT * NEAREST, iterations=12)
        count = max(count, int(low.sum()))
        mesh = mesh.replace(vertices=jnp.asarray(moved, jnp.float32))
        if edge_length is None or not low.any():
            break
    return mesh, count, part_of


def _triangles(drawn: Polygons, part_of: Int[np.ndarray, " faces"], mesh: TriMesh) -> Polygons:
    """Triangles of a subdivided or decimated mesh, with the materials of their origins."""
    return Polygons(
        np.full(len(mesh.faces), 3, np.int32),
        np.asarray(mesh.faces).reshape(-1),
        None if mesh.uv_faces is None else np.asarray(mesh.uv_faces).reshape(-1),
        drawn.material[drawn.of_triangle[part_of]],
        drawn.materials,
    )


def _write(out: pathlib.Path, mesh: TriMesh, drawn: Polygons | None) -> None:
    library = None
    if drawn is not None and drawn.materials:
        library = out.with_suffix(".mtl").name
        write_materials(out.with_name(library), drawn.materials)
    write_obj(
        out,
        np.asarray(mesh.vertices),
        np.asarray(mesh.faces),
        None if mesh.uv is None else np.asarray(mesh.uv),
        None if mesh.uv_faces is None else np.asarray(mesh.uv_faces),
        polygons=drawn,
        library=library,
    )
