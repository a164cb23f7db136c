"""Variations of a dresser as pure functions: another body shape, cut or fabric."""

import dataclasses
from collections.abc import Mapping

from jaxtyping import Array, Float

from ..errors import PhysXNetError
from ..garment import SkinnedGarment
from ..models import BoundGarment
from ._dresser import Dresser
from ._guided import reshape_guided
from .postprocess import reshape_colliders, reshape_strain


def with_shape(dresser: Dresser, shape: Float[Array, " shapes"]) -> Dresser:
    """Changes the body shape of a dresser; pure, for `jax.vmap` and `jax.grad` over shapes.

    Garments follow the shape as in `Garment.rest_vertices`. A single garment that a network
    predicts gives the same result as `make_dresser` with the shape. With several garments, the
    clearance between layers stays that of the previous shape; in a guided simulation the skin that
    contact compares does, see `System.reshaped`. A cut of `with_cut` is given up, as it was made
    for the shape before: change the shape first. Garments that are cut to measure follow the shape
    as they are; `make_dresser` cuts those that are given by name anew.

    Args:
        dresser: From `make_dresser`.
        shape: Shape parameters, see `Body.shape`.

    Returns:
        The dresser for that shape.

    Raises:
        PhysXNetError: A parameter is outside its limits.
        ValueError: The number of parameters is wrong; or a network of the ``paper`` family
            predicts a dress, whose offsets start from a body with joined legs: use `make_dresser`
            with the shape instead.

    Example:
        >>> from physxnet_jax import make_dresser
        >>> person = make_dresser(["trousers"])
        >>> tall = with_shape(person, person.body.shape(height_up=0.5))
        >>> bool(tall.worn[0].rest[:, 1].max() > person.worn[0].rest[:, 1].max())
        True
    """
    rest = dresser.body.rest_vertices(dresser.body.checked_shape(shape))
    cloth = tuple(g.rest_vertices(rest) for g in dresser.garments)
    return _varied(dresser, rest, cloth)


def with_cut(dresser: Dresser, cut: Mapping[str, Float[Array, "vertices 3"]]) -> Dresser:
    """Changes the rest shape of garments; pure, for `jax.grad` by a tailor's measures.

    The mesh stays, as does what the network sees of the garment: only its cloth is another. After
    a large change, `make_dresser` with the new garment is more accurate.

    Args:
        dresser: From `make_dresser`.
        cut: Rest positions of vertices [m] by name of the garment, on the dresser's body, such as
            `cut_vertices` gives; other garments stay.

    Returns:
        The dresser with that cloth.

    Raises:
        PhysXNetError: No garment has such a name, or its mesh another number of vertices.

    Example:
        >>> from physxnet_jax import make_dresser
        >>> from physxnet_jax.garment import cut_vertices
        >>> person = make_dresser(["shorts"], method="lbs")
        >>> wide = cut_vertices("shorts", {"ease": 0.2})
        >>> bool((with_cut(person, {"shorts": wide}).worn[0].rest == wide).all())
        True
    """
    known = dict(zip([w.name for w in dresser.worn], _whole(dresser), strict=True))
    for name, vertices in cut.items():
        if name not in known:
            raise PhysXNetError(f"No garment '{name}' is worn, only {', '.join(known)}.")
        if vertices.shape != known[name].shape:
            raise PhysXNetError(
                f"{name}: {len(vertices)} vertices for a mesh of {len(known[name])}."
            )
    cloth = tuple(cut.get(n, x) for n, x in known.items())
    return _varied(dresser, dresser.rest, cloth)


def with_fabric(dresser: Dresser, **factors: Float[Array, ""] | float) -> Dresser:
    """Scales the stiffnesses of simulated cloth; pure, for `jax.grad` by the fabric.

    What the network sees of the fabric stays.

    Args:
        dresser: From ``make_dresser(..., method="guided")``.
        **factors: See `System.rescaled`: ``stretch``, ``bend``, ``friction``.

    Raises:
        PhysXNetError: The dresser simulates nothing.
        SimulationError: There is no such parameter, or it isn't positive.
    """
    if dresser.guided is None:
        raise PhysXNetError('only simulated cloth has a fabric: use method="guided".')
    system = dresser.guided.system.rescaled(**factors)
    return dataclasses.replace(dresser, guided=dresser.guided.with_system(system))


def _whole(dresser: Dresser) -> tuple[Float[Array, "_ 3"], ...]:
    """Rest vertices of each garment, of fine meshes all [m]."""
    pairs = zip(dresser.sites, dresser.worn, strict=True)
    return tuple(w.rest if s is None else s.whole.rest for s, w in pairs)


def _varied(
    dresser: Dresser, rest: Float[Array, "all 3"], cloth: tuple[Float[Array, "_ 3"], ...]
) -> Dresser:
    """The dresser with other rest vertices of the body and of each whole garment."""
    predictor, pairs = dresser.predictor, list(zip(dresser.sites, cloth, strict=True))
    sites = tuple(s and s.at_rest(x) for s, x in pairs)
    chosen = (x if s is None else x[s.rows] for s, x in pairs)
    worn: tuple[SkinnedGarment, ...] = tuple(
        dataclasses.replace(w, rest=x) for w, x in zip(dresser.worn, chosen, strict=True)
    )
    if predictor is not None:
        skirts = any(w.template == "dress" for w in worn)
        if skirts and predictor.config.family == "paper":
            raise ValueError("dresses of the paper family: use make_dresser(..., shape=shape).")
        points = dataclasses.replace(
            predictor.texel_points, rest=predictor.motion_atlas.at_texels(rest)
        )
        predictor = dataclasses.replace(predictor, texel_points=points)
        worn = tuple(
            dataclasses.replace(w, anchor=w.binding.to_body @ rest)
            for w in worn
            if isinstance(w, BoundGarment)
        )
    strain, colliders, guided = dresser.strain, dresser.colliders, dresser.guided
    return dataclasses.replace(
        dresser,
        rest=rest,
        predictor=predictor,
        worn=worn,
        sites=sites,
        strain=None if strain is None else reshape_strain(strain, worn),
        colliders=None if colliders is None else reshape_colliders(colliders, dresser.body, rest),
        guided=None if guided is None else reshape_guided(guided, dresser.body, rest, worn),
    )
