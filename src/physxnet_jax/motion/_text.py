"""Reading motion text files with errors that name file, line and fix."""

import math
import pathlib
from collections.abc import Sequence

import numpy as np
from jaxtyping import Float

from ..errors import MotionError
from ..files import add_inputs, is_file

# No length or angle is larger, in any unit.
_LARGEST = 1e12
# Ten minutes at 120 fps of 30 joints is 60 MB as text.
_MAX_BYTES = 512_000_000


def read_lines(path: pathlib.Path, kind: str) -> list[str]:
    """Lines of a text file.

    Raises:
        MotionError: The file is missing, empty, binary or too large.
    """
    if not is_file(path):
        raise MotionError.at(path, None, "no such file", "Check the path")
    add_inputs(path)
    if path.stat().st_size > _MAX_BYTES:
        raise MotionError.at(path, None, "over 500 MB of text", "Cut the clip into shorter files")
    blob = path.read_bytes()
    if not blob.strip():
        raise MotionError.at(path, None, "the file is empty", f"Export the {kind} again")
    head = blob[:4096]
    if b"\0" in head or sum(b < 9 for b in head) > 0:
        raise MotionError.at(
            path,
            None,
            f"binary data where {kind} text was expected",
            f"Convert it to {kind} text first (FBX and C3D are not read)",
        )
    try:
        lines = blob.decode("utf-8-sig").splitlines()
    except UnicodeDecodeError:
        lines = blob.decode("latin-1").splitlines()
    if not any(map(str.strip, lines)):
        raise MotionError.at(path, None, "the file is empty", f"Export the {kind} again")
    return lines


def is_count(word: str) -> bool:
    """Whether a word consists of ASCII digits, at most 18 of them."""
    return word.isascii() and word.isdigit() and len(word) < 19


def numbers(path: pathlib.Path, line: int, words: list[str]) -> list[float]:
    """Parses the finite numbers of one line.

    Raises:
        MotionError: A word that isn't a number, or is NaN, infinite or out of range.
    """
    # Files hold millions of numbers: words are checked one by one only if the line is faulty.
    try:
        out = list(map(float, words))
    except ValueError:
        out = []
    if len(out) == len(words) and all(-_LARGEST <= x <= _LARGEST for x in out):
        return out
    for word in words:
        try:
            value = float(word)
        except ValueError:
            raise MotionError.at(
                path, line, f"'{word[:40]}' is not a number", "Export the clip again"
            ) from None
        if not abs(value) <= _LARGEST:
            raise MotionError.at(
                path,
                line,
                f"the value '{word[:40]}' is "
                + ("out of range" if math.isfinite(value) else "not finite"),
                "Cut this frame out or interpolate over it",
            )
    return out


def table(
    path: pathlib.Path, lines: Sequence[str], which: Sequence[int], skip: int, width: int
) -> Float[np.ndarray, "rows numbers"]:
    """Parses the numbers of many lines at once.

    Args:
        path: The file, for errors.
        lines: All its lines.
        which: Lines to parse, counted from 1; each has `width` words after the first `skip`.
        skip: Words before the numbers.
        width: Numbers per line.

    Raises:
        MotionError: As for `numbers`, for the first faulty line.
    """
    words = (word for n in which for word in lines[n - 1].split()[skip:])
    try:
        flat = np.fromiter(map(float, words), np.float64, len(which) * width)
        fine = bool((np.abs(flat) <= _LARGEST).all())
    except ValueError:
        flat, fine = np.zeros(0), False
    if not fine:
        for n in which:
            numbers(path, n, lines[n - 1].split()[skip:])
    return flat.reshape(len(which), width)
