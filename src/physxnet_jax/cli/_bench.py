"""`physxnet bench`: work-precision tables and diagrams."""

import dataclasses
import math
import pathlib
from typing import Any

from rich.console import Console
from rich.table import Table

from ..evaluation import JITTER, Work, bench_scenes, bench_simulation, time_to_error
from ..files import atomic_write, write_json
from ..garment import load_garment
from ..motion import load_motion
from ..viewer import draw_work_precision
from ._bench_net import bench_net
from ._experiment_commands import Bench
from ._machine import machine
from ._rows import check_rows_file, kept_rows


def bench(command: Bench, console: Console) -> int:
    """Measures the simulator or the networks."""
    return (
        bench_simulator(command, console) if command.what == "sim" else bench_net(command, console)
    )


def bench_simulator(command: Bench, console: Console) -> int:
    """Measures row by row, and saves each as soon as it is complete."""
    check_rows_file(command.out)
    shirt = None if command.shirt is None else load_garment(command.shirt)[0]
    action = None if command.motion == "punch" else load_motion(command.motion, fps=30.0)
    scenes = bench_scenes(shirt, action, command.frames)
    scenes = [b for b in scenes if b.name in command.scenes]
    rows = kept_rows(command.out, _from_json)
    with console.status("bench") as status:
        for row in bench_simulation(
            scenes,
            blender=command.blender,
            newton=command.newton,
            done=tuple(rows),
            progress=lambda text: status.update(text),
        ):
            rows.append(row)
            if command.out is not None:
                _write(command.out, rows)
    for b in scenes:
        console.print(_table(b.name, rows))
    if command.out is not None:
        with atomic_write(command.out.with_suffix(".md")) as part:
            part.write_text(_markdown(rows))
        draw_work_precision(
            command.out.with_suffix(".png"),
            [
                (r.scene, _label(r), r.rms_mm, r.ms_per_frame)
                for r in rows
                if not r.failed and r.ms_per_frame > 0 and r.setting not in ("check", JITTER)
            ],
            {r.scene: r.rms_mm for r in rows if r.setting == JITTER},
        )
        console.print(f"wrote {command.out}, .md and .png", highlight=False)
    return 0


def _label(r: Work) -> str:
    return r.solver if r.reference.startswith("verlet") else f"{r.solver} (against itself)"


def _write(path: pathlib.Path, rows: list[Work]) -> None:
    write_json(path, {"machine": machine(), "rows": [dataclasses.asdict(r) for r in rows]})


def _from_json(row: dict[str, Any]) -> Work:
    values: dict[str, Any] = {k: math.nan if v is None else v for k, v in row.items()}
    return Work(**values)


_COLUMNS = (
    "solver",
    "setting",
    "rms mm",
    "max mm",
    "inside",
    "pinched",
    "bad frames",
    "strain",
    "ms/frame",
    "against",
)


def _cells(r: Work) -> list[str]:
    if r.failed:
        return [r.solver, r.setting, "failed", r.failed, *[""] * 5, r.reference]
    return [
        r.solver,
        r.setting,
        f"{r.rms_mm:.3g}",
        f"{r.max_mm:.3g}",
        f"{100 * r.penetration_share:.2f} %",
        f"{100 * r.pinched_share:.2f} %",
        str(r.penetrating_frames),
        f"{r.strain_p99:.3f}",
        f"{r.ms_per_frame:.1f}",
        r.reference,
    ]


def _table(scene: str, rows: list[Work]) -> Table:
    table = Table(title=scene, title_justify="left")
    for c in _COLUMNS[:-1]:
        left = c in ("solver", "setting")
        table.add_column(c, justify="left" if left else "right", no_wrap=left)
    for r in rows:
        if r.scene == scene:
            table.add_row(*_cells(r)[:-1])
    return table


def _markdown(rows: list[Work]) -> str:
    out = []
    for scene in dict.fromkeys(r.scene for r in rows):
        mine = [r for r in rows if r.scene == scene]
        out += [f"### {scene}", "", f"| {' | '.join(_COLUMNS)} |", "|" + "---|" * len(_COLUMNS)]
        out += [f"| {' | '.join(_cells(r))} |" for r in mine]
        out.append("")
        for limit in (1.0, 10.0):
            best = time_to_error(mine, limit)
            said = "none" if best is None else f"{best.solver} with {best.setting} substeps"
            cost = "" if best is None else f", {best.ms_per_frame:.1f} ms a frame"
            out += [f"Cheapest within {limit:g} mm (rms): {said}{cost}.", ""]
    return "\n".join(out)
