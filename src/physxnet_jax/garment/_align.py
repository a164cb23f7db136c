"""Aligns a garment mesh with a template: rotation, scale and translation."""

from collections.abc import Sequence

import numpy as np

from ..body import Body
from ..io import StaticMesh
from ._garment import Garment, Template
from ._locate import NO_HINTS, Hints, Placement, placement_of
from ._poses import posed_bodies
from ._search import Candidate, Search, choose, plausible_units, turns

# A placement in a unit of the file is kept up to this cost, or this multiple of that of the best
# scale [m].
_GOOD, _RATIO = 0.03, 1.5


def align_to_template(
    mesh: StaticMesh, wanted: Garment, body: Body, hints: Hints = NO_HINTS
) -> tuple[Placement, str, float]:
    """Rotates, scales and moves a mesh to where a template is.

    The file's unit is kept if the mesh then fits the body around; otherwise it is scaled to the
    template's height or width. A short garment stays short. The front is where the neckline is
    low.

    Args:
        mesh: The mesh in the file's unit and axes.
        wanted: The template.
        body: The body.
        hints: What the user says of the file.

    Returns:
        The placement, a description of it, and its cost [m].
    """
    search, found = _candidate(_search(mesh, body), mesh, wanted, hints)
    return placement_of(search, found, mesh, body), _description(found, wanted), found.cost


def most_alike(
    mesh: StaticMesh, templates: Sequence[Garment], body: Body
) -> tuple[Template, Placement, str]:
    """The template whose place a mesh fits best, its placement there and a description of it.

    Args:
        mesh: The mesh in the file's unit and axes.
        templates: The templates to choose from.
        body: The body.
    """
    search = _search(mesh, body)
    every = [(w, *_candidate(search, mesh, w, NO_HINTS)) for w in templates]
    wanted, search, found = min(every, key=lambda c: c[2].cost)
    return wanted.template, placement_of(search, found, mesh, body), _description(found, wanted)


def _search(mesh: StaticMesh, body: Body) -> Search:
    return Search(mesh.vertices, mesh.faces, posed_bodies(body))


def _candidate(
    search: Search, mesh: StaticMesh, wanted: Garment, hints: Hints
) -> tuple[Search, Candidate]:
    x = np.asarray(wanted.mesh.vertices, np.float64)
    search = search.for_region(x)
    turned = turns(hints.up or mesh.up, hints.front, every=True)
    extent = np.ptp(search.vertices, axis=0)
    units = plausible_units(float(extent.max()))
    found = choose(search, units, turned)
    if found is None or found.cost > _GOOD:
        # Heights and widths of the file along each axis that may be the template's.
        height, width = np.ptp(x, axis=0)[[1, 0]]
        scales = {s: f"{s:.4g}" for e in extent if e > 0 for s in (height / e, width / e)}
        other = choose(search, {name: s for s, name in scales.items()}, turned)
        if other is not None and (found is None or found.cost > _RATIO * other.cost):
            found = other
    assert found is not None
    return search, found


def _description(found: Candidate, wanted: Garment) -> str:
    about = f", turned by {found.turn.degrees} degrees about it" if found.turn.degrees else ""
    return (
        f"scaled by {found.scale:.4g}, {found.turn.up} up{about}, moved to where a"
        f" {wanted.template} is."
    )
