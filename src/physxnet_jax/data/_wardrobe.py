"""All garments and persons of a dataset, numbered."""

import dataclasses
from collections.abc import Iterable, Sequence as Items

from jaxtyping import Array, Float

from ..body import load_body
from ..garment import Garment, template
from ._outfit import Outfit, person_shape


@dataclasses.dataclass(frozen=True)
class Wardrobe:
    """The garments and persons of sequences.

    Attributes:
        outfits: Distinct outfits; None stands for the templates on the default shape.
        garments: For each template the distinct garments.
        numbers: For each template and outfit the garment's place there.
        persons: Distinct shapes, as in `Outfit`.
    """

    outfits: tuple[Outfit | None, ...]
    garments: dict[str, tuple[Garment, ...]]
    numbers: dict[tuple[str, Outfit | None], int]
    persons: tuple[tuple[str, ...], ...]

    def num_vertices(self, name: str) -> int:
        """Vertices of the largest garment of a template."""
        return max((g.num_vertices for g in self.garments[name]), default=1)

    def person(self, outfit: Outfit | None) -> int:
        """The number of an outfit's person."""
        return self.persons.index(() if outfit is None else outfit.shape)

    def rests(self) -> list[Float[Array, "all 3"]]:
        """Rest vertices of the persons [m]."""
        body = load_body()
        return [body.rest_vertices(person_shape(p)) for p in self.persons]


def make_wardrobe(outfits: Iterable[Outfit | None], templates: Items[str]) -> Wardrobe:
    """Numbers what the given outfits consist of, in the order in which they come."""
    distinct = tuple(dict.fromkeys(outfits))
    garments: dict[str, list[Garment]] = {t: [] for t in templates}
    numbers: dict[tuple[str, Outfit | None], int] = {}
    for outfit in distinct:
        for name in templates:
            if outfit is None:
                garment = template(name)  # pyright: ignore[reportArgumentType]
            elif name in outfit.garments():
                garment = outfit.garments()[name]
            else:
                continue
            numbers[name, outfit] = len(garments[name])
            garments[name].append(garment)
    persons = dict.fromkeys(() if o is None else o.shape for o in distinct)
    return Wardrobe(
        distinct, {t: tuple(g) for t, g in garments.items()}, numbers, tuple(persons) or ((),)
    )
