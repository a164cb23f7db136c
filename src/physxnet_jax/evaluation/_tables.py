"""Tables of errors as Markdown."""

import math
from collections.abc import Sequence as Items

from ._evaluate import ActionError, means


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
    for action in dict.fromkeys(r.action for r in mine):
        cells = []
        for method in methods:
            found = [r.rmse_vertices_mm for r in mine if (r.action, r.method) == (action, method)]
            cells.append(f"{found[0]:.1f}" if found else "")
        lines.append(f"| {action} | " + " | ".join(cells) + " |")
    return lines
