"""Outfits: garments cut to measure for a person, worn together."""

import dataclasses
import functools
from typing import Any

from jax.core import eval_context
from jaxtyping import Array, Float

from ..body import load_body
from ..errors import PhysXNetError
from ..garment import FABRICS, KINDS, Garment, Template, parse_wear, tailor, template


@dataclasses.dataclass(frozen=True, kw_only=True)
class Outfit:
    """Garments worn together, and the person who wears them.

    Attributes:
        wear: Garments of the tailor as `parse_wear` reads them, innermost first; one of each
            template at most.
        shape: The person's shape parameters, as ``name=value``.
    """

    wear: tuple[str, ...]
    shape: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        if not self.wear:
            raise ValueError("an outfit has no garment; list some in wear.")
        for word in self.wear:
            if parse_wear(word).name not in KINDS:
                raise ValueError(f"the tailor makes no '{word}'; there are {', '.join(KINDS)}.")
            if parse_wear(word).fabric not in (None, *FABRICS):
                raise ValueError(f"{word}: the fabric of an outfit is one of {', '.join(FABRICS)}.")
        for word in self.shape:
            _, _, value = word.partition("=")
            try:
                float(value)
            except ValueError:
                raise ValueError(
                    f"shape is '{word}', expected name=value, as in weight_up=0.5."
                ) from None

    def params(self) -> Float[Array, " shapes"]:
        """The person's shape parameters, see `Body.shape`."""
        return person_shape(self.shape)

    def garments(self) -> dict[str, Garment]:
        """The garments by template, innermost first.

        Raises:
            PhysXNetError: Two garments of one template, or a measure out of range.
        """
        return _garments(self)


def person_shape(words: tuple[str, ...]) -> Float[Array, " shapes"]:
    """Shape parameters from ``name=value``, see `Body.shape`."""
    pairs = (word.partition("=") for word in words)
    return load_body().shape(**{name: float(value) for name, _, value in pairs})


@functools.lru_cache(maxsize=64)
def _garments(outfit: Outfit) -> dict[str, Garment]:
    out: dict[str, Garment] = {}
    # Cached arrays mustn't be tracers of an enclosing transformation.
    with eval_context():
        params = outfit.params()
        for word in outfit.wear:
            item = parse_wear(word)
            options: dict[str, Any] = {**item.measures, "fabric": item.fabric, "hold": item.hold}
            garment = tailor(item.name, shape=params, **options)
            if garment.template in out:
                raise PhysXNetError(
                    f"{', '.join(outfit.wear)}: two garments of the template"
                    f" '{garment.template}'; an outfit of a dataset has one of each."
                )
            out[garment.template] = garment
    return out


@dataclasses.dataclass(frozen=True, kw_only=True)
class Worn:
    """One garment of an outfit.

    Attributes:
        outfit: The outfit.
        template: The garment's template.
    """

    outfit: Outfit
    template: str


Clothing = Template | Worn
"""A template on the default shape, or a garment of an outfit."""


def garment_of(clothing: Clothing) -> Garment:
    """The garment itself."""
    if isinstance(clothing, Worn):
        return clothing.outfit.garments()[clothing.template]
    return template(clothing)


def shape_of(clothing: Clothing) -> Float[Array, " shapes"]:
    """Shape parameters of whoever wears it."""
    if isinstance(clothing, Worn):
        return clothing.outfit.params()
    return load_body().default_shape()


def read_outfit(found: Any) -> Outfit | None:
    """The outfit that an action stores; None for a template."""
    if found is None:
        return None
    return Outfit(wear=tuple(map(str, found["wear"])), shape=tuple(map(str, found["shape"])))
