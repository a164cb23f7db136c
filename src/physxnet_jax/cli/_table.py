"""Tables that summarise a dressed clip or a simulation."""

import dataclasses
from typing import Any

import numpy as np
from rich.table import Table

from ..dressing import DressedClip, Simulation, Stage
from ..motion import BLOCK
from ..simulation import Status


def closing_table(clip: DressedClip) -> list[Table]:
    """Two tables: times of the stages, and fit of the garments."""
    times = Table(
        title=f"{clip.num_frames} frames at {clip.fps:g} fps, method {clip.method}",
        title_justify="left",
    )
    times.add_column("stage")
    times.add_column("whole (ms)", justify="right")
    times.add_column("first call (ms)", justify="right")
    times.add_column("warm (ms a frame)", justify="right")
    for stage in clip.stages:
        whole = f"{milliseconds(clip, stage):.0f}"
        by_frames = stage.warm_ms is not None
        first = f"{stage.cold_ms:.0f}" if by_frames else ""
        times.add_row(stage.name, whole, first, f"{stage.warm_ms:.2f}" if by_frames else "")
    times.add_row("total", f"{sum(milliseconds(clip, s) for s in clip.stages):.0f}", "", "")
    fit = Table(
        title="garments, and their share inside the body before and after collisions",
        title_justify="left",
        caption="rays hit: vertices bound to the skin where a ray meets it; no ray: how many are"
        " bound to the nearest skin in place of it",
        caption_justify="left",
    )
    for name in (
        "garment",
        "vertices",
        "rays hit",
        "no ray",
        "before",
        "after",
        "worst frame",
    ):
        if name == "garment":
            fit.add_column(name, overflow="fold")
        else:
            fit.add_column(name, justify="right", no_wrap=True)
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


def milliseconds(clip: DressedClip, stage: Stage) -> float:
    """Time of a whole stage [ms]: of its first block, and of the others at its usual pace."""
    if stage.warm_ms is None:
        return stage.cold_ms
    return stage.cold_ms + stage.warm_ms * max(clip.num_frames - BLOCK, 0)


def report(clip: DressedClip) -> dict[str, Any]:
    """The same data for JSON."""
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


_DIAGNOSTICS = {
    "strain_p99": ("strain, 99th percentile (%)", 100.0),
    "strain_max": ("strain, worst edge (%)", 100.0),
    "penetration_max": ("deepest penetration of the skin (mm)", 1e3),
    "inside_share": ("vertices inside the skin, worst frame (%)", 100.0),
    "layers_crossed": ("vertices in the wrong layer, worst frame", 1.0),
    "self_gap": ("smallest gap of cloth to itself (mm)", 1e3),
    "pinched": ("vertices inside another limb, worst frame", 1.0),
    "residual_p99": ("residual, 99th percentile (1 = tolerance)", 1.0),
    "speed_max": ("fastest vertex (m/s)", 1.0),
}


def rollout_report(clip: DressedClip, seconds: float) -> dict[str, Any]:
    """A simulation's diagnostics for JSON."""
    rollout = clip.rollout
    assert rollout is not None
    marked = {f.name: int(np.count_nonzero(rollout.status & int(f))) for f in Status}
    return {
        "frames": clip.num_frames,
        "fps": clip.fps,
        "seconds": seconds,
        "effects": list(clip.effects),
        "worst": rollout.worst,
        "frames_marked": {k: n for k, n in marked.items() if n},
    }


def rollout_table(clip: DressedClip, simulation: Simulation, seconds: float) -> Table:
    """A simulation's diagnostics over all frames."""
    rollout = clip.rollout
    assert rollout is not None
    named = ", ".join(clip.effects) or f"forces and contact of {simulation.engine}"
    table = Table(
        title=f"{clip.num_frames} frames in {seconds:.1f} s; {named}", title_justify="left"
    )
    table.add_column("over all frames")
    table.add_column("worst", justify="right")
    for key, (name, scale) in _DIAGNOSTICS.items():
        if key in rollout.worst:
            table.add_row(name, f"{scale * rollout.worst[key]:.3g}")
    for flag in Status:
        count = int(np.count_nonzero(rollout.status & int(flag)))
        if count:
            table.add_row(f"frames marked {flag.name}: {flag.advice}", str(count))
    return table
