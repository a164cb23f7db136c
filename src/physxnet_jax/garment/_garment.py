"""Garments: rest mesh, material, pins and attachment to the body."""

import dataclasses
from typing import Any, Literal

import jax
import jax.core
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from ..errors import MeshError, check_numbers
from ..geometry import Polygons, TriMesh
from ..typing import pytree

Template = Literal["top", "bottom", "dress"]
TEMPLATES: tuple[Template, ...] = ("top", "bottom", "dress")


@dataclasses.dataclass(frozen=True)
class Fabric:
    """Material parameters of a fabric.

    Attributes:
        density: Mass per area [kg/m^2].
        stretch: Membrane stiffness of springs along edges [N/m].
        bend: Bending stiffness [N m].
        thickness: Smallest gap kept between cloth and skin [m]; over convex skin large triangles
            keep more.
        friction: Coulomb coefficient between cloth and skin [1].
        warp: Stiffness of the membrane along the warp [N/m]; ``stretch`` if None.
        weft: Stiffness of the membrane along the weft [N/m]; ``stretch`` if None.
        shear: Shear stiffness [N/m]; a thirtieth of ``stretch`` if None, because woven
            threads rotate easily about each other.
    """

    density: float = 0.15
    stretch: float = 2000.0
    bend: float = 2e-5
    thickness: float = 0.004
    friction: float = 0.3
    warp: float | None = None
    weft: float | None = None
    shear: float | None = None

    def __post_init__(self) -> None:
        check_numbers(self, "density", "stretch", "warp", "weft", "shear")
        check_numbers(self, "bend", "thickness", "friction", zero=True)

    @property
    def is_directional(self) -> bool:
        """Whether warp, weft or shear have stiffnesses of their own."""
        return (self.warp, self.weft, self.shear) != (None, None, None)

    @property
    def membrane(self) -> tuple[float, float, float]:
        """Stiffness along warp, weft and in shear [N/m]."""
        return (
            self.stretch if self.warp is None else self.warp,
            self.stretch if self.weft is None else self.weft,
            self.stretch / 30 if self.shear is None else self.shear,
        )


COTTON = Fabric()
"""A light woven cotton of 150 g/m^2.

Bending is from the middle of the published range for shirtings (1 to 5 x 10^-5 N m).
``stretch`` is as stiff as 32 substeps can resolve.
"""

FABRICS: dict[str, Fabric] = {
    "cotton": COTTON,
    "denim": Fabric(0.40, 4000.0, 1.2e-4, 0.005, 0.40, 9000.0, 6000.0, 200.0),
    "silk": Fabric(0.07, 1500.0, 2e-6, 0.003, 0.20, 3500.0, 2500.0, 25.0),
    "wool": Fabric(0.23, 1500.0, 1.5e-5, 0.005, 0.35, 2500.0, 1800.0, 50.0),
    "jersey": Fabric(0.18, 400.0, 4e-6, 0.004, 0.35, 500.0, 250.0, 40.0),
    "leather": Fabric(0.75, 6000.0, 9e-5, 0.006, 0.45, 8000.0, 8000.0, 2500.0),
}
"""Fabrics by name; ``leather`` is soft garment leather.

Density, bending, warp, weft and shear lie within the ranges that the Kawabata evaluation
system gives for such cloth (bending 0.02 to 1.5 gf cm^2/cm, shear 0.3 to 4 gf/cm degree,
secant modulus up to 500 gf/cm; Kawabata, The standardization and analysis of hand
evaluation, 1980; 1 gf cm^2/cm = 9.8e-5 N m, 1 gf/cm degree = 56 N/m). Within those ranges,
bending puts Cusick's drape coefficient into its published band (`drape_test`).
``stretch`` is the stiffness that edge springs can resolve at 32 substeps.
"""


