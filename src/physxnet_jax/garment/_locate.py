"""Locates a garment mesh on the body: its unit, up axis and pose."""

import dataclasses
import pathlib
from collections.abc import Sequence
from typing import NamedTuple

import jax
import numpy as np
from jaxtyping import Array, Float, Int

from ..body import Body
from ..errors import MeshError
from ..geometry import (
    TriMesh,
    closest_among,
    connected_components,
    nearby_faces,
    padded_rows,
    smoothing_matrix,
)
from ..io import StaticMesh
from ._garment import carried_weights
from ._openings import Opening
from ._poses import PosedBody, posed_bodies
from ._search import FRAMES, UNITS, Candidate, Search, choose, plausible_units, strays, turns

# Cost above which a garment is refused if nothing holds it where its file has it [m].
_MAX_COST = 0.09
# A single flat part is refused above this cost [m]; parts thinner than this share of their length
# are flat [1].
_FLAT_COST, _THIN = 0.06, 0.01
# Shifts below this aren't worth a note [m].
_NOTED = 0.005
_MAX_PANELS, _PANEL = 200, 10
# Sizes of garments whose unit the user gives [m].
_SMALLEST, _LARGEST = 0.05, 5.0


@dataclasses.dataclass(frozen=True, kw_only=True)
class Hints:
    """What is known of a file's axes and unit.

    Attributes:
        unit: Name of its unit, or metres for each of its units.
        up: Axis that points up, one of `AXES`.
        front: Axis that the garment faces, one of `AXES`.
    """

    unit: str | float | None = None
    up: str | None = None
    front: str | None = None


NO_HINTS = Hints()


class Placement(NamedTuple):
    """A garment's mesh on the body at rest.

    Attributes:
        vertices: Positions [m], shape [vertices, 3].
        unit: The unit of its file, or the scale to metres.
        up: The up axis.
        pose: The pose of the body that it was modelled on, a key of `POSES`; it was moved to
            the rest pose.
        notes: What was done beyond reading unit and up axis, a sentence each.
        openings: Its openings and the limbs that pass through them.
    """

    vertices: Float[np.ndarray, "vertices 3"]
    unit: str
    up: str
    pose: str
    notes: tuple[str, ...]
    openings: tuple[Opening, ...]

    @property
    def posed(self) -> bool:
        """Whether it was modelled in another pose than rest."""
        return self.pose != "rest"


def locate_on_body(
    path: pathlib.Path, mesh: StaticMesh, body: Body, hints: Hints = NO_HINTS
) -> Placement:
    """Converts a mesh to metres on the body at rest.

    Unit, axes, pose and position are those that the evidence speaks for: what the file declares,
    the distance from the skin, the limbs that pass through its openings, and the side on which
    its neckline is low. A mesh that was modelled on a body in another pose is moved to the rest
    pose with the skin beneath it.

    Args:
        path: File name for the error message.
        mesh: The mesh in the file's unit and axes.
        body: The body.
        hints: What the user says of the file.

    Raises:
        MeshError: Nothing places the mesh on the body, or it is a flat sewing pattern.
    """
    search = Search(mesh.vertices, mesh.faces, posed_bodies(body))
    size = float(np.ptp(search.vertices, axis=0).max())
    notes, found = [], None
    turned = turns(hints.up or mesh.up, hints.front)
    units = plausible_units(size) if hints.unit is None else _given(hints.unit, size)
    if hints.unit is None and mesh.unit is not None:
        # What a file declares is true unless it is impossible.
        found = choose(search, {k: s for k, s in units.items() if k == mesh.unit}, turned)
        if found is None or not _stands(found, hints):
            notes.append(f"its file declares {mesh.unit}, which puts it on no part of the body.")
            found = None
    if found is None:
        found = choose(search, units, turned)
    panels = _flat_parts(mesh)
    if found is None or not _stands(found, hints) or (panels and found.cost > _FLAT_COST):
        raise MeshError(_refusal(path, mesh, found, panels))
    return placement_of(search, found, mesh, body, notes)


def placement_of(
    search: Search, found: Candidate, mesh: StaticMesh, body: Body, notes: Sequence[str] = ()
) -> Placement:
    """The placement of a mesh on the body at rest, from its place on a posed body."""
    v = found.apply(np.asarray(mesh.vertices, np.float64))
    odd = strays(v)
    if odd.any():
        away = float(np.linalg.norm(v[odd] - np.median(v[~odd], axis=0), axis=1).max())
        notes = (
            *notes,
            f"{odd.sum()} of its {len(v)} vertices lie as far as {away:.1f} m from it:"
            " delete them.",
        )
    if found.pose != "rest":
        v = _to_rest_pose(v, mesh.faces, body, search.poses[found.pose])
    return Placement(
        v,
        found.unit,
        found.turn.up,
        found.pose,
        (*notes, *_notes(found)),
        tuple(found.openings),
    )


def _given(unit: str | float, size: float) -> dict[str, float]:
    """The user's unit, unless no garment is of this size in it."""
    name, scale = (unit, UNITS[unit]) if isinstance(unit, str) else (f"{unit:g} m", float(unit))
    return {name: scale} if _SMALLEST < size * scale < _LARGEST else {}


def _stands(found: Candidate, hints: Hints) -> bool:
    """Whether a garment is near enough to the body, or held by it as a cape is."""
    as_is = found.frame == "origin" and (found.turn.up == "Y" or hints.up is not None)
    limit = _MAX_COST if hints == NO_HINTS else 2.0 * _MAX_COST
    return found.cost < limit or (found.held and as_is)


