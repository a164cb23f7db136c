"""The body and its garments as animated meshes."""

import dataclasses
import pathlib
import re
import zlib
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from jaxtyping import Array, Float

from ..body import NUM_BODY_VERTICES, Body
from ..errors import PhysXNetError
from ..frames import all_frames
from ..garment import Garment, load_outfit
from ..io import AnimatedMesh, Skinning
from ..motion import Motion, body_blocks, clip_transforms

Wear = Sequence[Garment | str | pathlib.Path] | Garment | str | pathlib.Path
"""One or several garments, garment files, kinds of the tailor or templates.

Names take options after a colon, see `parse_wear`.
"""

# Display colours as sRGB: of known garments, and of others by their name.
_OWN = {"shirt": 0x6A8FBF, "top": 0x6A8FBF, "tee": 0xC9CED6, "trousers": 0x4A4F5C}
_OWN |= {"bottom": 0x4A4F5C, "shorts": 0x7A6A55, "skirt": 0x5E8F78, "dress": 0xA8505A}
_OWN |= {"aline": 0xA8505A}
_OTHERS = (0x8A6FA8, 0xB8934A, 0x4F8F96, 0x8F9A4E, 0x9A5F86, 0x5A74B0)
_SKIN_COLOUR = (0.69, 0.46, 0.33)


def animated_meshes(
    body: Body,
    clip: Motion,
    shape: Any | None,
    garments: Sequence[Garment],
    positions: Mapping[str, np.ndarray],
    include_body: bool = True,
) -> tuple[AnimatedMesh, ...]:
    """Makes animated meshes of the body (unless left out) and the garments, in this order.

    Args:
        body: The body.
        clip: Its motion.
        shape: Its shape parameters; the default shape if None.
        garments: The garments.
        positions: Positions of each garment by name [m], shape [frames, vertices, 3].
        include_body: Whether to include the body, as the first mesh.
    """
    meshes = []
    if include_body:
        mesh = body.rest_mesh()
        meshes.append(
            AnimatedMesh(
                "body",
                all_frames(clip.num_frames, body_blocks(body, clip, shape)),
                np.asarray(mesh.faces),
                np.asarray(mesh.uv),
                np.asarray(mesh.uv_faces),
                _SKIN_COLOUR,
                skinning=_skinning(body, clip, shape),
            )
        )
    taken: set[int] = set()
    for g in garments:
        uv = None if g.mesh.uv is None else np.asarray(g.mesh.uv)
        uv_faces = None if g.mesh.uv_faces is None else np.asarray(g.mesh.uv_faces)
        colour = _garment_colour(g.name, taken)
        faces = np.asarray(g.mesh.faces)
        meshes.append(
            AnimatedMesh(g.name, positions[g.name], faces, uv, uv_faces, colour, g.polygons)
        )
    return tuple(meshes)


def _skinning(body: Body, clip: Motion, shape: Any | None) -> Skinning:
    rest = body.rest_vertices(body.default_shape() if shape is None else shape)
    rotations, translations = clip_transforms(body, rest, clip)
    return Skinning(
        np.asarray(rest)[:NUM_BODY_VERTICES],
        np.asarray(body.joint_positions(rest)[0]),
        tuple(body.joint_names),
        tuple(body.parents),
        np.asarray(body.weights)[:NUM_BODY_VERTICES],
        rotations,
        translations,
    )


def _garment_colour(name: str, taken: set[int]) -> tuple[float, float, float]:
    """Linear colour of a garment: by its name, unless another one has that colour."""
    kinds = [k for k in _OWN if re.match(rf"{k}(?![a-z])", name.lower())]
    first = zlib.crc32(name.encode()) % len(_OTHERS)
    choices = [*(_OWN[k] for k in kinds[:1]), *_OTHERS[first:], *_OTHERS[:first]]
    code = next((c for c in choices if c not in taken), choices[0])
    taken.add(code)
    r, g, b = ((code >> shift & 255) / 255 for shift in (16, 8, 0))
    return r**2.2, g**2.2, b**2.2


def resolve_garments(
    wear: Wear, body: Body, shape: Float[Array, " shapes"] | None = None
) -> tuple[list[Garment], tuple[str, ...]]:
    """Loads garments, makes their names unique and collects warnings about their files.

    Args:
        wear: One or several garments, garment files, kinds of the tailor or templates.
        body: The body that garment files are modelled on.
        shape: Shape parameters of the person, for whom tailored garments are cut.

    Raises:
        PhysXNetError: A file can't be read or worn, or there is no garment.
    """
    taken = {"body"}
    garments, notes = [], []
    # A string is itself a sequence; a path or a garment isn't one.
    wear = [wear] if isinstance(wear, str | pathlib.Path | Garment) else wear
    for word in wear:
        if isinstance(word, Garment):
            loaded = [word]
        else:
            found = load_outfit(word, body=body, shape=shape)
            loaded = [garment for garment, _ in found]
            notes += [report.warning for _, report in found if report.warning is not None]
            lost = [n for g in loaded if g.polygons for n in g.polygons.lost_images]
            if lost:
                notes.append(f"{word}: its colours are shown without {', '.join(lost)[:200]}.")
            if len(found) > 1:
                names = ", ".join(f"{g.name} ({g.template})" for g in loaded)
                notes.append(f"{word}: holds {len(found)} garments, worn in layers: {names}.")
        for garment in loaded:
            name, count = garment.name, 2
            while name in taken:
                name, count = f"{garment.name}_{count}", count + 1
            taken.add(name)
            garments.append(dataclasses.replace(garment, name=name))
    if not garments:
        raise PhysXNetError("Nothing to wear: name at least one garment.")
    return garments, tuple(notes)