@pytree
@dataclasses.dataclass(frozen=True)
class Garment:
    """A garment at rest, on the body in its rest pose.

    Attributes:
        mesh: Rest mesh [m].
        pinned: Vertices that follow the body's skin, shape [vertices].
        refs: Body (helper) vertices that each vertex is attached to, shape [vertices, k].
        ref_weights: Their weights, rows sum to 1, shape [vertices, k].
        offset: Offset from their weighted mean [m], shape [vertices, 3].
        skin: Skinning weights, rows sum to 1, shape [vertices, joints].
        fabric: Material.
        template: Template whose map dresses this garment.
        name: Name used in tables and files.
        polygons: Polygons and materials of the source file, for writing; None if there are
            only triangles.
        coarse_faces: Triangles of the mesh that this one refines, on its first vertices. They,
            too, are kept off the skin. None if it refines none.
        loops: Edges of named curves around it (``waist``, ``hem``), each of shape [edges, 2].
        elastic: Names of the loops that are sewn to an elastic band.
    """

    mesh: TriMesh
    pinned: Bool[Array, " vertices"]
    refs: Int[Array, "vertices k"]
    ref_weights: Float[Array, "vertices k"]
    offset: Float[Array, "vertices 3"]
    skin: Float[Array, "vertices joints"]
    fabric: Fabric = dataclasses.field(metadata={"static": True})
    template: Template = dataclasses.field(metadata={"static": True})
    name: str = dataclasses.field(metadata={"static": True})
    polygons: Polygons | None = dataclasses.field(default=None, metadata={"static": True})
    coarse_faces: Int[Array, "coarse 3"] | None = None
    loops: dict[str, Int[Array, "edges 2"]] = dataclasses.field(default_factory=dict)
    elastic: tuple[str, ...] = dataclasses.field(default=(), metadata={"static": True})

    def with_pins(self, vertices: Int[np.ndarray, " pins"]) -> "Garment":
        """The garment with further vertices that follow the body's skin.

        Args:
            vertices: Their numbers.

        Raises:
            MeshError: There is no such vertex.
        """
        if len(vertices) and not 0 <= vertices.min() <= vertices.max() < self.num_vertices:
            wrong = vertices.max() if vertices.min() >= 0 else vertices.min()
            raise MeshError(
                f"{self.name}: no vertex {wrong}; its {self.num_vertices} vertices are numbered"
                " from 0."
            )
        pinned = np.array(self.pinned)
        pinned[vertices] = True
        return dataclasses.replace(self, pinned=jax.device_put(pinned))

    @property
    def num_vertices(self) -> int:
        """Number of vertices."""
        return self.mesh.vertices.shape[0]

    def rest_vertices(self, rest: Float[Array, "all 3"]) -> Float[Array, "vertices 3"]:
        """Rest positions on a body of another shape.

        Args:
            rest: `Body.rest_vertices` of that shape [m].

        Returns:
            Positions [m]: the weighted mean of the reference vertices plus the offset.

        References:
            MakeHuman's mhclo files attach clothes in the same way.
        """
        arrays = (rest, self.refs, self.ref_weights, self.offset)
        if any(isinstance(x, jax.core.Tracer) for x in arrays):
            return _carried(jnp.sum, *arrays)
        # Not as one program, which would round otherwise than where the offsets were made.
        return jax.device_put(_carried(np.sum, *map(np.asarray, arrays)))


def _carried(total: Any, rest: Any, refs: Any, weights: Any, offset: Any) -> Any:
    return total(rest[refs] * weights[:, :, None], axis=1) + offset


@jax.jit
def carried_weights(
    body_weights: Float[Array, "all joints"],
    refs: Int[Array, "vertices k"],
    ref_weights: Float[Array, "vertices k"],
) -> Float[Array, "vertices joints"]:
    """Skinning weights of vertices attached to body vertices; rows sum to 1."""
    mixed = jnp.sum(body_weights[refs] * ref_weights[:, :, None], axis=1)
    return mixed / jnp.sum(mixed, axis=1, keepdims=True)
