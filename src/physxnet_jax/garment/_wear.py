"""Parses garment specifications of the form ``NAME[:key=value,...]``."""

import dataclasses
import pathlib
import re
from collections.abc import Sequence

from ..errors import PhysXNetError
from ._fabric import find_fabric
from ._garment import TEMPLATES, Fabric, Garment, Template
from ._search import AXES, UNITS
from .tailoring import KINDS, MEASURES

_PLACE = ("unit", "up", "front", "made_on")
_OPTIONS = re.compile(r"^(?P<name>.+?):(?P<options>\w+=[^:,=]*(?:,\w+=[^:,=]*)*)$")


@dataclasses.dataclass(frozen=True, kw_only=True)
class WearItem:
    """A garment's name with its options.

    Attributes:
        name: A template, a kind that the tailor makes, or a garment file.
        template: Template that dresses a file (``as``); guessed from its shape if None.
        unit: Unit of a file; found if None.
        up: The axis of a file that points up, one of ``x``, ``y``, ``z`` or their negatives.
        front: The axis of a file that the garment faces, likewise.
        made_on: File of the body that the garment was made on, in the same place.
        fabric: Name or file of a fabric that replaces its own (`find_fabric`); None keeps it.
        measures: Measures of a tailored garment [m].
        hold: Curves of a tailored garment that are fixed to the body.
    """

    name: str
    template: Template | None = None
    unit: str | None = None
    up: str | None = None
    front: str | None = None
    made_on: str | None = None
    fabric: str | None = None
    measures: dict[str, float] = dataclasses.field(default_factory=dict)
    hold: tuple[str, ...] = ()

    def word(self, name: str) -> str:
        """The word that `parse_wear` reads, under another name and without the fabric."""
        options = [f"as={self.template}"] if self.template else []
        options += [f"{k}={getattr(self, k)}" for k in _PLACE if getattr(self, k)]
        options += [f"{k}={v:g}" for k, v in self.measures.items()]
        options += [f"hold={'+'.join(self.hold)}"] if self.hold else []
        return f"{name}:{','.join(options)}" if options else name


def parse_wear(word: str | pathlib.Path) -> WearItem:
    """Parses ``NAME[:key=value,...]``.

    Args:
        word: A template, a kind of garment or a file, with its options: ``fabric``; for a file
            ``as``, its template, and ``unit``, ``up`` and ``front`` where they can't be found
            (``up=z,front=-y``), or ``made_on``, a mesh of the body that it was made on; for a
            tailored garment its measures [m] and ``hold``, curves joined by ``+`` that are
            fixed to the body.

    Raises:
        PhysXNetError: A key, template, fabric or number is wrong.

    Example:
        >>> item = parse_wear("coat.obj:as=top,fabric=wool")
        >>> item.name, item.template, item.fabric
        ('coat.obj', 'top', 'wool')
        >>> parse_wear("tee:ease=0.1").measures
        {'ease': 0.1}
    """
    found = _OPTIONS.match(str(word))
    if found is None:
        return WearItem(name=str(word))
    pairs = (part.partition("=") for part in found["options"].split(","))
    options = {key: value for key, _, value in pairs}
    known = {
        "as": TEMPLATES,
        "unit": tuple(UNITS),
        "up": AXES,
        "front": AXES,
    }
    tailored = found["name"] in KINDS
    places = () if found["name"] in TEMPLATES else _PLACE
    allowed = ("fabric", "hold", *MEASURES) if tailored else ("as", "fabric", *places)
    measures = {}
    for key, value in options.items():
        if key not in allowed:
            raise PhysXNetError(f"{word}: no option '{key}'; there are {', '.join(allowed)}.")
        if key in known and value not in known[key]:
            raise PhysXNetError(f"{word}: {key} is one of {', '.join(known[key])}.")
        if key in MEASURES:
            measures[key] = _number(word, key, value)
        if key == "fabric":
            find_fabric(value)
    if "up" in options and options.get("front", "")[-1:] == options["up"][-1]:
        raise PhysXNetError(f"{word}: up and front are the same axis.")
    template: Template | None = options.get("as")  # pyright: ignore[reportAssignmentType]
    return WearItem(
        name=found["name"],
        template=template,
        **{k: options[k] for k in _PLACE if k in options},
        fabric=options.get("fabric"),
        measures=measures,
        hold=tuple(options["hold"].split("+")) if "hold" in options else (),
    )


def _number(word: str | pathlib.Path, key: str, value: str) -> float:
    try:
        return float(value)
    except ValueError:
        raise PhysXNetError(
            f"{word}: {key} is '{value}', expected metres, as in {key}=0.1."
        ) from None


def with_default_fabric(words: Sequence[str], fabric: str | None) -> tuple[str, ...]:
    """Adds a fabric to the words of `parse_wear` that have none.

    Raises:
        PhysXNetError: The fabric is unknown, or its file isn't one.

    Example:
        >>> with_default_fabric(["top", "coat.obj:as=top", "bottom:fabric=wool"], "silk")
        ('top:fabric=silk', 'coat.obj:as=top,fabric=silk', 'bottom:fabric=wool')
    """
    if fabric is None:
        return tuple(words)
    find_fabric(fabric)
    if any(sign in fabric for sign in ":,="):
        raise PhysXNetError(
            f"{fabric}: give the fabric's file a path without ':', ',' and '=', as in fabric.toml."
        )
    out = []
    for word in words:
        item = parse_wear(word)
        joint = ":" if item.name == word else ","
        out.append(word if item.fabric else f"{word}{joint}fabric={fabric}")
    return tuple(out)


def with_made_on(words: Sequence[str], made_on: str | pathlib.Path | None) -> tuple[str, ...]:
    """Adds the body that garment files were made on to the words of `parse_wear`.

    Example:
        >>> with_made_on(["top", "coat.obj:as=top"], "avatar.obj")
        ('top', 'coat.obj:as=top,made_on=avatar.obj')
    """
    if made_on is None:
        return tuple(words)
    out = []
    for word in words:
        item = parse_wear(word)
        own = item.name in KINDS or item.name in TEMPLATES or item.made_on
        joint = ":" if item.name == word else ","
        out.append(word if own else f"{word}{joint}made_on={made_on}")
    return tuple(out)


def with_fabric(garment: Garment, fabric: str | Fabric) -> Garment:
    """Replaces the fabric of a garment, by name, file (`find_fabric`) or parameters.

    The thickness doesn't fall below the garment's own, because its gap to the skin depends on
    the coarseness of its mesh and on what it lies over, not on the fabric alone.
    """
    cloth = find_fabric(fabric) if isinstance(fabric, str) else fabric
    thickness = max(cloth.thickness, garment.fabric.thickness)
    return dataclasses.replace(garment, fabric=dataclasses.replace(cloth, thickness=thickness))
