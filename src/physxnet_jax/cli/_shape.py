"""Shape parameters as they are told on a command line."""

from collections.abc import Sequence

from ..errors import PhysXNetError


def parse_shape(words: Sequence[str]) -> dict[str, float]:
    """Parameters by name.

    Args:
        words: Each ``name=number``.

    Raises:
        PhysXNetError: A word is something else.
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
