"""Time of each part of a simulated frame beside its floor.

Command: python experiments/part_times.py [--data ../shared]
Cost:    two minutes on two cores; needs a C compiler (cc) for the yardstick.
Result:  experiments/results/part_times.json and .md: for the dress on punch and the trousers on
         salsa (mocap/daz/060_12.bvh from 4 s) at `standard`, the time of each part on its own.
         Its floor is the time in which a compiled loop (C, one core, -O3) does the same
         arithmetic on the same data (for the search of contact without the lists of loose cloth,
         normals and bounds of heights: a lower floor than the work has); where no such loop was
         written, the larger of its bytes over the bandwidth that a compiled copy reaches on as
         many bytes and of its operations over the rate of a compiled multiply-add. All are
         medians; parts and loops take turns.
         Last, the time of a whole frame, and of one without contact with the body.
"""

import argparse
import ctypes
import dataclasses
import os
import pathlib
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from rich.progress import track

import physxnet_jax as px
from convergence import clip
from physxnet_jax.evaluation import machine
from physxnet_jax.files import atomic_write, write_json
from physxnet_jax.simulation import (
    PRESETS,
    STANDARD,
    Clock,
    Scene,
    advance,
    make_system,
    prepare_scene,
    simulate_batch,
    start_state,
)
from physxnet_jax.simulation._effect import Step
from physxnet_jax.simulation._state import place
from physxnet_jax.simulation.effects import BodyContact

RESULTS = pathlib.Path(__file__).parent / "results"
CASES = (("dress", "punch"), ("bottom", "salsa"))
FRAME, TIMED, ROUNDS, REPEATS, FPS = 20, 10, 15, 100, 30.0
SOLVER = PRESETS["standard"]