def _notes(found: Candidate) -> list[str]:
    """Sentences on how a garment was placed."""
    out = []
    if found.turn.degrees:
        out.append(f"turned by {found.turn.degrees} degrees: it faced the other way.")
    if found.frame == "floor":
        out.append("its floor was put under the feet.")
    elif found.frame in FRAMES:
        out.append(
            f"raised by {100 * found.shift[1]:.0f} cm: it stood as clothes made on {found.frame}"
            " do, whose origin is in the chest."
        )
    elif np.abs(found.shift).max() > _NOTED and found.frame == "found":
        x, y, z = 100 * found.shift
        out.append(f"moved to where it fits: {x:+.0f}, {y:+.0f}, {z:+.0f} cm (x, y, z).")
    if found.pose != "rest":
        out.append(
            f"modelled on a body in another pose ({found.pose}); sleeves and legs are turned"
            " with the limbs."
        )
    return out


def _refusal(path: pathlib.Path, mesh: StaticMesh, found: Candidate | None, panels: int) -> str:
    size = " x ".join(f"{s:.3g}" for s in np.ptp(mesh.vertices, axis=0))
    if panels:
        return (
            f"{path}: {panels} flat panels ({size}), as of a sewing pattern that was never sewn."
            if panels > 1
            else f"{path}: a flat sheet ({size}) that was never put round a body."
        ) + " Sew it in the program that made it, drape it on the avatar, and export that."
    how = (
        "no unit makes it as large as a garment"
        if found is None
        else f"the best place, in {found.unit}, leaves it {found.misfit:.2f} m away on average"
    )
    return (
        f"{path}: no unit and up axis puts this mesh on the body: it measures {size}, and {how}."
        f" Name its unit and axes ({path}:unit=cm,up=z), scale and move it with physxnet fit"
        f" {path} --like top (or bottom, dress), or place it on the body at rest, which"
        " physxnet export-rest writes (A-pose, Y up, origin in the pelvis), and export again."
    )


def _flat_parts(mesh: StaticMesh) -> int:
    """Number of parts of a mesh if all of them are flat, else 0."""
    label = connected_components(mesh.faces, len(mesh.vertices))
    used = np.unique(mesh.faces)
    parts = np.unique(label[used])
    if len(parts) > _MAX_PANELS:
        return 0
    for part in parts:
        x = mesh.vertices[used[label[used] == part]]
        length = np.linalg.svd(x - x.mean(axis=0), compute_uv=False)
        if len(x) < _PANEL or length[2] > _THIN * length[0]:
            return 0
    return len(parts)


def _to_rest_pose(
    vertices: Float[np.ndarray, "vertices 3"],
    faces: Int[np.ndarray, "faces 3"],
    body: Body,
    pose: PosedBody,
) -> Float[np.ndarray, "vertices 3"]:
    """Moves cloth on a posed body to the rest pose by inverting the skinning beneath it [m]."""
    weights = nearest_skin(pose.skin, body, vertices, faces)[2].astype(np.float64)
    blend = np.einsum("vj,jab->vab", weights, pose.rotations)
    return np.linalg.solve(blend, (vertices - weights @ pose.translations)[..., None])[..., 0]


def nearest_skin(
    skin: TriMesh,
    body: Body,
    vertices: Float[np.ndarray, "vertices 3"],
    faces: Int[np.ndarray, "faces 3"],
) -> tuple[
    Int[Array, "vertices 3"], Float[Array, "vertices 3"], Float[np.ndarray, "vertices joints"]
]:
    """Closest skin of each vertex: corners of the face, barycentric and skinning weights.

    Far from the skin, skinning weights are smoothed, so that a skirt isn't torn between the
    legs.

    Args:
        skin: The body's skin in some pose.
        body: The body.
        vertices: Vertices of the mesh [m].
        faces: Triangles of the mesh.
    """
    near = nearby_faces(np.asarray(skin.vertices), np.asarray(skin.faces), vertices, neighbours=12)
    points = padded_rows(vertices.astype(np.float32))
    hit = closest_among(skin, jax.device_put(points), jax.device_put(padded_rows(near)))
    refs = skin.faces[hit.face]
    skin_weights = carried_weights(body.weights, refs, hit.weights)
    known = (refs, hit.weights, skin_weights, hit.squared_distance)
    refs, shares, weights, squared = (np.asarray(x)[: len(vertices)] for x in known)
    return (
        jax.device_put(refs),
        jax.device_put(shares),
        _smooth_far(weights, faces, np.sqrt(squared)),
    )


def _smooth_far(weights: np.ndarray, faces: np.ndarray, distance: np.ndarray) -> np.ndarray:
    """Smooths skinning weights over the mesh where the skin is far away."""
    weights = weights.astype(np.float64)
    share = np.clip((distance - 0.02) / 0.04, 0.0, 1.0)[:, None]
    far = np.flatnonzero(share)
    if len(far):
        average, share = smoothing_matrix(faces, len(weights))[far], share[far]
        joints = np.flatnonzero(weights.any(axis=0))
        some = np.ascontiguousarray(weights[:, joints])
        for _ in range(60):
            some[far] += share * (average @ some - some[far])
        weights[:, joints] = some
    return weights / weights.sum(axis=1, keepdims=True)
