"""`physxnet clips`: the built-in clips, garments and weights."""

from rich.console import Console

from ..garment import KINDS, TEMPLATES
from ..models import list_weights
from ..motion import CLIPS
from ._commands import Clips
from ._progress import print_json


def clips(command: Clips, console: Console) -> int:
    """Lists the built-in clips, garments and weights."""
    found = {
        "clips": list(CLIPS),
        "templates": TEMPLATES,
        "kinds": list(KINDS),
        "weights": list_weights(),
    }
    if command.terminal.json:
        print_json(found)
        return 0
    for name, words in found.items():
        console.print(f"{name + ':':<10}", ", ".join(words))
    return 0