LOOPS = r"""
#include <math.h>
typedef float f;
void copy(int n, const f *a, f *b) { for (int i = 0; i < n; i++) b[i] = a[i] + 1.0f; }
f madd(int n) {
  f x[64]; for (int i = 0; i < 64; i++) x[i] = i;
  for (int k = 0; k < n; k++) for (int i = 0; i < 64; i++) x[i] = x[i] * 0.999f + 0.5f;
  f s = 0; for (int i = 0; i < 64; i++) s += x[i]; return s;
}
void stretch(int n, const int *a, const int *b, const f *edge, const f *wa, const f *wb,
             const f *rest, const f *soft, f h, f *d) {
  for (int e = 0; e < n; e++) {
    f *p = d + 3 * a[e], *q = d + 3 * b[e], s[3], l = 1e-18f;
    for (int k = 0; k < 3; k++) { s[k] = edge[3 * e + k] + q[k] - p[k]; l += s[k] * s[k]; }
    l = sqrtf(l);
    f x = l - rest[e], al = soft[e] * (x < 0 ? 5.0f : 1.0f) / (h * h);
    f c = x / (l * (wa[e] + wb[e] + al));
    for (int k = 0; k < 3; k++) { p[k] += wa[e] * c * s[k]; q[k] -= wb[e] * c * s[k]; }
  }
}
void bend(int n, int width, const int *near, const f *value, const f *base, f h2, const f *x,
          f *out) {
  for (int i = 0; i < n; i++) {
    f s[3] = {base[3 * i], base[3 * i + 1], base[3 * i + 2]};
    for (int j = 0; j < width; j++) {
      const f *y = x + 3 * near[j * n + i]; f v = value[j * n + i];
      for (int k = 0; k < 3; k++) s[k] += v * (x[3 * i + k] - y[k]);
    }
    for (int k = 0; k < 3; k++) out[3 * i + k] = x[3 * i + k] + h2 * s[k];
  }
}
void contact(int n, const f *where, const f *way, const f *normal, const f *turn, const f *low,
             const f *rise, const f *mu, f t, f share, const f *start, f *x) {
  for (int i = 0; i < n; i++) {
    f m[3], l = 1e-12f, g = 0, s[3], o = 0, z = 1e-18f;
    for (int k = 0, j = 3 * i; k < 3; k++, j++) {
      m[k] = normal[j] + t * turn[j]; l += m[k] * m[k];
    }
    l = 1.0f / sqrtf(l);
    for (int k = 0, j = 3 * i; k < 3; k++, j++) {
      m[k] *= l; g += (x[j] - where[j] - t * way[j]) * m[k];
    }
    f lift = fmaxf(low[i] + t * rise[i] - g, 0.0f);
    for (int k = 0, j = 3 * i; k < 3; k++, j++) {
      x[j] += lift * m[k]; s[k] = x[j] - start[j] - share * way[j]; o += s[k] * m[k];
    }
    for (int k = 0; k < 3; k++) { s[k] -= o * m[k]; z += s[k] * s[k]; }
    f hold = fminf(1.0f, mu[i] * lift / sqrtf(z));
    for (int k = 0; k < 3; k++) x[3 * i + k] -= hold * s[k];
  }
}
static f dot(const f *a, const f *b) { return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]; }
static f segment(const f *p, const f *a, const f *b) {
  f e[3], q[3], g[3];
  for (int k = 0; k < 3; k++) { e[k] = b[k] - a[k]; q[k] = p[k] - a[k]; }
  f t = fminf(fmaxf(dot(e, q) / (dot(e, e) + 1e-20f), 0.0f), 1.0f);
  for (int k = 0; k < 3; k++) g[k] = q[k] - t * e[k];
  return dot(g, g);
}
static f triangle(const f *p, const f *a, const f *b, const f *c) {
  f u[3], v[3], q[3], g[3];
  for (int k = 0; k < 3; k++) { u[k] = b[k] - a[k]; v[k] = c[k] - a[k]; q[k] = p[k] - a[k]; }
  f uu = dot(u, u), uv = dot(u, v), vv = dot(v, v), qu = dot(q, u), qv = dot(q, v);
  f d = uu * vv - uv * uv + 1e-20f, s = (vv * qu - uv * qv) / d, t = (uu * qv - uv * qu) / d;
  if (s > 0 && t > 0 && s + t < 1) {
    for (int k = 0; k < 3; k++) g[k] = q[k] - s * u[k] - t * v[k];
    return dot(g, g);
  }
  return fminf(segment(p, a, b), fminf(segment(p, b, c), segment(p, c, a)));
}
void search(int n, int hops, int ring, int skin, int patch, const int *rings, const int *corners,
            const f *x, const f *body, const int *start, int samples, const int *sample,
            int *face, f *gap) {
  for (int i = 0; i < n; i++) {
    int at = start[i];
    for (int h = 0; h < hops; h++) {
      f best = 1e9f; int to = at;
      for (int j = 0; j < ring; j++) {
        int v = rings[j * skin + at]; f g[3];
        for (int k = 0; k < 3; k++) g[k] = body[3 * v + k] - x[3 * i + k];
        f d = dot(g, g); if (d < best) { best = d; to = v; }
      }
      if (to == at) break;
      at = to;
    }
    f best = 1e9f;
    for (int j = 0; j < patch; j++) {
      const int *c = corners + 3 * j * skin;
      f d = triangle(x + 3 * i, body + 3 * c[at], body + 3 * c[skin + at],
                     body + 3 * c[2 * skin + at]);
      if (d < best) { best = d; face[i] = j; }
    }
  }
  for (int i = 0; i < samples; i++) {
    f best = 1e9f;
    for (int j = 0; j < samples; j++) {
      f g[3];
      for (int k = 0; k < 3; k++) g[k] = body[3 * sample[j] + k] - body[3 * sample[i] + k];
      f d = j == i ? 1e9f : dot(g, g);
      best = fminf(best, d);
    }
    gap[i] = best;
  }
}
"""


