"""What is written and shown: the body and its garments as animated meshes."""

import dataclasses
import pathlib
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from ..body import Body
from ..errors import PhysXNetError
from ..garment import TEMPLATES, Garment, template
from ..io import AnimatedMesh, load_garment
from ..motion import Motion, body_animation

Wear = Sequence[Garment | str | pathlib.Path] | Garment | str | pathlib.Path
"""Garments, garment files or names of templates, or one of them."""

_COLOURS = ((0.16, 0.27, 0.55), (0.55, 0.28, 0.20), (0.25, 0.45, 0.30), (0.45, 0.25, 0.45))
_SKIN_COLOUR = (0.69, 0.46, 0.33)


def animated_meshes(
    body: Body,
    clip: Motion,
    shape: Any | None,
    garments: Sequence[Garment],
    positions: Mapping[str, np.ndarray],
    include_body: bool = True,
) -> tuple[AnimatedMesh, ...]:
    """The body (unless left out) and the garments, in the order given.

    Args:
        body: The body.
        clip: Its motion.
        shape: Its shape parameters; the default if None.
        garments: What is worn.
        positions: Of each garment by name [m], shape [frames, vertices, 3].
        include_body: Whether the body comes first.
    """
    meshes = []
    if include_body:
        mesh = body.rest_mesh()
        meshes.append(
            AnimatedMesh(
                "body",
                np.asarray(body_animation(body, clip, shape)),
                np.asarray(mesh.faces),
                np.asarray(mesh.uv),
                np.asarray(mesh.uv_faces),
                _SKIN_COLOUR,
            )
        )
    for k, g in enumerate(garments):
        uv = None if g.mesh.uv is None else np.asarray(g.mesh.uv)
        uv_faces = None if g.mesh.uv_faces is None else np.asarray(g.mesh.uv_faces)
        colour = _COLOURS[k % len(_COLOURS)]
        faces = np.asarray(g.mesh.faces)
        meshes.append(
            AnimatedMesh(g.name, positions[g.name], faces, uv, uv_faces, colour, g.polygons)
        )
    return tuple(meshes)


def worn_garments(wear: Wear, body: Body) -> tuple[list[Garment], tuple[str, ...]]:
    """Garments with names that differ, and what to know about the files they come from.

    Args:
        wear: Garments, garment files or template names, or one of them.
        body: What files are modelled on.

    Raises:
        PhysXNetError: A file that can't be read or worn, or nothing to wear.
    """
    taken = {"body"}
    garments, notes = [], []
    # One word is a sequence of letters; a path or a garment is none at all.
    wear = [wear] if isinstance(wear, str | pathlib.Path | Garment) else wear
    for word in wear:
        if isinstance(word, Garment):
            garment = word
        elif str(word) in TEMPLATES:
            garment = template(str(word))  # pyright: ignore[reportArgumentType]
        else:
            garment, found = load_garment(word, body=body)
            if found.warning is not None:
                notes.append(found.warning)
        name, count = garment.name, 2
        while name in taken:
            name, count = f"{garment.name}_{count}", count + 1
        taken.add(name)
        garments.append(dataclasses.replace(garment, name=name))
    if not garments:
        raise PhysXNetError("Nothing to wear: name at least one garment.")
    return garments, tuple(notes)
