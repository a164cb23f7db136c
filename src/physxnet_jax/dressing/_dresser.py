"""The dresser: all state of inference, loaded and bound once."""

import dataclasses
import functools
from collections.abc import Sequence
from typing import Literal, get_args

from jaxtyping import Array, Float, Int

from ..body import Body, load_body
from ..devices import prepared_on_processor, side_by_side
from ..errors import PhysXNetError, WeightsError
from ..garment import Garment, SkinnedGarment, make_skinned
from ..geometry import map_frames
from ..models import (
    BoundGarment,
    Predictor,
    at_precision,
    bind_garment,
    load_predictor,
    make_texel_points,
    with_mirror_tta,
)
from ..typing import pytree
from ..uv import bind, condition_maps
from ._guided import GuidedScene, prepare_guided
from ._inference import Inference
from ._meshes import Wear, resolve_garments
from ._simulate import Simulation
from .postprocess import (
    BodyCollider,
    Cloth,
    Layer,
    Outfit,
    Sites,
    StrainLimits,
    garment_at_sites,
    make_sites,
    prepare_collisions,
    prepare_layers,
    prepare_strain,
)

Precision = Literal["float32", "bfloat16"]
Predicted = Literal["network", "guided", "lbs"]


@pytree
@dataclasses.dataclass(frozen=True, kw_only=True)
class Dresser:
    """The complete state of inference: garments that can be evaluated in any pose.

    Attributes:
        body: The body.
        rest: Its rest vertices [m], shape [all, 3].
        predictor: The network with batch norm folded; None for skinning alone.
        worn: Garments on the body shape, bound to the predictor's atlas if there is one; those of
            fine meshes at their sites.
        strain: Strain limits; None if they aren't requested.
        colliders: The skin near each garment; None if collisions aren't resolved.
        layers: Pairs of garments whose order is enforced; None if collisions aren't resolved.
        garments: The garments on the default shape, with their meshes.
        sites: For each garment with a fine mesh, the vertices at which cloth is computed; None for
            others.
        guided: What simulates the garments, drawn to the prediction; None if it is the result.
        notes: Remarks on garment files. They aren't part of the pytree: a dresser that a
            transformed function returns has none.
    """

    body: Body
    rest: Float[Array, "all 3"]
    predictor: Predictor | None
    worn: tuple[SkinnedGarment, ...]
    strain: StrainLimits | None
    colliders: tuple[BodyCollider, ...] | None
    layers: tuple[Layer, ...] | None
    garments: tuple[Garment, ...]
    sites: tuple[Sites | None, ...]
    guided: GuidedScene | None = None
    notes: tuple[str, ...] = dataclasses.field(default=(), metadata={"drop": True})

    @property
    def faces(self) -> tuple[Int[Array, "faces 3"], ...]:
        """Triangles of each garment, shape [faces, 3]."""
        return tuple(g.mesh.faces for g in self.garments)

    def history_length(self, fps: float = 30.0) -> int:
        """Number of frames that prediction needs before the first one, at a frame rate."""
        if self.predictor is None:
            return 0
        return self.predictor.config.inputs.at_rate(fps).window - 1

    def seen(self, fps: float = 30.0) -> tuple[int, ...]:
        """How many frames back the poses lie that a frame depends on, see `FeatureConfig.seen`."""
        return (0,) if self.predictor is None else self.predictor.config.inputs.at_rate(fps).seen

    @property
    def outfit(self) -> Outfit:
        """The input from which post-processing steps are prepared: fine meshes at their sites."""
        return Outfit(self.body, self.rest, self.worn, _at_sites(self.sites, self.garments))

    def expand(
        self,
        cloth: Cloth,
        rotations: Float[Array, "frames joints 3 3"],
        translations: Float[Array, "frames joints 3"],
    ) -> Cloth:
        """Fine meshes with all their vertices [m], see `Sites.expand`; others are unchanged."""
        every = zip(self.sites, self.worn, cloth, strict=True)
        return tuple(
            x
            if s is None
            else map_frames(functools.partial(s.expand, w), x, rotations, translations)
            for s, w, x in every
        )


def _at_sites(sites: tuple[Sites | None, ...], garments: Sequence[Garment]) -> tuple[Garment, ...]:
    return tuple(garment_at_sites(s, g) for s, g in zip(sites, garments, strict=True))


@prepared_on_processor
def make_dresser(
    wear: Wear = ("shirt", "trousers"),
    *,
    method: Predicted = "network",
    inference: Inference | None = None,
    simulation: Simulation | None = None,
    body: Body | None = None,
    shape: Float[Array, " shapes"] | None = None,
    precision: Precision = "float32",
) -> Dresser:
    """Loads weights, binds garments and prepares post-processing, once for all poses.

    Args:
        wear: Garments, garment files or template names. Tops are worn over dresses, dresses
            over trousers; of garments of one type later ones are outer.
        method: ``network``; ``guided`` for a few substeps of simulation drawn to it; or ``lbs`` for
            skinning alone (never strain limited).
        inference: Weights and post-processing, which ``guided`` leaves to the simulation; the
            defaults of `Inference` if omitted.
        simulation: Effects and ``substeps`` of ``guided``; its engine is ``xpbd``.
        body: The body; the built-in one by default.
        shape: Shape parameters; the default shape if omitted.
        precision: Precision of the network's arithmetic; everything else stays float32.

    Returns:
        The dresser, a pytree that `clothe` and `clothe_step` take.

    Raises:
        PhysXNetError: An input can't be read or bound; the message states the reason.

    Example:
        >>> make_dresser(["bottom"], method="lbs").predictor is None
        True
    """
    body = load_body() if body is None else body
    garments, notes = resolve_garments(wear, body, shape)
    return dress_garments(
        [move_to_body(body, g) for g in garments],
        notes,
        method=method,
        inference=inference,
        simulation=simulation,
        body=body,
        shape=shape,
        precision=precision,
    )


