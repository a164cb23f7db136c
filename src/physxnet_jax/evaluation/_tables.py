"""Tables of measurements as Markdown."""

import math
from collections.abc import Sequence as Items

from ._bench import Work, time_to_error
from ._cost import Cost
from ._evaluate import ActionError, action_name, means


def summary_table(rows: Items[ActionError]) -> str:
    """One row per method: mean RMSE over actions for each template, and further means.

    ``better than lbs`` counts the pairs of action and template in which a method's RMSE
    over vertices is below that of skinning; ``strain 99 %`` is the 99th percentile of the
    absolute strain of edges.
    """
    names = list(dict.fromkeys(r.template for r in rows))
    lines = [
        "| reference | method | " + " | ".join(f"{n}, mm" for n in names) + " | better than lbs |"
        " inside, % | strain 99 % | ms a frame and garment |",
        "|---" * (len(names) + 6) + "|",
    ]
    for engine in dict.fromkeys(r.engine for r in rows):
        plain = {
            (r.action, r.template): r.rmse_vertices_mm
            for r in rows
            if (r.engine, r.method) == (engine, "lbs")
        }
        for method in dict.fromkeys(r.method for r in rows if r.engine == engine):
            mine = [r for r in rows if (r.engine, r.method) == (engine, method)]
            per = [means(rows, method, n, engine) for n in names]
            cells = [f"{m['rmse_vertices_mm']:.1f}" if m else "" for m in per]
            pairs = [(r.rmse_vertices_mm, plain.get((r.action, r.template))) for r in mine]
            known = [(a, b) for a, b in pairs if b is not None]
            wins = "" if method == "lbs" else f"{sum(a < b for a, b in known)} of {len(known)}"
            inside = 100 * sum(r.penetration_share for r in mine) / len(mine)
            strain = sum(r.strain_p99 for r in mine) / len(mine)
            ms = sum(r.ms_per_frame for r in mine) / len(mine)
            lines.append(
                f"| {engine} | {method} | " + " | ".join(cells) + f" | {wins} | {inside:.2f}"
                f" | {strain:.2f} | {ms:.1f} |"
            )
    return "\n".join(lines) + "\n"


def error_tables(rows: Items[ActionError]) -> str:
    """For each engine, the means of every method, then the errors action by action.

    ``at most`` is the maximum over actions of the column before it.

    Args:
        rows: Rows of `evaluate`.

    Returns:
        Markdown; all errors are RMSE over vertices [mm] unless a column states otherwise.
    """
    lines: list[str] = []
    for engine in dict.fromkeys(r.engine for r in rows):
        mine = [r for r in rows if r.engine == engine]
        lines += [f"### Reference: {engine}", "", *_means(mine, engine), ""]
        for name in dict.fromkeys(r.template for r in mine):
            lines += [f"RMSE over vertices [mm], {name}:", "", *_actions(mine, name), ""]
    return "\n".join(lines)


def _means(rows: Items[ActionError], engine: str) -> list[str]:
    lines = [
        "| method | template | RMSE vertices | MSE vertices, mm^2 | RMSE texels | inside, % |"
        " at most | pinched, % | strain 99 % | of reference | wrinkles, deg |"
        " folds over reference | jerk over reference | at most | ms a frame |",
        "|" + "---|" * 15,
    ]
    for method in dict.fromkeys(r.method for r in rows):
        for name in dict.fromkeys(r.template for r in rows):
            m = means(rows, method, name, engine)
            if m is None:
                continue
            mine = [r for r in rows if (r.method, r.template) == (method, name)]
            shaken = [r.jitter / r.jitter_reference for r in mine if r.jitter_reference > 0]
            most = max((s for s in shaken if math.isfinite(s)), default=math.nan)
            lines.append(
                f"| {method} | {name} | {m['rmse_vertices_mm']:.1f} | {m['mse_vertices_mm2']:.0f}"
                f" | {m['rmse_texels_mm']:.1f} | {100 * m['penetration_share']:.2f}"
                f" | {100 * max(r.penetration_share for r in mine):.2f}"
                f" | {100 * m['pinched_share']:.2f} | {m['strain_p99']:.2f}"
                f" | {_known(m['strain_p99_reference'])} | {m['wrinkle_deg']:.1f}"
                f" | {_known(m['fold_strength'])} | {_share(m['jitter'], m['jitter_reference'])}"
                f" | {_known(most)}"
                f" | {m['ms_per_frame']:.1f} |"
            )
    return lines


def _known(value: float) -> str:
    return "" if math.isnan(value) else f"{value:.2f}"


