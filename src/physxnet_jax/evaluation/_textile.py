"""Standard textile tests of a fabric: drape and bending length."""

import dataclasses

import numpy as np
from jaxtyping import Bool, Float, Int

from ..garment import Fabric, free_garment
from ..geometry import smoothing_matrix
from ..simulation import XPBD, Implicit, Scene, Solver, prepare_scene, settle_on_static_body
from ..simulation.effects import Bend, Damping, Gravity, Membrane, Pin

_SPECIMEN, _SUPPORT = 0.15, 0.09
_GRAVITY = 9.81
# The tip of a strip of this many bending lengths dips by 41.5 degrees.
_OVERHANG = 2.0
# How far vertices are moved at random, in edges, before the mesh is evened out.
_UNEVEN = 0.45

DRAPE_BANDS: dict[str, tuple[float, float, str]] = {
    "cotton": (60.0, 76.0, "Gan, Ly and Steven (1991): plain cotton, 68.4 measured"),
    "denim": (70.0, 90.0, "heavy twills, the stiffest class of Cusick (1968)"),
    "silk": (20.0, 40.0, "Matsudaira and Yang (2003): woven silk"),
    "wool": (40.0, 70.0, "worsted suitings, the middle of Cusick (1968)"),
    "jersey": (15.0, 45.0, "limp class; no single source"),
    "leather": (47.0, 70.0, "Memon et al. (2021): garment leather"),
}
"""Published ranges of drape coefficients [%] by fabric, with their sources."""


@dataclasses.dataclass(frozen=True)
class Drape:
    """Result of Cusick's drape test.

    Attributes:
        coefficient: Shadow beyond the support, relative to that of the flat specimen [%].
        folds: Number of folds: the strongest mode of the edge's distance from the axis.
        speed: Greatest vertex speed at the end [m/s], which shows whether the specimen
            has come to rest.
        positions: Vertices of the specimen [m], support in the middle, y up.
        faces: Triangles of the specimen.
    """

    coefficient: float
    folds: int
    speed: float
    positions: Float[np.ndarray, "vertices 3"]
    faces: Int[np.ndarray, "faces 3"]


def drape_test(
    fabric: Fabric, *, edge: float = 0.01, seconds: float = 6.0, solver: Solver | None = None
) -> Drape:
    """Cusick's drape test: a disc of 30 cm hangs over a support of 18 cm.

    The specimen is pinned where it lies on the support; the ring around it falls and
    buckles into folds. Its shadow is measured on a grid of 1 mm.

    Args:
        fabric: The tested fabric.
        edge: Length of the mesh's edges [m].
        seconds: Simulated time to come to rest [s].
        solver: ``XPBD(256, 1)`` by default. With fewer substeps stretching is too soft
            and the ring sinks (for cotton, 62 % at 64 substeps instead of 72 %).

    References:
        Cusick, The measurement of fabric drape (1968); ISO 9073-9.
    """
    v, faces = _disc(_SPECIMEN, edge)
    held = np.flatnonzero(np.hypot(v[:, 0], v[:, 2]) <= _SUPPORT)
    specimen = free_garment(v, faces, pinned=held, fabric=fabric)
    effects = (Gravity(), Damping(), Membrane(), Bend(), Pin())
    scene = prepare_scene(Scene((specimen,), effects))
    # The noise breaks the symmetry: a perfectly symmetric disc wouldn't buckle.
    start = scene.assembly.rest.copy()
    free = np.setdiff1d(np.arange(len(v)), held)
    start[free, 1] += 1e-4 * np.random.default_rng(0).normal(size=len(free))
    solver = XPBD(256, 1) if solver is None else solver
    out = settle_on_static_body(scene, int(30 * seconds), solver=solver, start=start)
    out.check()
    x = out.positions[0][-1].astype(np.float64)
    x = x - scene.assembly.rest[held].mean(axis=0)
    support, flat = np.pi * _SUPPORT**2, _shadow(v, faces)
    coefficient = 100 * (_shadow(x, faces) - support) / (flat - support)
    return Drape(coefficient, _folds(v, x), float(out.diagnostics["speed_max"][-1]), x, faces)


@dataclasses.dataclass(frozen=True)
class Cantilever:
    """Result of the cantilever test.

    Attributes:
        length: Bending length from the fabric's parameters, ``(k / w)^(1/3)`` [m].
        angle: Dip of the tip of a strip twice as long [degrees]; the exact value is 41.5.
        measured: Bending length that Peirce's formula gives for that dip [m].
    """

    length: float
    angle: float
    measured: float


