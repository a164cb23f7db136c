"""Loads meshes as garments: detects unit, up axis and template, and attaches them to the skin."""

import dataclasses
import pathlib
import shlex
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int
from scipy.spatial import KDTree

from ..body import Body, load_body
from ..errors import MeshError, PhysXNetError
from ..geometry import (
    TriMesh,
    boundary_loops,
    connected_components,
    make_mesh,
    manifold_report,
    mesh_edges,
)
from ..io import GARMENT_FORMATS, StaticMesh, mesh_name, read_mesh, split_part
from ._fit import clearance, lift_out
from ._garment import COTTON, TEMPLATES, Garment, Template
from ._locate import Hints, Placement, locate_on_body, nearest_skin
from ._made_on import placed_by_body
from ._openings import Opening, openings
from ._poses import posed_bodies
from ._search import strays
from ._templates import template
from ._wear import WearItem, parse_wear, with_fabric
from .tailoring import KINDS, tailor

NEAREST = 0.003
# Largest number of meshes of a file that are looked at one by one.
_MAX_PARTS = 40
# Share of vertices inside the body above which a garment may be misplaced [1].
ELSEWHERE = 0.1
# Largest distance of the highest tenth from the skin, and longest edge, without a warning [m].
HANGS, LONG = 0.02, 0.04
_TOP_SHARE = 0.1
# A garment that ends below this doesn't rest on the shoulders [m].
_SHOULDERS = 0.42
# A border farther from the skin than this doesn't lie around the body [m].
_AROUND = 0.05
# Height of the crotch [m], smallest share of vertices [1] and lateral offset [m] of a leg.
_CROTCH, _LEG_SHARE, _LEG_OFFSET = -0.2, 0.15, 0.02


