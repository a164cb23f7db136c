"""Cost table of dressing methods: their measured errors and their times on this machine."""

import dataclasses
import functools
import importlib.resources
import json
import math
import pathlib
import statistics
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import jax

from .._environment import cache_folder
from .._version import __version__
from ..data import Outfit, Worn
from ..dressing import Inference, Simulation, make_dresser
from ..errors import PhysXNetError
from ..files import atomic_write, claim
from ..garment import DEFAULT_KINDS, TEMPLATES, Template, tailor
from ..models import read_card
from ..motion import BLOCK, Motion, load_motion
from ..simulation import PRESETS
from ._cost import clothing_cost
from ._method_names import GUIDED, method_by_name, parse_method
from ._saved_rows import machine

_FRAMES = 64
# Calls of a network are timed for this long [s].
_SECONDS = 0.5
# Times with another value of this marker were measured differently and are discarded.
_TIMING_VERSION = "tailored garments together, each profile as a whole"
# A profile is timed for a budget if it is expected to take at most so many times as long.
_DOUBT = 1.5
ALONE_AND_TOGETHER: tuple[tuple[Template, ...], ...] = (*((t,) for t in TEMPLATES), TEMPLATES)
"""Each template alone, and all of them together."""


@dataclasses.dataclass(frozen=True)
class MethodProfile:
    """A dressing method with its error on the twelve test actions of the paper's protocol.

    Attributes:
        name: ``lbs``, a name of weights, optionally with one or more of ``+mirror``,
            ``+relax`` and ``+push`` or with ``+guided``, or an accuracy of the simulator.
        rmse_mm: Root mean square distance of vertices from the simulation at its
            ``standard`` setting [mm], by template: of the shirt, the trousers and the A-line
            dress.
        inside: Share of vertices inside the body by template, pinched ones excluded.
        usual_ms: Time per frame for each template on the machine that measured the errors [ms]:
            which profiles are worth timing here.
    """

    name: str
    rmse_mm: dict[str, float]
    inside: dict[str, float]
    usual_ms: dict[str, float]

    @property
    def kind(self) -> str:
        """Profiles of a kind are faster or slower on a machine by about the same ratio."""
        return self.name if self.name == "lbs" else self.options["method"]

    def __post_init__(self) -> None:
        usual = self.usual_ms
        if set(usual) != set(self.rmse_mm) or not all(x > 0 for x in usual.values()):
            raise ValueError(f"{self.name}: usual_ms needs a positive time for each of rmse_mm.")

    def rank(self, templates: Sequence[str]) -> tuple[float, float]:
        """Key that is least for the most accurate profile.

        If errors are equal to a tenth of a millimetre, fewer vertices inside win.
        """
        return round(self.error_mm(templates), 1), sum(self.inside[t] for t in templates)

    @property
    def options(self) -> dict[str, Any]:
        """The arguments of `dress` that select this profile."""
        if self.name == "lbs":
            return {"method": "lbs", "inference": Inference(collisions=False)}
        if self.name in PRESETS:
            return {"method": "simulate", "simulation": Simulation(accuracy=self.name)}  # pyright: ignore[reportArgumentType]
        if self.name.endswith(GUIDED):
            weights = parse_method(self.name).weights
            return {"method": "guided", "inference": Inference(weights=weights)}
        return {"method": "network", "inference": parse_method(self.name)}

    @property
    def identity(self) -> str:
        """Key of the profile's times, which changes with its weights."""
        if self.name == "lbs" or self.name in PRESETS:
            return self.name
        card = read_card(str(parse_method(self.name).weights))
        return f"{self.name} {card['sha256'][:12]}"

    def error_mm(self, templates: Sequence[str]) -> float:
        """Mean error of some garments [mm]."""
        return statistics.fmean(self.rmse_mm[t] for t in templates)


@dataclasses.dataclass(frozen=True)
class Selection:
    """The selected profile, with its time and error.

    Attributes:
        profile: The profile.
        ms_per_frame: Its time on this machine for the requested garments [ms].
        rmse_mm: Its mean error over them [mm].
        summary: A sentence for the user.
    """

    profile: MethodProfile
    ms_per_frame: float
    rmse_mm: float
    summary: str


def load_cost_table() -> list[MethodProfile]:
    """Loads the profiles whose errors ship with the package."""
    path = importlib.resources.files(__name__.rpartition(".")[0]) / "cost_table.json"
    return [MethodProfile(**r) for r in json.loads(path.read_text())]


def calibration_file() -> pathlib.Path:
    """Path of this machine's cached times."""
    return cache_folder() / "calibration.json"


def worn_key(templates: Sequence[str]) -> str:
    """Key of the time of garments worn together, such as ``bottom+top``."""
    return "+".join(sorted(templates))


