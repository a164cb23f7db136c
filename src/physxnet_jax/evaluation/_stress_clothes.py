"""Stress tests with clothes that are hard by their make or by what they are worn over."""

import dataclasses
import functools
from collections.abc import Callable, Iterator

import jax.numpy as jnp
import numpy as np

from ..body import load_body
from ..garment import Garment, carried, subdivide, tailor, template
from ..geometry import boundary_loops, make_mesh, vertex_normals
from ..motion import Motion, load_motion
from ._stress import CASES
from ._stress_worn import (
    FALLEN,
    LAST_INSIDE,
    LAST_STRAIN,
    NOT_FINITE,
    PEER_CASES,
    SLID,
    VISIBLE_INNER,
    VISIBLE_SKIN,
    PeerCase,
    arm_motion,
    one,
    pressed_arms,
    run_own,
)

_FPS = 30.0


def _clip(name: str, frames: int) -> Motion:
    m = load_motion(name, fps=_FPS)
    return dataclasses.replace(m, rotations=m.rotations[:frames], root=m.root[:frames])


def _strip(rows: int, columns: int, closed: bool) -> np.ndarray:
    """Triangles between rows of points, counter-clockwise where columns go to the right."""
    k = np.arange(rows * columns).reshape(rows, columns)
    right = np.roll(k, -1, axis=1)
    if not closed:
        k, right = k[:, :-1], right[:, :-1]
    a, b, c, d = k[:-1].ravel(), right[:-1].ravel(), k[1:].ravel(), right[1:].ravel()
    return np.concatenate([np.column_stack([a, c, b]), np.column_stack([b, c, d])])


def _held(garment: Garment, count: int) -> Garment:
    """The garment with its first vertices held."""
    return dataclasses.replace(garment, pinned=jnp.arange(garment.num_vertices) < count)


def _tunic() -> tuple[Garment, ...]:
    """A tube from the armpits to the thighs with edges of 10 cm, held at its upper border."""
    rows, columns = 9, 12
    share = np.linspace(0.0, 1.0, rows)[:, None]
    angle = np.linspace(0.0, 2 * np.pi, columns, endpoint=False)[None]
    x = (0.175 + 0.10 * share) * np.sin(angle)
    z = 0.04 + (0.155 + 0.05 * share) * np.cos(angle)
    y = np.broadcast_to(0.36 - 0.75 * share, x.shape)
    v = np.stack([x, y, z], axis=-1).reshape(-1, 3)
    worn = carried(make_mesh(v, _strip(rows, columns, True)), "dress", "tunic", load_body())
    return (_held(worn, columns),)


def _fine_dress() -> tuple[Garment, ...]:
    """The dress in 55,000 vertices."""
    coarse = template("dress")
    mesh, _ = subdivide(coarse.mesh, 0.0085)
    return (carried(mesh, "dress", "fine dress", load_body()),)


def _lined_top() -> tuple[Garment, ...]:
    """The top with an outer shell 4 mm over it, sewn to it along all borders."""
    inner = template("top")
    x, f = np.asarray(inner.mesh.vertices), np.asarray(inner.mesh.faces)
    outer = x + 0.004 * vertex_normals(x, f)
    n = len(x)
    faces = [f[:, ::-1], f + n]
    for loop in boundary_loops(f):
        a, b = np.asarray(loop), np.roll(np.asarray(loop), -1)
        faces += [np.column_stack([a, b, a + n]), np.column_stack([b, b + n, a + n])]
    mesh = make_mesh(np.concatenate([x, outer]), np.concatenate(faces))
    return (carried(mesh, "top", "lined top", load_body()),)


def _cape() -> tuple[Garment, ...]:
    """A cape behind the back from shoulder to shoulder, held at its upper edge."""
    rows, columns = 22, 22
    share = np.linspace(0.0, 1.0, rows)[:, None]
    across = np.linspace(-1.0, 1.0, columns)[None]
    x = (0.19 + 0.10 * share) * across
    z = -0.085 - 0.05 * share + 0.05 * across**2
    y = np.broadcast_to(0.46 - 0.85 * share, x.shape)
    v = np.stack([x, y, z], axis=-1).reshape(-1, 3)
    # Seen from behind, columns go to the left.
    faces = _strip(rows, columns, False)[:, ::-1]
    return (_held(carried(make_mesh(v, faces), "dress", "cape", load_body()), columns),)


def _top_over_trousers() -> tuple[Garment, ...]:
    return template("bottom"), template("top")


def _cut(kind: str) -> Callable[[], tuple[Garment, ...]]:
    """A garment of the tailor at its usual measures."""
    return lambda: (tailor(kind),)


def _crossed_arms() -> Motion:
    """Both arms swing forwards and cross in front of the chest."""
    return arm_motion(axis=1, angle=1.9)


_BOUNDS = {
    NOT_FINITE: 0.0,
    LAST_STRAIN: 0.35,
    LAST_INSIDE: 0.5,
    FALLEN: 0.3,
    VISIBLE_SKIN: 0.1,
}

_CLOTHES = {
    "edges_of_ten_centimetres": PeerCase(_tunic, lambda: _clip("spin", 40), _BOUNDS),
    "fifty_thousand_vertices": PeerCase(_fine_dress, lambda: _clip("punch", 6), _BOUNDS),
    "a_lined_top": PeerCase(_lined_top, lambda: _clip("punch", 40), _BOUNDS | {LAST_INSIDE: 1.0}),
    "a_cape_on_a_body_that_touches_itself": PeerCase(_cape, pressed_arms, _BOUNDS),
    # The forearms pass through each other.
    "sleeves_on_crossed_arms": PeerCase(one("top"), _crossed_arms, _BOUNDS | {VISIBLE_SKIN: 0.2}),
    "a_top_over_trousers": PeerCase(
        _top_over_trousers, lambda: _clip("side step", 60), _BOUNDS | {VISIBLE_INNER: 0.1}
    ),
}
_TAILORED = {NOT_FINITE: 0.0, LAST_STRAIN: 0.35, LAST_INSIDE: 0.5, SLID: 80.0, VISIBLE_SKIN: 0.1}
_CLOTHES |= {
    "a_squat_in_a_skirt": PeerCase(_cut("pencil-skirt"), lambda: _clip("squat", 60), _TAILORED),
    "a_full_skirt_spun_and_stopped": PeerCase(
        _cut("full-skirt"), lambda: _clip("spin", 90), _TAILORED
    ),
    "a_strapless_dress_on_jumps": PeerCase(
        _cut("strapless-dress"), lambda: _clip("jump", 60), _TAILORED
    ),
    # The forearms pass through each other.
    "wide_sleeves_on_crossed_arms": PeerCase(
        _cut("loose"), _crossed_arms, _TAILORED | {VISIBLE_SKIN: 0.2}
    ),
}
PEER_CASES |= _CLOTHES


def _rows(name: str) -> Iterator[tuple[str, float, float]]:
    yield from run_own(name)[1]


CASES |= {name: functools.partial(_rows, name) for name in _CLOTHES}
