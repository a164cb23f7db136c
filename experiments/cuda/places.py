"""Folders and output that the scripts of a CUDA machine share."""

import os
import pathlib
from typing import Any

from rich.console import Console

ROOT = pathlib.Path(__file__).parents[2]
OUT = pathlib.Path(os.environ.get("OUT", "out/cuda/results"))
PACK = pathlib.Path(os.environ.get("PACK", "out/cuda"))
WORK = pathlib.Path(os.environ.get("WORK", "out/cuda/work"))
_CONSOLE = Console()


def say(text: str) -> None:
    """Prints a line, whole however long it is."""
    _CONSOLE.print(text, markup=False, highlight=False, soft_wrap=True)


def shown(values: dict[str, Any]) -> str:
    """Values by name, as a line."""
    texts = []
    for name, value in values.items():
        texts.append(f"{name} {value:.4g}" if isinstance(value, float) else f"{name} {value}")
    return ", ".join(texts)
