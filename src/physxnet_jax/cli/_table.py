"""The closing table of a dressed clip."""

import dataclasses
from typing import Any

from rich.table import Table

from ..dressing import DressedClip


def closing_table(clip: DressedClip) -> list[Table]:
    """What was made, what it cost and how well it sits."""
    times = Table(
        title=f"{clip.num_frames} frames at {clip.fps:g} fps, method {clip.method}",
        title_justify="left",
    )
    times.add_column("stage")
    times.add_column("first time (ms)", justify="right")
    times.add_column("warm (ms a frame)", justify="right")
    for stage in clip.stages:
        warm = "" if stage.warm_ms is None else f"{stage.warm_ms:.2f}"
        times.add_row(stage.name, f"{stage.cold_ms:.0f}", warm)
    fit = Table(title="garments, and how much of them is inside the body", title_justify="left")
    for name in (
        "garment",
        "vertices",
        "rays hit",
        "fallbacks",
        "inside, raw",
        "inside",
        "worst frame",
    ):
        fit.add_column(name, justify="left" if name == "garment" else "right")
    for m in clip.garments:
        fit.add_row(
            m.name,
            str(m.positions.shape[1]),
            _share(clip.hit_rate[m.name], 1),
            "-" if clip.fallbacks[m.name] is None else str(clip.fallbacks[m.name]),
            _share(clip.inside_raw[m.name], 2),
            _share(clip.inside[m.name], 2),
            _worst(clip, m.name),
        )
    return [times, fit]


def report(clip: DressedClip) -> dict[str, Any]:
    """The same for machines."""
    return {
        "frames": clip.num_frames,
        "fps": clip.fps,
        "method": clip.method,
        "stages": [dataclasses.asdict(stage) for stage in clip.stages],
        "garments": [
            {
                "name": m.name,
                "vertices": m.positions.shape[1],
                "hit_rate": clip.hit_rate[m.name],
                "fallbacks": clip.fallbacks[m.name],
                "inside_raw": clip.inside_raw[m.name],
                "inside": clip.inside[m.name],
                "worst_frame": clip.worst[m.name][0] if m.name in clip.worst else None,
                "inside_worst": clip.worst[m.name][1] if m.name in clip.worst else None,
            }
            for m in clip.garments
        ],
        "notes": list(clip.notes),
    }


def _worst(clip: DressedClip, name: str) -> str:
    if name not in clip.worst:
        return "-"
    frame, share = clip.worst[name]
    return f"{100 * share:.1f} % ({frame})"


def _share(value: float | None, digits: int) -> str:
    return "-" if value is None else f"{100 * value:.{digits}f} %"
