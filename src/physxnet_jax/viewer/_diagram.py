"""Work-precision diagrams."""

import pathlib
from collections.abc import Mapping, Sequence

from ..errors import MissingDependencyError
from ..files import atomic_write

# Markers distinguish methods beyond the tenth, whose colours repeat.
_MARKS = "osD^"
_LINES = ("--", "-.")


def draw_work_precision(
    path: str | pathlib.Path,
    points: Sequence[tuple[str, str, float, float]],
    floors: Mapping[str, float],
    times: Mapping[str, Mapping[str, float]] | None = None,
) -> pathlib.Path:
    """Draws error against time, a panel for each scene, both axes logarithmic.

    Args:
        path: A PNG file.
        points: Scene, method, error [mm] and time [ms per frame]; a method's points are
            joined in the given order.
        floors: Noise floor of a scene [mm]; a point below it is drawn hollow.
        times: By scene, times of methods without a known error [ms per frame].

    Raises:
        MissingDependencyError: matplotlib isn't installed.
    """
    try:
        from matplotlib.backends.backend_agg import FigureCanvasAgg
        from matplotlib.figure import Figure
        from matplotlib.ticker import NullFormatter
    except ImportError as error:
        raise MissingDependencyError(
            "Diagrams need matplotlib: pip install 'physxnet-jax[render]'."
        ) from error
    scenes = list(dict.fromkeys(p[0] for p in points))
    figure = Figure(figsize=(4.6 * max(len(scenes), 1), 4.6), layout="constrained")
    FigureCanvasAgg(figure)
    methods = list(dict.fromkeys(p[1] for p in points))
    times = times or {}
    timed = dict.fromkeys(name for known in times.values() for name in known)
    lines = {name: _LINES[k % len(_LINES)] for k, name in enumerate(timed)}
    for k, scene in enumerate(scenes):
        axes = figure.add_subplot(1, len(scenes), k + 1)
        for m, method in enumerate(methods):
            mine = [(e, t) for s, n, e, t in points if (s, n) == (scene, method) and e > 0]
            if not mine:
                continue
            error, time = zip(*mine, strict=True)
            # A method has one colour and mark in all panels.
            colour = f"C{m % 10}"
            mark = _MARKS[m // 10 % len(_MARKS)]
            axes.plot(time, error, "-", marker=mark, color=colour, label=method)
            for e, t in zip(error, time, strict=True):
                below = e < floors.get(scene, 0.0)
                axes.plot([t], [e], mark, color=colour, mfc="white" if below else colour)
        if scene in floors:
            axes.axhline(floors[scene], color="grey", ls=":", lw=1, label="noise floor")
        for name, ms in times.get(scene, {}).items():
            axes.axvline(ms, color="black", ls=lines[name], lw=1, label=name)
        axes.set(xscale="log", yscale="log", title=scene, xlabel="time [ms a frame]")
        axes.xaxis.set_minor_formatter(NullFormatter())
        axes.set_ylabel("error, rms [mm]")
        axes.grid(True, which="major", alpha=0.3)
    drawn = [axes.get_legend_handles_labels() for axes in figure.axes]
    legend = {name: handle for handles, names in drawn for handle, name in zip(handles, names)}
    figure.legend(legend.values(), legend.keys(), loc="outside lower center", ncols=4, fontsize=7)
    path = pathlib.Path(path)
    with atomic_write(path) as part:
        figure.savefig(part, dpi=120, format="png")
    return path


def draw_bars(
    path: str | pathlib.Path, bars: Sequence[tuple[str, str, str, float]], label: str
) -> pathlib.Path:
    """Draws bars of every method side by side for every action, a panel for each garment.

    Args:
        path: A PNG file.
        bars: Panel, action, method and value.
        label: Label of the value axis.

    Raises:
        MissingDependencyError: matplotlib isn't installed.
    """
    try:
        from matplotlib import colormaps
        from matplotlib.backends.backend_agg import FigureCanvasAgg
        from matplotlib.figure import Figure
    except ImportError as error:
        raise MissingDependencyError(
            "Charts need matplotlib: pip install 'physxnet-jax[render]'."
        ) from error
    panels = list(dict.fromkeys(b[0] for b in bars))
    methods = list(dict.fromkeys(b[2] for b in bars))
    figure = Figure(figsize=(12.5, 3.2 * max(len(panels), 1)), layout="constrained")
    FigureCanvasAgg(figure)
    for k, panel in enumerate(panels):
        axes = figure.add_subplot(len(panels), 1, k + 1)
        mine = {(a, m): v for p, a, m, v in bars if p == panel}
        actions = list(dict.fromkeys(a for a, _ in mine))
        here = [m for m in methods if any(m == b for _, b in mine)]
        width = 0.8 / len(here)
        for i, method in enumerate(here):
            have = [(j, mine[a, method]) for j, a in enumerate(actions) if (a, method) in mine]
            if have:
                at, values = zip(*have, strict=True)
                # A method has one colour in all panels.
                colour = colormaps["tab20"](methods.index(method) % 20)
                places = [j + (i + 0.5) * width - 0.4 for j in at]
                axes.bar(places, values, width, label=method, color=colour)
        axes.set(title=panel, ylabel=label)
        axes.set_xticks(range(len(actions)), actions, rotation=20, ha="right", fontsize=8)
        axes.grid(True, axis="y", alpha=0.3)
        axes.legend(fontsize=7, loc="upper left", bbox_to_anchor=(1.0, 1.0))
    path = pathlib.Path(path)
    with atomic_write(path) as part:
        figure.savefig(part, dpi=110, format="png")
    return path
