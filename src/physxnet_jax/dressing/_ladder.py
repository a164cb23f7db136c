"""What accuracy costs here: the ways to dress, their measured errors, and this machine's times."""

import dataclasses
import importlib.resources
import json
import os
import pathlib
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import jax

from .._environment import cache_folder, processor_name
from .._version import __version__
from ..errors import PhysXNetError
from ..files import whole_file
from ..garment import TEMPLATES, Template
from ..io import RELAX, read_card
from ..motion import BLOCK, Motion, load_motion
from ..simulation import ACCURACY
from ._cost import clothing_cost
from ._dresser import make_dresser
from ._method import method_by_name

_FRAMES = 64
# Calls of a network are timed for this long [s].
_SECONDS = 0.5
# How often what follows a network is timed, if it seems to cost nothing.
_TRIES = 4
# What was timed in another way isn't taken.
_TIMED = "garments together, relaxed"
ALONE_AND_TOGETHER: tuple[tuple[Template, ...], ...] = (*((t,) for t in TEMPLATES), TEMPLATES)
"""Each template alone, and all of them."""


@dataclasses.dataclass(frozen=True)
class Rung:
    """A way to dress, with its error on the twelve test actions of the paper's protocol.

    Attributes:
        name: ``lbs``, a name of weights, one with ``+mirror``, ``+relax``, ``+push`` or
            several of them, or an accuracy of the simulator.
        rmse_mm: Root mean square distance of vertices from the simulation at its
            ``standard`` setting [mm], by template.
        inside: Share of vertices inside the body that have room outside, by template.
    """

    name: str
    rmse_mm: dict[str, float]
    inside: dict[str, float]

    @property
    def options(self) -> dict[str, Any]:
        """The arguments by which `dress` takes this rung."""
        if self.name == "lbs":
            return {"method": "lbs", "push_out": False}
        if self.name in ACCURACY:
            return {"method": "simulate", "accuracy": self.name}
        weights = self.name.removesuffix("+push")
        return {"method": "network", "weights": weights, "push_out": weights != self.name}

    @property
    def identity(self) -> str:
        """Changes when what is timed changes."""
        if self.name == "lbs" or self.name in ACCURACY:
            return self.name
        card = read_card(self.name.removesuffix("+push"))
        return f"{self.name} {card['sha256'][:12]}"


@dataclasses.dataclass(frozen=True)
class Choice:
    """A rung that was picked, and what that means.

    Attributes:
        rung: Which.
        ms_per_frame: Its time on this machine for the garments asked for [ms].
        rmse_mm: Its mean error over them [mm].
        told: A sentence for the user.
    """

    rung: Rung
    ms_per_frame: float
    rmse_mm: float
    told: str


def load_ladder() -> list[Rung]:
    """The rungs whose errors the package knows."""
    path = importlib.resources.files(__name__.rpartition(".")[0]) / "ladder.json"
    return [Rung(**r) for r in json.loads(path.read_text())]


def calibration_file() -> pathlib.Path:
    """Where this machine's times are kept."""
    return cache_folder() / "calibration.json"


def worn_key(templates: Sequence[str]) -> str:
    """By what the time of garments worn together is kept: ``bottom+top``."""
    return "+".join(sorted(templates))


def calibrate(
    rungs: Sequence[Rung],
    worn: Sequence[Sequence[Template]] = ALONE_AND_TOGETHER,
    *,
    path: pathlib.Path | None = None,
    frames: int = _FRAMES,
    report: Callable[[str, int, int], None] | None = None,
) -> dict[str, dict[str, float]]:
    """Times of rungs on this machine, each measured once and then kept.

    Args:
        rungs: What is timed.
        worn: Templates that are worn together, one entry for each time that is wanted.
        path: Where times are kept; `calibration_file` by default.
        frames: Frames of the built-in walk that are dressed for it.
        report: Called with a text, measurements done and in all.

    Returns:
        For each rung and `worn_key`, median milliseconds a frame after warm-up, from joint
        rotations to vertices. Relaxation and push-out, the same for every network, are
        timed with the first one and added to the others.
    """
    clock = _Clock(calibration_file() if path is None else path, frames)
    jobs = [(r, w) for r in rungs for w in worn if all(t in r.rmse_mm for t in w)]
    for k, (rung, templates) in enumerate(jobs):
        if report is not None:
            report(f"timing {rung.name}, {', '.join(templates)}", k, len(jobs))
        clock.time_of(rung, templates)
    return {r.name: dict(clock.times.get(r.identity, {})) for r in rungs}