def cantilever_test(fabric: Fabric, *, cells: int = 16, solver: Solver | None = None) -> Cantilever:
    """Cantilever test: a strip 2.5 cm wide overhangs an edge by twice its bending length.

    Args:
        fabric: The tested fabric.
        cells: Number of mesh cells along the overhang.
        solver: Backward Euler with long steps by default: only the equilibrium matters.

    References:
        Peirce, The handle of cloth as a measurable quantity (1930): a strip of length L
        whose tip dips by theta has ``c = L (cos(theta / 2) / (8 tan theta))^(1/3)``;
        ASTM D1388.
    """
    weight = fabric.density * _GRAVITY
    c = (fabric.bend / weight) ** (1 / 3)
    overhang = _OVERHANG * c
    cell = overhang / cells
    columns = max(round(0.025 / cell), 3)
    x, z = np.meshgrid(cell * np.arange(columns + 1), cell * np.arange(-2, cells + 1))
    # The rows at the clamp and at the tip stay in line.
    level = np.isin(z, [z.min(), z[2, 0], z.max()]) | (x == x.min()) | (x == x.max())
    v, faces = _uneven(np.column_stack([x.ravel(), z.ravel()]), level.ravel(), cell)
    pinned = np.flatnonzero(v[:, 2] < 0.1 * cell)
    strip = free_garment(v, faces, pinned=pinned, fabric=fabric)
    effects = (Gravity(), Membrane(), Bend(), Pin())
    scene = prepare_scene(Scene((strip,), effects))
    if solver is None:
        solver = Implicit(4, 1, order=1, newton=3, iterations=300, tolerance=1e-6)
    out = settle_on_static_body(scene, 40, solver=solver, fps=10.0)
    out.check()
    y = out.positions[0][-1].astype(np.float64) - scene.assembly.rest + v
    tip = y[v[:, 2] > overhang - 0.1 * cell].mean(axis=0)
    # Hinges at the clamp bend the strip from half a cell before it.
    free = overhang + 0.5 * cell
    angle = float(np.arctan2(-tip[1], tip[2] + 0.5 * cell))
    measured = free * (np.cos(angle / 2) / (8 * np.tan(angle))) ** (1 / 3)
    return Cantilever(c, float(np.degrees(angle)), float(measured))


def _disc(
    radius: float, edge: float
) -> tuple[Float[np.ndarray, "vertices 3"], Int[np.ndarray, "faces 3"]]:
    """A horizontal disc of uneven triangles with a round rim."""
    n = int(np.ceil(radius / edge)) + 1
    i, j = np.meshgrid(np.arange(-2 * n, 2 * n + 1), np.arange(-2 * n, 2 * n + 1))
    p = edge * np.column_stack([(i + 0.5 * j).ravel(), (np.sqrt(3) / 2 * j).ravel()])
    p = p[np.hypot(p[:, 0], p[:, 1]) < radius - 0.6 * edge]
    count = round(2 * np.pi * radius / edge)
    angles = 2 * np.pi * np.arange(count) / count
    rim = radius * np.column_stack([np.cos(angles), np.sin(angles)])
    return _uneven(np.concatenate([p, rim]), np.arange(len(p) + count) >= len(p), edge)


def _uneven(
    p: Float[np.ndarray, "vertices 2"], held: Bool[np.ndarray, " vertices"], edge: float
) -> tuple[Float[np.ndarray, "vertices 3"], Int[np.ndarray, "faces 3"]]:
    """A level mesh without preferred directions: a regular one would decide where cloth folds."""
    from scipy.spatial import Delaunay

    p = p + np.where(held[:, None], 0.0, _UNEVEN * edge) * np.random.default_rng(0).uniform(
        -1.0, 1.0, p.shape
    )
    for _ in range(10):
        p = np.where(held[:, None], p, smoothing_matrix(Delaunay(p).simplices, len(p)) @ p)
    faces = Delaunay(p).simplices
    side = p[faces[:, 1:]] - p[faces[:, :1]]
    area = np.abs(side[:, 0, 0] * side[:, 1, 1] - side[:, 0, 1] * side[:, 1, 0])
    # Between vertices of a straight border Delaunay leaves flat triangles.
    faces = faces[area > 1e-3 * edge**2].astype(np.int64)
    return np.column_stack([p[:, 0], np.zeros(len(p)), p[:, 1]]), faces


def _shadow(x: Float[np.ndarray, "vertices 3"], faces: Int[np.ndarray, "faces 3"]) -> float:
    """Area of the vertical projection [m^2]; overlaps count once."""
    step, half = 0.001, 0.17
    n = round(2 * half / step)
    dark = np.zeros((n, n), bool)
    p = (x[:, [0, 2]] + half) / step - 0.5
    for a, b, c in p[faces]:
        low = np.maximum(np.ceil(np.minimum(np.minimum(a, b), c)), 0).astype(int)
        high = np.minimum(np.floor(np.maximum(np.maximum(a, b), c)), n - 1).astype(int)
        if (high < low).any():
            continue
        u, v = np.meshgrid(np.arange(low[0], high[0] + 1), np.arange(low[1], high[1] + 1))

        def side(s: np.ndarray, e: np.ndarray, u: np.ndarray = u, v: np.ndarray = v) -> np.ndarray:
            return (e[0] - s[0]) * (v - s[1]) - (e[1] - s[1]) * (u - s[0])

        s = np.stack([side(a, b), side(b, c), side(c, a)])
        inside = (s >= 0).all(axis=0) | (s <= 0).all(axis=0)
        dark[v[inside], u[inside]] = True
    return float(dark.sum()) * step**2


def _folds(rest: Float[np.ndarray, "vertices 3"], x: Float[np.ndarray, "vertices 3"]) -> int:
    """Number of folds: the strongest Fourier mode of the rim's distance from the axis."""
    rim = np.flatnonzero(np.hypot(rest[:, 0], rest[:, 2]) > 0.999 * _SPECIMEN)
    rim = rim[np.argsort(np.arctan2(rest[rim, 2], rest[rim, 0]))]
    r = np.hypot(x[rim, 0], x[rim, 2])
    waves = np.abs(np.fft.rfft(r - r.mean()))
    return int(waves.argmax()) if waves.max() > 1e-4 * len(r) else 0
