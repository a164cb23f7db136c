"""Parses shape parameters of the command line."""

from collections.abc import Sequence

from ..errors import PhysXNetError


def parse_shape(words: Sequence[str]) -> dict[str, float]:
    """Parses shape parameters into a dictionary by name.

    Args:
        words: Arguments of the form ``name=number``.

    Raises:
        PhysXNetError: An argument has another form.
    """
    out = {}
    for word in words:
        name, _, value = word.partition("=")
        try:
            out[name] = float(value)
        except ValueError:
            raise PhysXNetError(
                f"--shape {word}: expected name=number, for example weight_up=0.5."
            ) from None
    return out
