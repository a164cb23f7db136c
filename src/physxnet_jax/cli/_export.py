"""`physxnet export`: clothes as one function, without this package."""

from rich.console import Console

from ..dressing import export_dresser, make_dresser
from ._commands import Export
from ._options import check_fabric
from ._progress import print_json


def export(command: Export, console: Console) -> int:
    """Writes the function and prints how to call it."""
    check_fabric(command.outfit, "network", command.inference.weights)
    with console.status("binding and lowering"):
        dresser = make_dresser(command.outfit.words, inference=command.inference.build())
        files = export_dresser(
            command.out,
            dresser,
            fps=command.fps,
            platforms=command.platforms,
            name=str(command.inference.weights),
        )
    if command.terminal.json:
        print_json({"files": files, "notes": dresser.notes})
        return 0
    for note in dresser.notes:
        console.print(note, highlight=False, soft_wrap=True)
    for file in files:
        console.print(f"wrote {file} ({file.stat().st_size / 1e6:.1f} MB)", highlight=False)
    console.print(
        f"usage, in {command.out}: from dress import load; cloth, ok = load('.')(rotations, root)",
        highlight=False,
    )
    return 0