class _Clock:
    """Times rungs and keeps what it has timed."""

    def __init__(self, path: pathlib.Path, frames: int) -> None:
        kept = _read(path)
        self._path, self._machine = path, _machine()
        same = kept.get("machine") == self._machine
        self.times: dict[str, dict[str, float]] = kept["times"] if same else {}
        walk = load_motion("walk", fps=30.0)
        self._walk = Motion(walk.rotations[:frames], walk.root[:frames], walk.fps, walk.name)

    def time_of(self, rung: Rung, templates: Sequence[Template]) -> float:
        """Milliseconds a frame."""
        known = self.times.setdefault(rung.identity, {})
        key = worn_key(templates)
        if key not in known:
            ms = self._measure(rung, templates)
            self._keep(known, key, ms)
        return known[key]

    def _measure(self, rung: Rung, templates: Sequence[Template]) -> float:
        if rung.options["method"] != "network":
            # These dress a garment after another.
            method = method_by_name(rung.name)
            return sum(method(self._walk, t).ms_per_frame for t in templates)
        # What follows the network is the same for all: it is timed with the first one.
        last = next((w for w in ("+push", RELAX) if rung.name.endswith(w)), None)
        if last is None:
            return self._network(rung, templates)
        shorter = dataclasses.replace(rung, name=rung.name.removesuffix(last))
        plain = self.time_of(shorter, templates)
        known = self.times.setdefault(last, {})
        key = worn_key(templates)
        if key not in known:
            for _ in range(_TRIES):
                # Both now: a machine is not as fast as it was when the other was timed.
                both = self._network(rung, templates)
                extra = both - self._network(shorter, templates)
                if extra > 0.0:
                    break
            else:
                # Lost in the noise; it isn't kept, so that it is timed again.
                return max(plain, both)
            self._keep(known, key, extra)
        return plain + known[key]

    def _network(self, rung: Rung, templates: Sequence[Template]) -> float:
        options = rung.options
        dresser = make_dresser(templates, weights=options["weights"], push_out=options["push_out"])
        return clothing_cost(dresser, self._walk, BLOCK, seconds=_SECONDS)["ms_per_frame"]

    def _keep(self, known: dict[str, float], key: str, ms: float) -> None:
        known[key] = ms
        # Another process may have timed something meanwhile.
        kept = _read(self._path)
        if kept.get("machine") == self._machine:
            for name, times in kept["times"].items():
                mine = self.times.setdefault(name, {})
                mine.update({k: v for k, v in times.items() if k not in mine})
        with whole_file(self._path) as part:
            kept = {"machine": self._machine, "times": self.times}
            part.write_text(json.dumps(kept, indent=1) + "\n")


def pick_rung(
    templates: Sequence[str],
    times: Mapping[str, Mapping[str, float]],
    rungs: Sequence[Rung],
    *,
    budget_ms: float | None = None,
    max_error_mm: float | None = None,
) -> Choice:
    """The most accurate rung within a time, or the fastest within an error.

    Args:
        templates: Templates of the garments that will be worn, one for each.
        times: From `calibrate`, for these templates together.
        rungs: What there is to choose from.
        budget_ms: Milliseconds a frame for all garments together.
        max_error_mm: Mean error over the garments [mm].

    Raises:
        PhysXNetError: Nothing is that fast or that accurate; the text says what comes
            nearest.
    """
    if (budget_ms is None) == (max_error_mm is None):
        raise PhysXNetError("give either a time (budget_ms) or an error (max_error_mm).")
    if not templates:
        raise PhysXNetError("nothing is worn: there is nothing to choose.")

    def cost(r: Rung) -> float:
        return times[r.name][key]

    def error(r: Rung) -> float:
        return sum(r.rmse_mm[t] for t in templates) / len(templates)

    key = worn_key(templates)
    able = [
        r for r in rungs if all(t in r.rmse_mm for t in templates) and key in times.get(r.name, {})
    ]
    if not able:
        raise PhysXNetError(f"no rung has a time and an error for {', '.join(templates)}.")
    if budget_ms is not None:
        within = [r for r in able if cost(r) <= budget_ms]
        # Equally accurate to a tenth of a millimetre: fewer vertices inside wins.
        best = min(
            within,
            key=lambda r: (round(error(r), 1), sum(r.inside[t] for t in templates)),
            default=None,
        )
        nearest = min(able, key=cost)
        asked = f"{budget_ms:g} ms a frame"
    else:
        assert max_error_mm is not None
        within = [r for r in able if error(r) <= max_error_mm]
        best = min(within, key=cost, default=None)
        nearest = min(able, key=error)
        asked = f"an error of {max_error_mm:g} mm"
    if best is None:
        raise PhysXNetError(
            f"nothing here dresses {', '.join(templates)} within {asked}; the nearest is"
            f" {nearest.name}: {cost(nearest):.2f} ms a frame, {error(nearest):.1f} mm."
        )
    told = (
        f"picked {best.name}: {cost(best):.2f} ms a frame of such templates on this machine"
        f" (calibrated), {error(best):.1f} mm from the simulation on the test actions"
    )
    better = [r for r in able if error(r) < error(best) - 0.05]
    if better:
        finer = min(better, key=cost)
        told += f"; {finer.name} would take {cost(finer):.2f} ms for {error(finer):.1f} mm"
    return Choice(best, cost(best), error(best), told)


def _machine() -> dict[str, Any]:
    return {
        "device": jax.devices()[0].device_kind,
        "cores": os.cpu_count(),
        "processor": processor_name(),
        "jax": jax.__version__,
        "timed": _TIMED,
        "version": __version__,
    }


def _read(path: pathlib.Path) -> dict[str, Any]:
    try:
        kept = json.loads(path.read_text())
    except (OSError, ValueError):
        return {}
    times = kept.get("times") if isinstance(kept, dict) else None
    whole = isinstance(times, dict) and all(isinstance(known, dict) for known in times.values())
    return kept if whole else {}