@prepared_on_processor
def dress_garments(
    garments: list[Garment],
    notes: tuple[str, ...] = (),
    *,
    method: Predicted = "network",
    inference: Inference | None = None,
    simulation: Simulation | None = None,
    body: Body,
    shape: Float[Array, " shapes"] | None = None,
    precision: Precision = "float32",
) -> Dresser:
    """`make_dresser` for garments that are already on the body."""
    for name, value, kind in (("method", method, Predicted), ("precision", precision, Precision)):
        if value not in get_args(kind):
            there = ", ".join(get_args(kind))
            raise PhysXNetError(f"No {name} '{value}' here; there are {there}.")
    inference = Inference() if inference is None else inference
    rest = body.rest_vertices(body.checked_shape(shape))
    sites = tuple(make_sites(g, rest) for g in garments)
    coarse = _at_sites(sites, garments)
    if method == "lbs":
        predictor = None
        inference = dataclasses.replace(inference, strain_iterations=0)
        worn = tuple(make_skinned(g, rest) for g in coarse)
    else:
        predictor = with_body(_predictor(inference), body, rest)
        predictor = at_precision(predictor, precision)
        own = predictor

        def bound(g: Garment) -> BoundGarment:
            return bind_to_predictor(own, body, rest, g)

        worn = tuple(side_by_side(bound, coarse))
    outfit, guided = Outfit(body, rest, worn, coarse), None
    if method == "guided":
        # The simulation has strain, contact and layers of its own.
        inference = dataclasses.replace(inference, strain_iterations=0, collisions=False)
        simulation = Simulation() if simulation is None else simulation
        guided = prepare_guided(outfit, shape, simulation)
    return Dresser(
        body=body,
        rest=rest,
        predictor=predictor,
        worn=worn,
        strain=prepare_strain(outfit, inference),
        colliders=prepare_collisions(outfit, inference),
        layers=prepare_layers(outfit, inference),
        garments=tuple(garments),
        sites=sites,
        guided=guided,
        notes=notes,
    )


def _predictor(inference: Inference) -> Predictor:
    weights = inference.weights
    predictor = weights if isinstance(weights, Predictor) else load_predictor(weights)
    if not inference.tta or predictor.mirror_tta:
        return predictor
    try:
        return with_mirror_tta(predictor)
    except ValueError as error:
        name = "weights" if isinstance(weights, Predictor) else weights
        raise WeightsError(f"{name}: {error}") from None


def with_body(predictor: Predictor, body: Body, rest: Float[Array, "all 3"]) -> Predictor:
    """Returns the predictor with its texel points on a body shape.

    Args:
        predictor: A predictor on any shape.
        body: The body.
        rest: `Body.rest_vertices` of the shape [m].
    """
    points = make_texel_points(predictor.motion_atlas, body, rest, predictor.texel_points.valid)
    return dataclasses.replace(predictor, texel_points=points)


def move_to_body(body: Body, garment: Garment) -> Garment:
    """Moves a garment's mesh onto this body at rest.

    Templates are always modelled on the built-in body.
    """
    if body is load_body():
        return garment
    vertices = garment.rest_vertices(body.rest_vertices(body.default_shape()))
    return dataclasses.replace(garment, mesh=garment.mesh.replace(vertices=vertices))


def bind_to_predictor(
    predictor: Predictor, body: Body, rest: Float[Array, "all 3"], garment: Garment
) -> BoundGarment:
    """Binds a garment to a predictor's atlas, on a body shape.

    Raises:
        PhysXNetError: The predictor has no decoder for the garment's template.
    """
    if garment.template not in predictor.config.templates:
        raise PhysXNetError(
            f"{garment.name}: the weights have no decoder for '{garment.template}', only"
            f" {', '.join(predictor.config.templates)}. Use other weights or --method lbs."
        )
    # Garments are modelled, and therefore bound, on the default shape.
    base = body.rest_vertices(body.default_shape())
    valid = predictor.texel_points.valid[garment.template]
    atlas, config = predictor.atlas, predictor.config
    binding = bind(garment, atlas=atlas, body=body, rest=base, valid=valid)
    worn = bind_garment(body, rest, garment, binding, smooth=not config.skirt_chart)
    if not config.conditions:
        return worn
    conditions = condition_maps(atlas, body, base, garment, binding, config.fabrics)
    return dataclasses.replace(worn, modulation=predictor.modulation(garment.template, conditions))
