"""`physxnet bench`: work-precision tables and diagrams."""

from rich.console import Console

from ..evaluation import (
    JITTER,
    Work,
    bench_scenes,
    bench_simulation,
    check_rows_file,
    machine,
    read_rows,
    save_rows,
    work_tables,
)
from ..files import atomic_write
from ..garment import load_garment
from ..motion import load_motion
from ..viewer import draw_work_precision
from ._bench_net import bench_net
from ._experiment_commands import Bench


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
    rows = read_rows(command.out, Work)
    with console.status("bench") as status:
        for row in bench_simulation(
            scenes,
            blender=command.blender,
            newton=command.newton,
            done=tuple(rows),
            progress=lambda text: status.update(text),
        ):
            # An external engine is run again at all settings when a new one is the finest.
            key = (row.scene, row.solver, row.setting)
            rows = [r for r in rows if (r.scene, r.solver, r.setting) != key] + [row]
            save_rows(command.out, rows, machine())
    text = work_tables([r for r in rows if r.scene in command.scenes])
    console.print(text, markup=False, highlight=False, soft_wrap=True)
    if command.out is not None:
        with atomic_write(command.out.with_suffix(".md")) as part:
            part.write_text(work_tables(rows))
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
    external = r.reference.startswith(("blender", "newton"))
    return f"{r.solver} (against itself)" if external else r.solver