@dataclasses.dataclass(frozen=True)
class Row:
    """One part of a frame of one case."""

    garment: str
    action: str
    part: str
    calls_per_frame: int
    microseconds: float
    floor_microseconds: float
    floor: str

    @property
    def ratio(self) -> float:
        """Time over the floor."""
        return self.microseconds / self.floor_microseconds


def compiled() -> ctypes.CDLL:
    """The C loops, compiled for this machine."""
    folder = pathlib.Path(tempfile.mkdtemp())
    (folder / "loops.c").write_text(LOOPS)
    words = ["cc", "-O3", "-march=native", "-ffast-math", "-shared", "-fPIC"]
    words += [str(folder / "loops.c"), "-o", str(folder / "loops.so"), "-lm"]
    subprocess.run(words, check=True)
    return ctypes.CDLL(str(folder / "loops.so"))


def call(function: Any, *words: Any) -> Callable[[], None]:
    """A call of a C function; arrays are passed by address and kept alive."""
    kept = [np.ascontiguousarray(w) if isinstance(w, np.ndarray) else w for w in words]

    def run() -> None:
        function(
            *(
                w.ctypes.data_as(ctypes.c_void_p)
                if isinstance(w, np.ndarray)
                else ctypes.c_float(w)
                if isinstance(w, float)
                else w
                for w in kept
            )
        )

    return run


def seconds(run: Callable[[], Any]) -> float:
    began = time.perf_counter()
    jax.block_until_ready(run())
    return time.perf_counter() - began


def repeated(run: Callable[[], None]) -> Callable[[], None]:
    def many() -> None:
        for _ in range(REPEATS):
            run()

    return many


def size_of(*trees: Any) -> int:
    return sum(x.nbytes for x in jax.tree.leaves(trees) if hasattr(x, "nbytes"))


def operations(f: Any, *words: Any) -> float:
    cost = jax.jit(f).lower(*words).compile().cost_analysis() or {}
    return float(cost.get("flops", 0.0))


