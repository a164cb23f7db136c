"""Any garment mesh as a `Garment`: units, template and skin found and reported."""

import dataclasses
import pathlib
import shlex

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, Int

from ..body import Body, load_body
from ..errors import MeshError
from ..garment import (
    COTTON,
    TEMPLATES,
    Garment,
    Template,
    clearance,
    lift_out,
    template,
)
from ..geometry import (
    TriMesh,
    boundary_loops,
    connected_components,
    make_mesh,
    manifold_report,
    mesh_edges,
)
from ._mesh_file import GARMENT_FORMATS, mesh_name, read_mesh, split_part
from ._place import nearest_skin, place_on_body

NEAREST = 0.003
# Share of a garment inside the body from which it may lie elsewhere [1].
ELSEWHERE = 0.1
# What hangs farther off the skin with its highest tenth, or has longer edges, looks wrong [m].
HANGS, LONG = 0.02, 0.04
_TOPMOST = 0.1
# Legs are apart below this height [m]; a part this large and this far aside is one [1], [m].
_CROTCH, _LEG_SHARE, _ASIDE = -0.2, 0.15, 0.02


@dataclasses.dataclass(frozen=True)
class GarmentReport:
    """What was found out about a garment file.

    Attributes:
        path: The file, or the template's name.
        unit: Its unit.
        up: Its up axis.
        vertices: Number of vertices.
        faces: Number of triangles.
        topology: Counts of boundary, non-manifold and duplicate elements.
        inside: Share of vertices that lay within 3 mm of the skin or inside it, and
            were moved out.
        distance: Median distance to the skin [m].
        template: The template it is dressed by.
        hangs: How far its highest tenth stays from the skin [m].
        longest_edge: Length of its longest edge [m].
        posed: Whether it was made for a T-pose, and its sleeves and legs were turned down.
    """

    path: str
    unit: str
    up: str
    vertices: int
    faces: int
    topology: dict[str, int]
    inside: float
    distance: float
    template: str
    hangs: float
    longest_edge: float
    posed: bool = False

    @property
    def warning(self) -> str | None:
        """What will look wrong when it is worn as it is, and what to do."""
        found = []
        if self.inside > ELSEWHERE:
            found.append(f"{100 * self.inside:.0f} % of it lies in the body or on it")
        if self.hangs > HANGS:
            found.append(f"its top stays {1e3 * self.hangs:.0f} mm off the skin")
        if self.longest_edge > LONG:
            found.append(f"edges up to {1e3 * self.longest_edge:.0f} mm are too long to fold")
        if not found:
            return None
        file = shlex.quote(self.path)
        return f"{self.path}: {', '.join(found)}; `physxnet inspect {file}` says what mends it."


def load_garment(
    path: str | pathlib.Path,
    *,
    body: Body | None = None,
    kind: Template | None = None,
) -> tuple[Garment, GarmentReport]:
    """A garment from a file modelled on the body, or a template by name.

    The unit and up axis are those that put the mesh on the body. Vertices inside the
    skin are moved 3 mm out. Each vertex is carried by the closest skin; far from it the
    skinning weights are smoothed, so that a skirt isn't torn between the legs.

    Args:
        path: A file that `read_mesh` reads (``coat.glb#sleeves`` takes one mesh of several), or
            ``top``, ``bottom`` or ``dress``. ``coat.obj=top`` says what a file is dressed as, as
            ``kind`` does.
        body: The body; the built-in one by default.
        kind: Template to dress it by; guessed from what it covers if omitted.

    Returns:
        The garment and what was found out.

    Raises:
        MeshError: A mesh that no unit and axis puts on the body.
        FormatError: A file that can't be read.
    """
    body = load_body() if body is None else body
    file, _, told = str(path).rpartition("=")
    if file and told in TEMPLATES:
        path, kind = file, told  # pyright: ignore[reportAssignmentType]
    if str(path) in TEMPLATES:
        g = template(str(path))  # pyright: ignore[reportArgumentType]
        v, faces = np.asarray(g.mesh.vertices), np.asarray(g.mesh.faces)
        # Templates come on the built-in body, whatever body they are carried by.
        distance, _ = clearance(load_body().rest_mesh(), v)
        near = distance < NEAREST
        report = _report(str(path), "m", "Y", v, faces, near, distance, g.template)
        return g, report
    path = pathlib.Path(path)
    if split_part(path)[0].suffix.lower() not in GARMENT_FORMATS:
        raise MeshError(
            f"{path}: a garment is one of {', '.join(TEMPLATES)} (which '=top' behind a file says"
            f") or a file of triangles or quads: {', '.join(GARMENT_FORMATS)}."
        )
    raw = read_mesh(path)
    mesh = body.rest_mesh()
    v, unit, up, posed = place_on_body(path, raw.vertices, body, raw.faces)
    distance, _ = clearance(mesh, v)
    moved, inside = lift_out(mesh, v, raw.faces, NEAREST)
    kind = guess_template(moved, raw.faces) if kind is None else kind
    garment = carried(
        make_mesh(moved, raw.faces, raw.uv, raw.uv_faces, name=str(path)),
        kind,
        mesh_name(path),
        body,
    )
    garment = dataclasses.replace(garment, polygons=raw.polygons)
    report = _report(str(path), unit, up, v, raw.faces, inside, distance, kind)
    return garment, dataclasses.replace(report, posed=posed)