@dataclasses.dataclass(frozen=True)
class GarmentReport:
    """Report on a loaded garment file.

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
        template: Template that dresses it.
        hangs: Smallest distance of its highest tenth from the skin [m].
        longest_edge: Length of its longest edge [m].
        pose: Pose of the body that it was modelled on, ``rest`` or a description; it was moved to
            the rest pose.
        placed: How it was placed beyond reading unit and up axis, a sentence each.
        openings: Its openings and the limbs that pass through them.
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
    pose: str = "rest"
    placed: tuple[str, ...] = ()
    openings: tuple[Opening, ...] = ()

    @property
    def warning(self) -> str | None:
        """Defects that will be visible when it is worn, and the remedy; None without any."""
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
        return f"{self.path}: {', '.join(found)}; `physxnet inspect {file}` shows how to repair it."


def load_garment(
    path: str | pathlib.Path,
    *,
    body: Body | None = None,
    shape: Float[Array, " shapes"] | None = None,
) -> tuple[Garment, GarmentReport]:
    """Loads a garment from a file modelled on the body, or makes one by its name.

    The unit and up axis are those that place the mesh on the body. Vertices inside the skin
    move to 3 mm outside. Each vertex is attached to the closest skin. Far from the skin,
    skinning weights are smoothed, so that a skirt isn't torn between the legs.

    Args:
        path: A file that `read_mesh` reads (``coat.glb#sleeves`` selects one of several
            meshes), a template (``top``, ``bottom`` or ``dress``) or a kind that the tailor
            makes (`KINDS`); options follow a colon, see `parse_wear`.
        body: The body; the built-in one by default.
        shape: Shape parameters of the person that tailored garments are cut for.

    Returns:
        The garment and a report.

    Raises:
        MeshError: No unit and up axis places the mesh on the body.
        FormatError: The file can't be read.
    """
    body = load_body() if body is None else body
    item = parse_wear(path)
    if item.name in KINDS:
        return _tailored(item, shape)
    return _of_fabric(item, *_load(item, body))


def _of_fabric(
    item: WearItem, garment: Garment, report: GarmentReport
) -> tuple[Garment, GarmentReport]:
    return garment if item.fabric is None else with_fabric(garment, item.fabric), report


def load_outfit(
    path: str | pathlib.Path,
    *,
    body: Body | None = None,
    shape: Float[Array, " shapes"] | None = None,
) -> list[tuple[Garment, GarmentReport]]:
    """Loads a garment as `load_garment` does, or each garment of a file that holds several.

    Meshes of a file that limbs pass through by themselves, and that different templates dress,
    are garments; others (buttons, ribbons, a pocket) belong to the garment nearest to them. All
    keep their places relative to each other.

    Args:
        path: As for `load_garment`.
        body: The body; the built-in one by default.
        shape: Shape parameters of the person that tailored garments are cut for.

    Raises:
        MeshError: No unit and up axis places the meshes on the body.
        FormatError: The file can't be read.
    """
    body = load_body() if body is None else body
    item = parse_wear(path)
    file, part = split_part(item.name)
    single = item.name in KINDS or item.name in TEMPLATES or part is not None
    if single or item.template is not None or file.suffix.lower() not in GARMENT_FORMATS:
        return [load_garment(path, body=body, shape=shape)]
    raw = read_mesh(file)
    if len(raw.parts) < 2:
        return [_of_fabric(item, *_load(item, body, raw))]
    placement = place_mesh(item, raw, body)
    groups = _garments(file, raw, placement, body)
    out = []
    for names in groups or [None]:
        name = item.name if names is None else f"{item.name}#{'+'.join(names)}"
        mesh = raw if names is None else read_mesh(name)
        there = placement if names is None else _part(raw, placement, mesh, body)
        out.append(_of_fabric(item, *garment_of(name, mesh, there, None, body)))
    return out


def _garments(
    file: pathlib.Path, raw: StaticMesh, placement: Placement, body: Body
) -> list[list[str]]:
    """Names of the meshes of each garment of a file; none if it holds one."""
    meshes = {name: read_mesh(f"{file}#{name}") for name in raw.parts[:_MAX_PARTS]}
    parts = {name: _part(raw, placement, mesh, body) for name, mesh in meshes.items()}
    worn = {
        name: guess_template(part.vertices, meshes[name].faces)
        for name, part in parts.items()
        if sum(bool(o.limbs) for o in part.openings) >= 2
    }
    kinds = sorted(set(worn.values()))
    if len(kinds) < 2:
        return []
    trees = {name: KDTree(parts[name].vertices) for name in worn}
    groups: dict[str, list[str]] = {kind: [] for kind in kinds}
    for name, part in parts.items():
        near = min(trees, key=lambda n: float(np.mean(trees[n].query(part.vertices)[0])))
        groups[worn.get(name) or worn[near]].append(name)
    return list(groups.values())


def _part(raw: StaticMesh, placement: Placement, part: StaticMesh, body: Body) -> Placement:
    """The placement of a part of a mesh that was placed as a whole."""
    rows = KDTree(raw.vertices).query(part.vertices)[1]
    v = placement.vertices[rows]
    limbs = posed_bodies(body)["rest"].limbs
    found = openings(v, boundary_loops(part.faces), limbs)
    return placement._replace(vertices=v, openings=tuple(found))


def _tailored(
    item: WearItem, shape: Float[Array, " shapes"] | None
) -> tuple[Garment, GarmentReport]:
    options: dict[str, Any] = dict(item.measures)
    garment = tailor(item.name, **options, fabric=item.fabric, hold=item.hold, shape=shape)
    v, faces = np.asarray(garment.mesh.vertices), np.asarray(garment.mesh.faces)
    distance, _ = clearance(load_body().rest_mesh(), v)
    inside = np.zeros(len(v), dtype=bool)
    return garment, _report(item.name, "m", "Y", v, faces, inside, distance, garment.template)


def place_mesh(item: WearItem, mesh: StaticMesh, body: Body) -> Placement:
    """Places the mesh of a garment file on the body.

    Raises:
        MeshError: Nothing places it on the body.
    """
    if item.made_on is not None:
        if item.unit or item.up or item.front:
            raise PhysXNetError(f"{item.name}: made_on places it; leave unit, up and front out.")
        return placed_by_body(item.name, mesh, item.made_on, body)
    hints = Hints(unit=item.unit, up=item.up, front=item.front)
    return locate_on_body(pathlib.Path(item.name), mesh, body, hints)


def _read(item: WearItem) -> StaticMesh:
    path = pathlib.Path(item.name)
    if split_part(path)[0].suffix.lower() not in GARMENT_FORMATS:
        raise MeshError(
            f"{path}: a garment is one of {', '.join((*KINDS, *TEMPLATES))} or a file of triangles"
            f" or quads: {', '.join(GARMENT_FORMATS)} (':as=top' after its name dresses it like a"
            " template)."
        )
    return read_mesh(path)


def _load(
    item: WearItem, body: Body, raw: StaticMesh | None = None
) -> tuple[Garment, GarmentReport]:
    path, kind = item.name, item.template
    if str(path) in TEMPLATES:
        if kind is not None:
            raise PhysXNetError(f"{path} is a template: leave 'as' out.")
        g = template(str(path))  # pyright: ignore[reportArgumentType]
        v, faces = np.asarray(g.mesh.vertices), np.asarray(g.mesh.faces)
        # Template meshes lie on the built-in body, whichever body is given.
        distance, _ = clearance(load_body().rest_mesh(), v)
        near = distance < NEAREST
        report = _report(str(path), "m", "Y", v, faces, near, distance, g.template)
        return g, report
    raw = _read(item) if raw is None else raw
    placement = place_mesh(item, raw, body)
    return garment_of(path, raw, placement, kind, body)


def garment_of(
    path: str | pathlib.Path,
    raw: StaticMesh,
    placement: Placement,
    kind: Template | None,
    body: Body,
) -> tuple[Garment, GarmentReport]:
    """Makes a garment of a mesh that was placed on the body, and its report."""
    v, unit, up = placement.vertices, placement.unit, placement.up
    mesh = body.rest_mesh()
    known = distance, _ = clearance(mesh, v)
    moved, inside = lift_out(mesh, v, raw.faces, NEAREST, known=known)
    kind = guess_template(moved, raw.faces) if kind is None else kind
    garment = carried(
        make_mesh(moved, raw.faces, raw.uv, raw.uv_faces, name=str(path)),
        kind,
        mesh_name(path),
        body,
    )
    garment = dataclasses.replace(garment, polygons=raw.polygons)
    report = _report(str(path), unit, up, v, raw.faces, inside, distance, kind)
    return garment, dataclasses.replace(
        report, pose=placement.pose, placed=placement.notes, openings=placement.openings
    )


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
    """Smallest distance of the highest tenth of a mesh from the skin [m].

    A garment that rests on shoulders or hips touches the skin there.
    """
    odd = strays(np.asarray(vertices))
    height, distance = np.asarray(vertices)[~odd, 1], distance[~odd]
    return float(distance[height >= height.max() - _TOP_SHARE * np.ptp(height)].min())


def carried(mesh: TriMesh, kind: Template, name: str, body: Body) -> Garment:
    """Makes a garment of a mesh on the body by attaching it to the closest skin."""
    skin = body.rest_mesh()
    rest = body.rest_vertices(body.default_shape())
    v, faces = np.asarray(mesh.vertices), np.asarray(mesh.faces)
    points = jax.device_put(v.astype(np.float32))
    refs, shares, weights = nearest_skin(skin, body, v, faces)
    closest = jnp.einsum("vk,vkc->vc", shares, rest[refs], precision=jax.lax.Precision.HIGHEST)
    pinned = np.zeros(len(v), dtype=bool)
    borders = boundary_loops(faces)
    if kind == "bottom" and borders:
        pinned[max(borders, key=lambda x: v[x, 1].mean())] = True
    band = None if kind == "bottom" else _band(v, borders, np.asarray(points - closest))
    # Vertices that no face uses are pinned: otherwise they would fall out of the scene.
    pinned[np.setdiff1d(np.arange(len(v)), faces)] = True
    return Garment(
        mesh,
        jax.device_put(pinned),
        refs,
        shares,
        points - closest,
        jax.device_put(weights.astype(np.float32)),
        COTTON,
        kind,
        name,
        loops={} if band is None else {"waist": band},
        elastic=() if band is None else ("waist",),
    )


def _band(
    v: Float[np.ndarray, "vertices 3"],
    borders: list[Int[np.ndarray, " _"]],
    gap: Float[np.ndarray, "vertices 3"],
) -> Int[Array, "edges 2"] | None:
    """Edges of the upper border, where nothing of a garment rests on the shoulders.

    A skirt or a strapless dress needs a band; what doesn't lie around the body has none.
    """
    if not borders:
        return None
    upper = max(borders, key=lambda loop: v[loop, 1].mean())
    far = float(np.linalg.norm(gap[upper], axis=1).mean())
    if v[upper, 1].max() >= _SHOULDERS or far >= _AROUND:
        return None
    return jax.device_put(np.column_stack([upper, np.roll(upper, -1)]).astype(np.int32))


def guess_template(
    v: Float[np.ndarray, "vertices 3"], faces: Int[np.ndarray, "faces 3"]
) -> Template:
    """Guesses the template from what a mesh covers: above the waist, below the crotch, legs."""
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
    """Whether the mesh below the crotch has a part on either side."""
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
    return bool(sides) and min(sides) < -_LEG_OFFSET and max(sides) > _LEG_OFFSET