def _share(part: float, whole: float) -> str:
    return f"{part / whole:.2f}" if whole > 0 and math.isfinite(part) else ""


def _actions(rows: Items[ActionError], name: str) -> list[str]:
    mine = [r for r in rows if r.template == name]
    methods = list(dict.fromkeys(r.method for r in mine))
    lines = ["| action | " + " | ".join(methods) + " |", "|---" * (len(methods) + 1) + "|"]
    for action in dict.fromkeys(action_name(r) for r in mine):
        cells = []
        for method in methods:
            here = [r for r in mine if (action_name(r), r.method) == (action, method)]
            found = [r.rmse_vertices_mm for r in here]
            cells.append(f"{found[0]:.1f}" if found else "")
        lines.append(f"| {action} | " + " | ".join(cells) + " |")
    return lines


_COST_COLUMNS = (
    "method",
    "size",
    "garments",
    "batch",
    "RMSE mm",
    "of each",
    "ms a frame",
    "network ms",
    "gradient ms",
    "cold s",
    "parameters",
    "MFLOP a frame",
    "weights MB",
    "peak MB",
    "gradient MB",
)


def cost_rows_table(rows: Items[Cost]) -> str:
    """Rows of `bench_networks`; the devices are named if there are several."""
    several = len({r.device for r in rows}) > 1
    columns = (*_COST_COLUMNS[:2], *(["device"] if several else []), *_COST_COLUMNS[2:])
    lines = [f"| {' | '.join(columns)} |", "|" + "---|" * len(columns)]
    for r in rows:
        cells = (
            r.method,
            r.size if r.precision == "float32" else f"{r.size} {r.precision}",
            *([r.device] if several else []),
            str(r.garments),
            str(r.batch),
            _number(r.rmse_mm, ".1f"),
            " / ".join(f"{x:.1f}" for x in r.rmse_each.values()) if r.garments > 1 else "",
            f"{r.ms_per_frame:.2f}",
            f"{r.ms_network:.2f}" if r.ms_network else "",
            _number(r.ms_backward, ".1f"),
            _number(r.cold_s, ".1f"),
            f"{r.params:,}" if r.params else "",
            _number(r.flops / 1e6 / r.batch, ".0f"),
            f"{r.weights_mb:.1f}" if r.weights_mb else "",
            _number(r.peak_mb, ".0f"),
            _number(r.backward_mb, ".0f"),
        )
        lines.append(f"| {' | '.join(cells)} |")
    return "\n".join(lines) + "\n"


def _number(value: float, spec: str) -> str:
    return "" if math.isnan(value) else format(value, spec)


_WORK_COLUMNS = (
    "solver",
    "setting",
    "rms mm",
    "max mm",
    "inside",
    "pinched",
    "bad frames",
    "visible skin",
    "self-crossing",
    "folds",
    "strain",
    "ms/frame",
    "against",
)


def work_tables(rows: Items[Work]) -> str:
    """Rows of `bench_simulation`, a table for each scene, with the cheapest within 1 and 10 mm."""
    out = []
    for scene in dict.fromkeys(r.scene for r in rows):
        mine = [r for r in rows if r.scene == scene]
        columns = " | ".join(_WORK_COLUMNS)
        out += [f"### {scene}", "", f"| {columns} |", "|" + "---|" * len(_WORK_COLUMNS)]
        out += [f"| {' | '.join(_work_cells(r))} |" for r in mine]
        out.append("")
        for limit in (1.0, 10.0):
            best = time_to_error(mine, limit)
            said = "none" if best is None else f"{best.solver} with {best.setting} substeps"
            cost = "" if best is None else f", {best.ms_per_frame:.1f} ms a frame"
            out += [f"Cheapest within {limit:g} mm (rms): {said}{cost}.", ""]
    return "\n".join(out)


def _work_cells(r: Work) -> list[str]:
    if r.failed:
        return [r.solver, r.setting, "failed", r.failed, *[""] * 8, r.reference]
    return [
        r.solver,
        r.setting,
        f"{r.rms_mm:.3g}",
        f"{r.max_mm:.3g}",
        f"{100 * r.penetration_share:.2f} %",
        f"{100 * r.pinched_share:.2f} %",
        str(r.penetrating_frames),
        "" if math.isnan(r.visible_skin) else f"{100 * r.visible_skin:.3f} %",
        "" if math.isnan(r.self_crossing) else f"{100 * r.self_crossing:.2f} %",
        "" if math.isnan(r.folds) else f"{r.folds:.2f}",
        f"{r.strain_p99:.3f}",
        f"{r.ms_per_frame:.1f}",
        r.reference,
    ]