def _report(
    path: str,
    unit: str,
    up: str,
    vertices: np.ndarray,
    faces: np.ndarray,
    inside: np.ndarray,
    distance: np.ndarray,
    kind: Template,
) -> GarmentReport:
    ends = vertices[mesh_edges(faces).vertices]
    return GarmentReport(
        path,
        unit,
        up,
        len(vertices),
        len(faces),
        manifold_report(faces),
        float(inside.mean()),
        float(np.median(np.abs(distance))),
        kind,
        hangs_off(vertices, distance),
        float(np.linalg.norm(ends[:, 0] - ends[:, 1], axis=1).max(initial=0.0)),
    )


def hangs_off(
    vertices: Float[np.ndarray, "vertices 3"], distance: Float[np.ndarray, " vertices"]
) -> float:
    """How far the highest tenth of a mesh stays from the skin [m].

    What rests on shoulders or hips touches them there.
    """
    height = np.asarray(vertices)[:, 1]
    return float(distance[height >= height.max() - _TOPMOST * np.ptp(height)].min())


def carried(mesh: TriMesh, kind: Template, name: str, body: Body) -> Garment:
    """A mesh that lies on the body, carried by the closest skin."""
    skin = body.rest_mesh()
    rest = body.rest_vertices(body.default_shape())
    v, faces = np.asarray(mesh.vertices), np.asarray(mesh.faces)
    points = jnp.asarray(v.astype(np.float32))
    refs, shares, weights = nearest_skin(skin, body, v, faces)
    foot = jnp.einsum("vk,vkc->vc", shares, rest[refs], precision=jax.lax.Precision.HIGHEST)
    pinned = np.zeros(len(v), dtype=bool)
    loops = boundary_loops(faces)
    if kind == "bottom" and loops:
        pinned[max(loops, key=lambda x: v[x, 1].mean())] = True
    # No cloth holds what no face uses: it would fall out of the scene.
    pinned[np.setdiff1d(np.arange(len(v)), faces)] = True
    return Garment(
        mesh,
        jnp.asarray(pinned),
        refs,
        shares,
        points - foot,
        jnp.asarray(weights.astype(np.float32)),
        COTTON,
        kind,
        name,
    )


def guess_template(
    v: Float[np.ndarray, "vertices 3"], faces: Int[np.ndarray, "faces 3"]
) -> Template:
    """From what it covers: above the waist, below the crotch, one tube or two."""
    upper = float(np.mean(v[:, 1] > 0.15))
    lower = float(np.mean(v[:, 1] < -0.08))
    if lower > 0.15 and _has_legs(v, faces):
        return "bottom"
    if upper > 0.15 and lower > 0.15:
        return "dress"
    if upper >= lower:
        return "top"
    low = [x for x in boundary_loops(faces) if v[x, 1].mean() < -0.08 and len(x) > 4]
    return "bottom" if len(low) >= 2 else "dress"


def _has_legs(v: Float[np.ndarray, "vertices 3"], faces: Int[np.ndarray, "faces 3"]) -> bool:
    """Whether what is below the crotch are two parts, one on either side."""
    low = faces[(v[faces, 1] < _CROTCH).all(axis=1)]
    if not len(low):
        return False
    rows, at = np.unique(low, return_inverse=True)
    part = connected_components(at.reshape(-1, 3).astype(np.int32), len(rows))
    sides = [
        float(v[rows[part == k], 0].mean())
        for k in np.unique(part)
        if np.mean(part == k) > _LEG_SHARE
    ]
    return bool(sides) and min(sides) < -_ASIDE and max(sides) > _ASIDE
