"""The paper's matrices and maps, equations 1 to 9, for one garment."""

import dataclasses

from jaxtyping import Array, Float

from ..body import NUM_BODY_VERTICES, Body, load_body
from ..garment import Garment, Template, template
from ..typing import pytree
from ._atlas import Atlas, make_atlas
from ._bind import Binding, bind, garment_map_rows
from ._maps import acceleration_maps, cloth_offsets, velocity_maps
from ._transference import Transference


@pytree
@dataclasses.dataclass(frozen=True, kw_only=True)
class Transferences:
    """The paper's transference matrices of one garment.

    Attributes:
        atlas: The atlas of all maps.
        T_BC: From garment vertices to texels, by rays from the skin (equation 8); ``valid``
            where the ray hit cloth.
        binding: Texels that garment vertices sample, with counts of fallbacks.
        garment: The garment.
    """

    atlas: Atlas
    T_BC: Transference
    binding: Binding
    garment: Garment

    @property
    def T_UB(self) -> Transference:
        """From body vertices to texels (equation 5)."""
        return self.atlas.to_body

    @property
    def T_XB(self) -> Transference:
        """From body vertices to garment vertices, by rays from the garment (equation 9)."""
        return self.binding.to_body


@pytree
@dataclasses.dataclass(frozen=True, kw_only=True)
class BodyMaps:
    """The paper's body maps; zero where the atlas has no skin.

    Attributes:
        position: I_B [m], shape [frames, height, width, 3].
        velocity: I_v [m/s], likewise.
        acceleration: I_a [m/s^2], likewise.
    """

    position: Float[Array, "frames height width 3"]
    velocity: Float[Array, "frames height width 3"]
    acceleration: Float[Array, "frames height width 3"]


def transference(
    garment: Garment | Template, *, resolution: int = 256, body: Body | None = None
) -> Transferences:
    """All transference matrices of a garment on the body at rest.

    Args:
        garment: A garment, or the name of a template.
        resolution: Texels a side.
        body: The body; the built-in one by default.

    Returns:
        T_UB, T_BC and T_XB, with the atlas of their texels.

    Example:
        >>> t = transference("top", resolution=64)
        >>> t.T_XB.shape == (t.garment.num_vertices, 13380)
        True

    References:
        PhysXNet, equations 3, 5, 8 and 9.

    Note (differs from the paper):
        Rays are cast in the rest pose (arms 45 degrees down) in which garments are modelled.
    """
    garment = template(garment) if isinstance(garment, str) else garment
    body = load_body() if body is None else body
    rest = body.rest_vertices(body.default_shape())
    atlas = make_atlas(resolution, body)
    to_cloth = garment_map_rows(atlas, body, rest, garment)
    binding = bind(garment, atlas=atlas, body=body, rest=rest)
    return Transferences(
        atlas=atlas,
        T_BC=to_cloth,
        binding=binding,
        garment=garment,
    )


def body_maps(
    matrices: Transferences, vertices: Float[Array, "frames all 3"], fps: float
) -> BodyMaps:
    """UV maps of the body's surface, its velocity and its acceleration; pure.

    Args:
        matrices: From `transference`.
        vertices: Body vertices M_B of successive frames [m].
        fps: Frames a second.

    References:
        PhysXNet, equations 5 to 7.

    Note (differs from the paper):
        Differences are scaled by the frame rate; the first frame is its own predecessor.
    """
    points = matrices.T_UB @ vertices[:, :NUM_BODY_VERTICES]
    to_map = matrices.atlas.to_map
    return BodyMaps(
        position=to_map(points),
        velocity=to_map(velocity_maps(points, fps)),
        acceleration=to_map(acceleration_maps(points, fps)),
    )


def garment_map(
    matrices: Transferences,
    cloth: Float[Array, "frames vertices 3"],
    body_vertices: Float[Array, "frames all 3"],
) -> Float[Array, "frames height width 3"]:
    """I_C: UV maps of offsets from skin to cloth [m], zero where no ray hit; pure.

    Args:
        matrices: From `transference`.
        cloth: Garment vertices M_C of successive frames [m].
        body_vertices: Body vertices M_B of the same frames [m]; for a dress those of the body
            with joined legs, M_Bd.

    References:
        PhysXNet, equation 8.
    """
    skin = body_vertices[:, :NUM_BODY_VERTICES]
    points = matrices.T_UB @ skin
    return matrices.atlas.to_map(cloth_offsets(matrices.T_BC, cloth, points))
