"""Parses garment specifications of the form ``NAME[:key=value,...]``."""

import dataclasses
import pathlib
import re
from collections.abc import Sequence

from ..errors import PhysXNetError
from ._garment import FABRICS, TEMPLATES, Garment, Template

_OPTIONS = re.compile(r"^(?P<name>.+?):(?P<options>\w+=[^:,=]*(?:,\w+=[^:,=]*)*)$")


@dataclasses.dataclass(frozen=True, kw_only=True)
class WearItem:
    """A garment's name with its options.

    Attributes:
        name: A template, or a garment file.
        template: Template that dresses a file (``as``); guessed from its shape if None.
        fabric: Name of a fabric that replaces its own; None keeps it.
    """

    name: str
    template: Template | None = None
    fabric: str | None = None


def parse_wear(word: str | pathlib.Path) -> WearItem:
    """Parses ``NAME[:key=value,...]``; keys are ``as`` and ``fabric``.

    Args:
        word: A template or a file, with its options.

    Raises:
        PhysXNetError: A key, template or fabric is unknown.

    Example:
        >>> parse_wear("coat.obj:as=top,fabric=wool")
        WearItem(name='coat.obj', template='top', fabric='wool')
    """
    found = _OPTIONS.match(str(word))
    if found is None:
        return WearItem(name=str(word))
    pairs = (part.partition("=") for part in found["options"].split(","))
    options = {key: value for key, _, value in pairs}
    known = {"as": TEMPLATES, "fabric": tuple(FABRICS)}
    for key, value in options.items():
        if key not in known:
            raise PhysXNetError(f"{word}: no option '{key}'; there are {', '.join(known)}.")
        if value not in known[key]:
            raise PhysXNetError(f"{word}: {key} is one of {', '.join(known[key])}.")
    template: Template | None = options.get("as")  # pyright: ignore[reportAssignmentType]
    return WearItem(name=found["name"], template=template, fabric=options.get("fabric"))


def with_default_fabric(words: Sequence[str], fabric: str | None) -> tuple[str, ...]:
    """Adds a fabric to the words of `parse_wear` that have none.

    Raises:
        PhysXNetError: The fabric is unknown.

    Example:
        >>> with_default_fabric(["top", "coat.obj:as=top", "bottom:fabric=wool"], "silk")
        ('top:fabric=silk', 'coat.obj:as=top,fabric=silk', 'bottom:fabric=wool')
    """
    if fabric is None:
        return tuple(words)
    if fabric not in FABRICS:
        raise PhysXNetError(f"No fabric '{fabric}'; there are {', '.join(FABRICS)}.")
    out = []
    for word in words:
        item = parse_wear(word)
        joint = ":" if item.name == word else ","
        out.append(word if item.fabric else f"{word}{joint}fabric={fabric}")
    return tuple(out)


def with_fabric(garment: Garment, fabric: str) -> Garment:
    """Replaces the fabric of a garment by name.

    The thickness doesn't fall below the garment's own, because its gap to the skin depends on
    the coarseness of its mesh and on what it lies over, not on the fabric alone.
    """
    cloth = FABRICS[fabric]
    thickness = max(cloth.thickness, garment.fabric.thickness)
    return dataclasses.replace(garment, fabric=dataclasses.replace(cloth, thickness=thickness))
