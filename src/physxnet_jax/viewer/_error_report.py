"""Errors as tables and as the paper's two bar charts."""

import pathlib
from collections.abc import Sequence

from ..evaluation import ActionError, action_name, error_tables, summary_table
from ..files import atomic_write
from ._diagram import draw_bars


def write_error_report(path: str | pathlib.Path, rows: Sequence[ActionError]) -> None:
    """Writes tables (.md) and bar charts (_vertices.png, _texels.png) beside a file of rows.

    Args:
        path: The file of the rows; its name without suffix is common to what is written.
        rows: Rows of `evaluate`, in the order in which they are shown.

    Raises:
        MissingDependencyError: matplotlib isn't installed.

    References:
        PhysXNet, figures 4 and 5: mean squared errors of every action.
    """
    path = pathlib.Path(path)
    with atomic_write(path.with_suffix(".md")) as part:
        part.write_text(summary_table(rows) + "\n" + error_tables(rows))
    # Variants of a network are hardly distinguishable as separate bars.
    known = {r.method for r in rows}
    drawn = [r for r in rows if r.method.partition("+")[0] not in known - {r.method}]
    for what in ("vertices", "texels"):
        bars = [
            (
                f"{r.template} ({r.engine})",
                action_name(r),
                r.method,
                getattr(r, f"mse_{what}_mm2"),
            )
            for r in drawn
        ]
        name = f"{path.with_suffix('').name}_{what}.png"
        draw_bars(path.with_name(name), bars, f"MSE over {what} [mm²]")
