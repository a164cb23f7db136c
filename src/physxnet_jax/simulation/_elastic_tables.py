"""The elastic energy of a garment as plain tables, for a loss over many garments."""

import dataclasses
from collections.abc import Sequence

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from ..garment import Garment
from ..typing import pytree
from ._scene import Scene, make_system, prepare_scene
from ._xpbd import XPBD
from .effects import Bend, Stretch

_G = 9.81


@pytree
@dataclasses.dataclass(frozen=True, kw_only=True)
class ElasticTables:
    """Springs and hinges of one garment or, with a first axis, of several, padded.

    Attributes:
        ends: Vertices of each edge, shape [edges, 2].
        length: Rest lengths [m], shape [edges].
        stretch: Stiffness of edges in tension [N/m]; 0 for padding.
        corners: Vertices of each hinge, shape [hinges, 4].
        coefficient: Their coefficients in its curvature, shape [hinges, 4].
        bend: Stiffness of hinges [N/m]; 0 for padding.
        compression: Stiffness of edges in compression relative to that in tension [1].
        mass: Mass of the garment [kg].
    """

    ends: Int[Array, "*garments edges 2"]
    length: Float[Array, "*garments edges"]
    stretch: Float[Array, "*garments edges"]
    corners: Int[Array, "*garments hinges 4"]
    coefficient: Float[Array, "*garments hinges 4"]
    bend: Float[Array, "*garments hinges"]
    compression: Float[Array, "*garments"]
    mass: Float[Array, "*garments"]

    def energy(self, x: Float[Array, "vertices 3"]) -> Float[Array, ""]:
        """Elastic energy of one garment at vertex positions [J]; that of `Stretch` and `Bend`."""
        a, b = (x[self.ends[:, k]] for k in range(2))
        length = jnp.sqrt(jnp.sum((b - a) ** 2, axis=1) + 1e-18)
        excess = length - self.length
        stiffness = self.stretch * jnp.where(excess < 0, self.compression, 1.0)
        first = x[self.corners[:, 0]]
        parts = (self.coefficient[:, k, None] * (x[self.corners[:, k]] - first) for k in range(4))
        curvature = sum(parts, jnp.zeros_like(first))
        bending = self.bend * jnp.sum(curvature**2, axis=1)
        return 0.5 * (jnp.sum(stiffness * excess**2) + jnp.sum(bending))

    def lift(self, height: float) -> Float[Array, "*garments"]:
        """What it takes to lift the garment [J].

        Args:
            height: By how much [m].
        """
        return _G * height * self.mass


def elastic_tables(
    garments: Sequence[Garment], shapes: Sequence[Float[Array, " shapes"] | None]
) -> ElasticTables:
    """Tables of several garments, padded to the largest.

    Args:
        garments: Garments.
        shapes: Shape parameters of the body that wears each; the default if None.
    """
    return _stacked([_tables_of(g, s) for g, s in zip(garments, shapes, strict=True)])


def _tables_of(garment: Garment, shape: Float[Array, " shapes"] | None) -> ElasticTables:
    scene = prepare_scene(Scene((garment,), (Stretch(), Bend()), None, shape))
    stretch, bend = make_system(scene, XPBD()).effects
    s, h = stretch.springs, bend.hinges  # pyright: ignore[reportAttributeAccessIssue]
    return ElasticTables(
        ends=jnp.stack(s.ends, axis=1),
        length=s.length[:, 0, 0],
        stretch=1.0 / s.compliance[:, 0, 0],
        corners=jnp.stack(h.index, axis=1),
        coefficient=jnp.concatenate([c[:, :, 0] for c in h.coefficient], axis=1),
        bend=1.0 / h.compliance[:, 0, 0],
        compression=jnp.float32(1.0 / stretch.softer),  # pyright: ignore[reportAttributeAccessIssue]
        mass=jnp.float32(scene.assembly.mass.sum()),
    )


def _stacked(tables: Sequence[ElasticTables]) -> ElasticTables:
    """Padding has zero stiffness, and joins vertex 0 to itself."""

    def one(name: str) -> Array:
        rows = [np.asarray(getattr(t, name)) for t in tables]
        most = max((r.shape[0] for r in rows if r.ndim), default=0)
        padded = [
            np.pad(r, [(0, most - len(r)), *[(0, 0)] * (r.ndim - 1)]) if r.ndim else r for r in rows
        ]
        return jax.device_put(np.stack(padded))

    return ElasticTables(**{f.name: one(f.name) for f in dataclasses.fields(ElasticTables)})
