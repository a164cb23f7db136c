"""`physxnet effects`: what each effect of a scene costs and changes."""

import dataclasses

from rich.console import Console
from rich.table import Table

from ..dressing import Simulation, make_scene, write_scene
from ..errors import FormatError
from ..evaluation import price_effects, recommend_effects, recommended_effects
from ..files import check_writable, write_json
from ._commands import Effects
from ._dress import is_scene_file, scene_file
from ._options import with_animation
from ._progress import print_json, progress_bars


def price(command: Effects, console: Console) -> int:
    """Prints the cost of a scene's effects, and recommendations on request."""
    for path in (command.out, command.write_scene):
        if path is not None:
            check_writable(path)
    if command.write_scene is not None and not command.recommend:
        raise FormatError("--write-scene writes what --recommend finds: add --recommend.")
    if is_scene_file(command.scene):
        job = scene_file(command)
    else:
        source = dataclasses.asdict(command.source)
        del source["animation"]
        job = make_scene(
            with_animation(command.scene, command.source),
            command.outfit.words,
            simulation=command.simulation.build(),
            **source,
        )
    accuracy = command.simulation.accuracy
    steps = None if accuracy else job.substeps
    simulation = Simulation(accuracy=accuracy or job.accuracy, substeps=steps)
    solver = simulation.solver.at_rate(job.motion.fps)
    with progress_bars(console) as bars:
        if command.recommend:
            rows, advice = recommend_effects(
                job.scene,
                job.motion,
                solver=solver,
                tolerance=1e-3 * command.tolerance,
                progress=lambda d, t: bars("effects", d, t),
            )
        else:
            rows = price_effects(
                job.scene, job.motion, solver=solver, progress=lambda d, t: bars("effects", d, t)
            )
            advice = []
    table = Table(
        title=f"{rows[0].frames} frames: the scene, then without each of its effects",
        caption=f"two runs that differ by 1e-6 m: {rows[0].jitter_mm:.2f} mm; strain: 99th"
        " percentile; ms: per frame; Mflop: each loop body counted once",
        title_justify="left",
    )
    table.add_column("without", no_wrap=True)
    for column in ("rms mm", "max mm", "strain", "inside", "ms", "Mflop"):
        table.add_column(column, justify="right")
    for r in rows:
        table.add_row(
            r.without or "nothing",
            f"{r.rms_mm:.2f}",
            f"{r.max_mm:.1f}",
            f"{r.strain_p99:.3f}",
            f"{100 * r.inside_share:.2f} %",
            f"{r.ms_per_frame:.1f}",
            f"{r.mflop:.2f}",
        )
    console.print(table)
    for note in job.notes:
        console.print(note, highlight=False, markup=False, soft_wrap=True)
    for a in advice:
        console.print(f"{a.effect}: {'needed' if a.needed else 'not needed'}. {a.why}")
    if command.write_scene is not None:
        write_scene(command.write_scene, job, recommended_effects(job.scene, advice))
        console.print(f"wrote {command.write_scene}", highlight=False)
    data = {
        "effects": [dataclasses.asdict(r) for r in rows],
        "recommendation": [{"effect": a.effect, "needed": a.needed, "why": a.why} for a in advice],
        "notes": list(job.notes),
    }
    if command.out is not None:
        write_json(command.out, data)
    if command.terminal.json:
        print_json(data)
    return 0