def calibrate(
    profiles: Sequence[MethodProfile],
    worn: Sequence[Sequence[Template]] = ALONE_AND_TOGETHER,
    *,
    path: pathlib.Path | None = None,
    frames: int = _FRAMES,
    report: Callable[[str, int, int], None] | None = None,
) -> dict[str, dict[str, float]]:
    """Times profiles on this machine; each time is measured once and then cached.

    Args:
        profiles: Profiles to time.
        worn: Sets of templates worn together, one for each requested time.
        path: File of the cached times; `calibration_file` by default.
        frames: Number of frames of the built-in walk that are dressed.
        report: Called with a text, the measurements done and the total.

    Returns:
        For each profile and `worn_key`, the median time per frame after warm-up, from joint
        rotations to vertices [ms].
    """
    clock = _Clock(calibration_file() if path is None else path, frames)
    jobs = [(r, w) for r in profiles for w in worn if all(t in r.rmse_mm for t in w)]
    for k, (profile, templates) in enumerate(jobs):
        if report is not None:
            report(f"timing {profile.name}, {', '.join(templates)}", k, len(jobs))
        clock.time_of(profile, templates)
    return {r.name: dict(clock.times.get(r.identity, {})) for r in profiles}


class _Clock:
    """Times profiles and caches the results."""

    def __init__(self, path: pathlib.Path, frames: int) -> None:
        cached = _read(path)
        self._path = path
        self._machine = machine() | {"timed": _TIMING_VERSION, "version": __version__}
        same = cached.get("machine") == self._machine
        self.times: dict[str, dict[str, float]] = cached["times"] if same else {}
        self._frames = frames

    @functools.cached_property
    def _walk(self) -> Motion:
        walk = load_motion("walk", fps=30.0)
        return Motion(
            walk.rotations[: self._frames], walk.root[: self._frames], walk.fps, walk.name
        )

    def time_of(self, profile: MethodProfile, templates: Sequence[Template]) -> float:
        """Time per frame [ms]."""
        known = self.times.setdefault(profile.identity, {})
        key = worn_key(templates)
        if key not in known:
            ms = self._measure(profile, templates)
            self._store(known, key, ms)
        return known[key]

    def _measure(self, profile: MethodProfile, templates: Sequence[Template]) -> float:
        if profile.options["method"] not in ("network", "guided"):
            # These dress one garment at a time.
            method = method_by_name(profile.name)
            worn = (Worn(outfit=Outfit(wear=(DEFAULT_KINDS[t],)), template=t) for t in templates)
            return sum(method(self._walk, w).ms_per_frame for w in worn)
        garments = [tailor(DEFAULT_KINDS[t]) for t in templates]
        dresser = make_dresser(garments, **profile.options)
        return clothing_cost(dresser, self._walk, BLOCK, seconds=_SECONDS)["ms_per_frame"]

    def _store(self, known: dict[str, float], key: str, ms: float) -> None:
        known[key] = ms
        with claim(self._path, wait=True):
            # Another process may have cached times meanwhile.
            cached = _read(self._path)
            if cached.get("machine") == self._machine:
                for name, times in cached["times"].items():
                    mine = self.times.setdefault(name, {})
                    mine.update({k: v for k, v in times.items() if k not in mine})
            with atomic_write(self._path) as part:
                cached = {"machine": self._machine, "times": self.times}
                part.write_text(json.dumps(cached, indent=1) + "\n")