def parts_of(garment: str, action: str, data: pathlib.Path, loops: ctypes.CDLL) -> list[Row]:
    motion = clip(action, data)
    scene = prepare_scene(Scene((px.template(garment),)))
    system = make_system(scene, SOLVER)
    rotations, root = motion.rotations[:, None], motion.root[:, None]
    x = simulate_batch(scene, [motion], solver=PRESETS["draft"])[0].positions[0][FRAME]
    x = jnp.asarray(x)[:, :, None]
    h = 1.0 / (FPS * SOLVER.substeps)
    count = SOLVER.substeps // SOLVER.contact_updates
    begun = SOLVER.at_step(system, h)
    step = Step(h, 1.0 / count)
    clock = Clock(jnp.zeros(()), count * h)
    still = jnp.zeros_like(x)

    def skin(points: Any, q: jax.Array, p: jax.Array) -> Any:
        return None if points is None else place(begun.body, begun.rest, points, q, p)

    timed: dict[str, tuple[int, Callable[[], Any], float, int, float]] = {}

    def add(name: str, calls: int, f: Any, words: tuple, repeats: int, touched: int) -> None:
        done = jax.jit(f)
        flops = operations(f, *words)
        # XLA counts the body of a loop once.
        timed[name] = (calls, lambda: done(*words), 1.0 / repeats, touched, flops)

    for e in begun.effects:
        name = type(e).__name__.strip("_")
        points = e.skinned_points
        a, b = (skin(points, rotations[k], root[k]) for k in (FRAME, FRAME + 1))
        state = e.init_state(1)

        def start(e: Any, x: Any, a: Any, b: Any, state: Any) -> Any:
            return e.begin(x, a, b, clock, state)

        context = jax.jit(start)(e, x, a, b, state)
        if points is not None and points.rest.shape[0] > 1000:
            words = (points, rotations[FRAME], root[FRAME])
            add(f"{name}: skinning", 1, skin, words, 1, size_of(points, a))
        if context is not None and name != "Pin":
            words = (e, x, a, b, state)
            add(f"{name}: search", SOLVER.contact_updates, start, words, 1, size_of(words, context))
        if type(e).project is not px.simulation.Prepared.project and name != "Pin":

            def sweep(e: Any, d: Any, context: Any) -> Any:
                def one(i: Any, d: Any) -> Any:
                    share = (i + 1).astype(d.dtype) / REPEATS
                    return e.project(d, d, context, share, step)

                return jax.lax.fori_loop(0, REPEATS, one, d)

            words = (e, still, context)
            add(f"{name}: substep", SOLVER.substeps, sweep, words, REPEATS, size_of(context, d3(x)))
    yard = yardsticks(begun, x, loops, h, skin(body_of(begun), rotations[FRAME], root[FRAME]))
    everything: dict[str, Callable[[], Any]] = {k: v[1] for k, v in timed.items()} | yard
    largest = max(v[3] for v in timed.values()) // 8
    source = np.zeros(largest, np.float32)
    everything["copy"] = repeated(call(loops.copy, largest, source, source.copy()))
    everything["madd"] = call(loops.madd, 100000)
    laps: dict[str, list[float]] = {k: [] for k in everything}
    for run in everything.values():
        run()
    for _ in range(ROUNDS):
        for k, run in everything.items():
            laps[k].append(seconds(run))
    median = {k: float(np.median(v)) for k, v in laps.items()}
    bandwidth = 8.0 * largest * REPEATS / median["copy"]
    rate = 2.0 * 64 * 100000 / median["madd"]
    rows = []
    for name, (calls, _, share, touched, flops) in timed.items():
        took = 1e6 * median[name] * share
        loop = f"loop {name}"
        if loop in median:
            floor, kind = 1e6 * median[loop] / REPEATS, "compiled loop"
        else:
            by = 1e6 * touched / bandwidth, 1e6 * flops / rate
            floor, kind = max(by), "bytes" if by[0] >= by[1] else "operations"
        rows.append(Row(garment, action, name, calls, took, floor, kind))
    return rows + whole_frames(garment, action, scene, motion, x)


def d3(x: jax.Array) -> tuple[jax.Array, jax.Array, jax.Array]:
    return x, x, x


def body_of(system: Any) -> Any:
    """The skin that contact poses."""
    return next(e.skin for e in system.effects if type(e).__name__ == "_Contact")


def yardsticks(
    system: Any, x: jax.Array, loops: ctypes.CDLL, h: float, posed: Any
) -> dict[str, Callable[[], None]]:
    """Compiled loops with the data of the effects."""
    n = len(x)
    zero = np.zeros((n, 3), np.float32)
    out: dict[str, Callable[[], None]] = {}
    for e in system.effects:
        kind = type(e).__name__
        if kind == "_Stretch":
            s = e.springs
            a, b = (np.asarray(i) for i in s.ends)
            edge = np.asarray(x[s.ends[1]] - x[s.ends[0]])
            words = [np.asarray(w).ravel() for w in (*s.weight, s.length, s.compliance)]
            out["loop Stretch: substep"] = repeated(
                call(loops.stretch, len(a), a, b, edge, *words, h, zero.copy())
            )
        if kind == "_Bend":
            near, values = np.asarray(e.rows.near), np.asarray(e.values)
            words = (near, values[: near.size], zero, h * h, zero, zero.copy())
            out["loop Bend: substep"] = repeated(call(loops.bend, n, len(near), *words))
        if kind == "_Contact":
            up = np.tile(np.asarray([0, 1, 0], np.float32), (n, 1))
            flat = np.zeros(n, np.float32)
            words = (zero, zero, up, zero, flat, flat, flat, 0.5, 0.01, zero, zero.copy())
            out["loop Contact: substep"] = repeated(call(loops.contact, n, *words))
            body = np.ascontiguousarray(np.asarray(posed.points)[:, :, 0])
            # Tight cloth starts as at rest, loose cloth at the nearest of its list.
            start = np.zeros(n, np.int32)
            tight = np.asarray(e.tight)
            own = tight < n
            start[tight[own]] = np.asarray(e.start)[own]
            loose = np.asarray(e.loose)
            loose, listed = loose[loose < n], np.asarray(e.listed)[:, loose < n]
            away = body[listed] - np.asarray(x)[loose, :, 0][None]
            best = (away**2).sum(axis=2).argmin(axis=0)
            start[loose] = listed[best, np.arange(len(loose))]
            sample = np.asarray(e.pinch.samples)
            words = (e.hops, len(e.ring), len(body), len(e.table), *map(np.asarray, (e.ring,)))
            words += (np.asarray(e.corners), np.asarray(x), body, start, len(sample), sample)
            words += (np.zeros(n, np.int32), np.zeros(len(sample), np.float32))
            out["loop Contact: search"] = repeated(call(loops.search, n, *words))
    return out