def choose_method(
    templates: Sequence[Template],
    profiles: Sequence[MethodProfile],
    *,
    budget_ms: float | None = None,
    max_error_mm: float | None = None,
    path: pathlib.Path | None = None,
    frames: int = _FRAMES,
    report: Callable[[str, int, int], None] | None = None,
) -> Selection:
    """`select_method`, timing on this machine only the profiles that matter.

    Profiles without a time here are expected to take their `MethodProfile.usual_ms`, times the
    ratio that those of their kind have shown, on a CPU that of other kinds where none of their own
    has been timed. With a budget the most accurate profile that may fit is timed, until one fits:
    those that are expected to take up to 1.5 times as long; on another device than a CPU, of which
    nothing is usual, any of a kind that hasn't been timed. With an error the one that is expected
    to be fastest is timed, until it is.

    Args:
        templates: Template of each garment to wear.
        profiles: Profiles to choose from.
        budget_ms: Largest time per frame for all garments together [ms].
        max_error_mm: Largest mean error over the garments [mm].
        path: File of the cached times; `calibration_file` by default.
        frames: Number of frames of the built-in walk that are dressed.
        report: Called with a text, the profiles timed and that number with the next.

    Raises:
        PhysXNetError: No profile is that fast or that accurate; the text names the nearest.
    """
    _check_request(templates, budget_ms, max_error_mm)
    clock = _Clock(calibration_file() if path is None else path, frames)
    key = worn_key(templates)
    able = [r for r in profiles if all(t in r.rmse_mm for t in templates)]
    # What is usual is so on a CPU.
    usual_here = jax.default_backend() == "cpu"

    def known() -> dict[str, float]:
        """Times of the profiles that have one here."""
        found = {r.name: clock.times.get(r.identity, {}).get(key) for r in able}
        return {name: ms for name, ms in found.items() if ms is not None}

    def expected() -> dict[str, tuple[float, float]]:
        """For each profile its expected time, and how many times as short it may be."""
        usual = {r.name: sum(r.usual_ms[t] for t in templates) for r in able}
        here, kinds = known(), {r.name: r.kind for r in able}
        out = {}
        for name, ms in usual.items():
            ratio = {n: here[n] / usual[n] for n in here}
            own = [x for n, x in ratio.items() if kinds[n] == kinds[name]]
            ratios = own or (list(ratio.values()) if usual_here else [])
            first = 1.0 if usual_here else math.inf
            out[name] = (ms * statistics.median(ratios or [1.0]), _DOUBT if ratios else first)
        return out | {name: (ms, 1.0) for name, ms in here.items()}

    while able:
        here, found = known(), expected()
        guess = {name: ms for name, (ms, _) in found.items()}
        if budget_ms is not None:
            fits = [r for r in able if guess[r.name] <= budget_ms * found[r.name][1]]
            best = min(fits, key=lambda r: r.rank(templates), default=None)
        else:
            fits = [r for r in able if r.error_mm(templates) <= (max_error_mm or 0.0)]
            best = min(fits, key=lambda r: guess[r.name], default=None)
        # Nothing may do: the text of the error names the nearest, with its time here.
        best = best or min(
            able,
            key=lambda r: guess[r.name] if max_error_mm is None else r.error_mm(templates),
        )
        if best.name in here:
            break
        if report is not None:
            report(f"timing {best.name}, {', '.join(templates)}", len(here), len(here) + 1)
        clock.time_of(best, templates)
    return select_method(
        templates,
        {name: {key: ms} for name, ms in known().items()},
        profiles,
        budget_ms=budget_ms,
        max_error_mm=max_error_mm,
    )


def select_method(
    templates: Sequence[str],
    times: Mapping[str, Mapping[str, float]],
    profiles: Sequence[MethodProfile],
    *,
    budget_ms: float | None = None,
    max_error_mm: float | None = None,
) -> Selection:
    """The most accurate profile within a time, or the fastest within an error.

    Args:
        templates: Template of each garment to wear.
        times: Result of `calibrate` for these templates together.
        profiles: Profiles to choose from.
        budget_ms: Largest time per frame for all garments together [ms].
        max_error_mm: Largest mean error over the garments [mm].

    Raises:
        PhysXNetError: No profile is that fast or that accurate; the text names the nearest.
    """
    _check_request(templates, budget_ms, max_error_mm)

    def cost(r: MethodProfile) -> float:
        return times[r.name][key]

    def error(r: MethodProfile) -> float:
        return r.error_mm(templates)

    key = worn_key(templates)
    candidates = [
        r
        for r in profiles
        if all(t in r.rmse_mm for t in templates) and key in times.get(r.name, {})
    ]
    if not candidates:
        raise PhysXNetError(f"no profile has a time and an error for {', '.join(templates)}.")
    if budget_ms is not None:
        within = [r for r in candidates if cost(r) <= budget_ms]
        best = min(within, key=lambda r: r.rank(templates), default=None)
        nearest = min(candidates, key=cost)
        asked = f"{budget_ms:g} ms a frame"
    else:
        assert max_error_mm is not None
        within = [r for r in candidates if error(r) <= max_error_mm]
        best = min(within, key=cost, default=None)
        nearest = min(candidates, key=error)
        asked = f"an error of {max_error_mm:g} mm"
    if best is None:
        raise PhysXNetError(
            f"no profile dresses {', '.join(templates)} within {asked}; the nearest is"
            f" {nearest.name}: {cost(nearest):.2f} ms a frame, {error(nearest):.1f} mm."
        )
    summary = (
        f"picked {best.name}: {cost(best):.2f} ms a frame for such templates on this machine"
        f" (calibrated), {error(best):.1f} mm from the simulation on the test actions"
    )
    better = [r for r in candidates if error(r) < error(best) - 0.05]
    if better:
        finer = min(better, key=cost)
        summary += f"; {finer.name} would take {cost(finer):.2f} ms for {error(finer):.1f} mm"
    return Selection(best, cost(best), error(best), summary)


def _check_request(
    templates: Sequence[str], budget_ms: float | None, max_error_mm: float | None
) -> None:
    if (budget_ms is None) == (max_error_mm is None):
        raise PhysXNetError("give either a time (budget_ms) or an error (max_error_mm).")
    if not templates:
        raise PhysXNetError("nothing is worn: templates is empty.")


def _read(path: pathlib.Path) -> dict[str, Any]:
    try:
        cached = json.loads(path.read_text())
    except (OSError, ValueError):
        return {}
    times = cached.get("times") if isinstance(cached, dict) else None
    whole = isinstance(times, dict) and all(isinstance(known, dict) for known in times.values())
    return cached if whole else {}