def whole_frames(garment: str, action: str, scene: Any, motion: Any, x: jax.Array) -> list[Row]:
    """A frame, and one without contact, whose difference is contact's share."""
    others = tuple(e for e in STANDARD if not isinstance(e, BodyContact))
    bare = prepare_scene(Scene((px.template(garment),), others))
    laps: dict[str, list[float]] = {"frame": [], "frame without contact": []}
    runs = {}
    for name, which in zip(laps, (scene, bare), strict=True):
        system = make_system(which, SOLVER)
        state = start_state(system, x, solver=SOLVER, fps=FPS)
        part = slice(FRAME, FRAME + TIMED + 1)
        words = (motion.rotations[part, None], motion.root[part, None])
        runs[name] = (system, state, *words)
        jax.block_until_ready(advance(*runs[name], solver=SOLVER, fps=FPS))
    for _ in range(7):
        for name, words in runs.items():
            laps[name].append(
                seconds(lambda words=words: advance(*words, solver=SOLVER, fps=FPS)) / TIMED
            )
    nothing = float("nan")
    return [
        Row(garment, action, name, 1, 1e6 * float(np.median(v)), nothing, "")
        for name, v in laps.items()
    ]


def table(rows: list[Row]) -> str:
    lines = []
    for garment, action in CASES:
        part = [r for r in rows if (r.garment, r.action) == (garment, action)]
        whole = {r.part: r.microseconds for r in part if r.part.startswith("frame")}
        share = 1.0 - whole["frame without contact"] / whole["frame"]
        lines += [
            f"### {garment} on {action}",
            "",
            f"A frame takes {1e-3 * whole['frame']:.1f} ms, of which contact with the body takes"
            f" {100 * share:.0f} %.",
            "",
            "| part | calls a frame | µs a call | floor µs | by | times its floor | ms a frame |",
            "|---|---|---|---|---|---|---|",
        ]
        for r in part:
            if not np.isnan(r.floor_microseconds):
                lines.append(
                    f"| {r.part} | {r.calls_per_frame} | {r.microseconds:.0f} |"
                    f" {r.floor_microseconds:.0f} | {r.floor} | {r.ratio:.1f} |"
                    f" {1e-3 * r.microseconds * r.calls_per_frame:.1f} |"
                )
        lines.append("")
    return "\n".join(lines)


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--data", default=os.environ.get("PHYSXNET_DATA", "../shared"))
    data, loops = pathlib.Path(parser.parse_args().data), compiled()
    rows: list[Row] = []
    for case in track(CASES, "cases"):
        rows += parts_of(*case, data, loops)
    found = {"machine": machine(), "rows": [dataclasses.asdict(r) for r in rows]}
    write_json(RESULTS / "part_times.json", found)
    with atomic_write(RESULTS / "part_times.md") as partial:
        partial.write_text(table(rows))
    sys.stdout.write(table(rows))
    return 0


if __name__ == "__main__":
    sys.exit(main())
