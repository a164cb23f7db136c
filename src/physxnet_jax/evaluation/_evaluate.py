"""Errors of every action and template: the paper's two figures and further metrics."""

import dataclasses
import math
from collections.abc import Callable, Iterator, Mapping, Sequence as Items
from typing import Any

import jax.numpy as jnp
import numpy as np

from .._environment import clear_caches_if_full
from ..body import load_body
from ..data import Clothing, Sequence, garment_of, usable_garment
from ..garment import Template
from ..simulation import Assembly, prepare_scene
from ..uv import Transference, garment_map_rows, make_atlas
from ._likeness import LOOK_STRIDE
from ._methods import Method, scene_of, skinning
from ._metrics import vertex_error
from ._motion_metrics import (
    acceleration_error,
    angle_error,
    angle_strength,
    area_strain,
    dihedral_angles,
    fold_spectrum,
    jitter,
    spectrum_distance,
)
from ._penetration import penetration
from ._saved_rows import DIGITS
from ._strain import edge_strain
from ._surface_faults import surface_faults

# Resolution of the maps for texel errors, whatever the network's resolution.
_RESOLUTION = 128
# Penetration is measured in every fifth frame: it takes longer than all other metrics.
_PENETRATION_STRIDE = 5


@dataclasses.dataclass(frozen=True)
class ActionError:
    """One method on one action and template.

    Attributes:
        engine: Simulator of the reference.
        method: Name of the method.
        action: Name of the action.
        template: Name of the garment.
        frames: Number of frames.
        mse_texels_mm2: Mean squared distance over valid texels of a 128 x 128 map [mm^2].
        rmse_texels_mm: Its root [mm].
        mse_vertices_mm2: Mean squared distance over the template's vertices [mm^2].
        rmse_vertices_mm: Its root [mm].
        mean_mm: Mean distance [mm].
        p95_mm: 95th percentile of distances [mm].
        max_mm: Largest distance [mm].
        penetration_share: Share of vertices inside the body, pinched ones excluded (every
            fifth frame).
        pinched_share: Share of pinched vertices, see `penetration`.
        penetration_mm: Greatest depth of vertices inside that aren't pinched [mm].
        strain_p99: 99th percentile of the absolute strain of edges [1].
        area_strain_p99: 99th percentile of the absolute strain of triangles' areas [1].
        wrinkle_deg: See `wrinkle_error` [degrees].
        acceleration_error: See the function of that name [m/s^2].
        jitter: Mean jerk [m/s^3].
        jitter_reference: ``jitter`` of the reference [m/s^3].
        finite_share: Share of finite frames; errors are computed over these.
        ms_per_frame: Warm time from joint rotations to this template's vertices [ms].
        fold_strength: Relative to the reference, see the function of that name [1].
        strain_p99_reference: ``strain_p99`` of the reference [1].
        spectrum: Distance to the reference of `fold_spectrum` [1].
        tension_p99: 99th percentile of the strain of edges, negative where they are shorter [1].
        tension_p99_reference: ``tension_p99`` of the reference [1].
        visible_skin: Share of pixels that show skin which came through cloth (every fifteenth
            frame), see `surface_faults`.
        data: Checksum of the reference's offsets; empty if it wasn't recorded.
        weights: Checksum of the network's weights, or of the training data of `nearest` and
            `mlp`; empty if it wasn't recorded.
    """

    engine: str
    method: str
    action: str
    template: str
    frames: int
    mse_texels_mm2: float
    rmse_texels_mm: float
    mse_vertices_mm2: float
    rmse_vertices_mm: float
    mean_mm: float
    p95_mm: float
    max_mm: float
    penetration_share: float
    pinched_share: float
    penetration_mm: float
    strain_p99: float
    area_strain_p99: float
    wrinkle_deg: float
    acceleration_error: float
    jitter: float
    jitter_reference: float
    finite_share: float
    ms_per_frame: float
    fold_strength: float = math.nan
    strain_p99_reference: float = math.nan
    spectrum: float = math.nan
    tension_p99: float = math.nan
    tension_p99_reference: float = math.nan
    visible_skin: float = math.nan
    data: str = ""
    weights: str = ""


def evaluate(
    methods: Mapping[str, Method],
    sequences: Items[Sequence],
    *,
    templates: Items[Template],
    done: Items[ActionError] = (),
    report: Callable[[str, int, int], None] | None = None,
) -> Iterator[ActionError]:
    """Measures methods action by action.

    Args:
        methods: Methods by name.
        sequences: Actions with their reference cloth; garments that came off the body
            there (see `usable_garment`) are left out.
        templates: Garments to evaluate.
        done: Rows measured before, which are skipped.
        report: Called with a text, the rows done and the total.

    Yields:
        A row for each method, action and template, as soon as it is measured.

    References:
        PhysXNet, section 5.2 and figures 4 and 5.
    """
    known = {(r.engine, r.method, r.action, r.template) for r in done}
    jobs: list[tuple[Template, str, Sequence]] = [
        (t, m, s) for t in templates for m in methods for s in sequences if t in s.offsets
    ]
    rows = _ReferenceTables()
    for k, (name, label, sequence) in enumerate(jobs):
        if report is not None:
            report(f"{label}, {sequence.name}, {name}", k, len(jobs))
        meta = sequence.meta[name]
        key = (meta["engine"], label, sequence.name, name)
        if key in known or not usable_garment(meta):
            continue
        yield rows.measure(label, methods[label], sequence, name)


def retime(
    methods: Mapping[str, Method],
    sequences: Items[Sequence],
    rows: Items[ActionError],
    *,
    templates: Items[str],
    report: Callable[[str, int, int], None] | None = None,
) -> Iterator[ActionError]:
    """Measures the times of rows again, one after another, so that their ratios are comparable.

    Args:
        methods: Methods by name; rows of other methods are yielded unchanged.
        sequences: The actions of the rows.
        rows: Rows measured before.
        templates: Garments to time; rows of others are yielded unchanged.
        report: Called with a text, the rows done and the total.

    Yields:
        Every row, in order.
    """
    actions = {s.name: s for s in sequences}
    for k, row in enumerate(rows):
        if report is not None:
            report(f"{row.method}, {row.action}, {row.template}", k, len(rows))
        timed = row.method in methods and row.template in templates
        if timed and row.action in actions:
            sequence = actions[row.action]
            worn = sequence.clothing(row.template)
            prediction = methods[row.method](sequence.motion, worn)
            row = dataclasses.replace(row, ms_per_frame=prediction.ms_per_frame)
        yield row


class _ReferenceTables:
    """Reference data shared by all methods."""

    def __init__(self) -> None:
        self._tables: dict[Clothing, tuple[Assembly, Transference]] = {}
        self._spectra: dict[tuple[str, str], np.ndarray] = {}

    def tables(self, worn: Clothing) -> tuple[Assembly, Transference]:
        if worn not in self._tables:
            body = load_body()
            rest = body.rest_vertices(body.default_shape())
            scene = prepare_scene(scene_of(worn))
            to_cloth = garment_map_rows(make_atlas(_RESOLUTION), body, rest, garment_of(worn))
            self._tables[worn] = (scene.assembly, to_cloth)
        return self._tables[worn]

    def measure(
        self, label: str, method: Method, sequence: Sequence, name: Template
    ) -> ActionError:
        worn, motion = sequence.clothing(name), sequence.motion
        assembly, to_cloth = self.tables(worn)
        reference = skinning()(motion, worn).positions + sequence.offsets[name]
        clear_caches_if_full()
        prediction = method(motion, worn)
        finite = np.asarray(np.isfinite(prediction.positions).all(axis=(1, 2)))
        shown = np.where(finite[:, None, None], prediction.positions, 0.0)
        x, y = shown[finite], reference[finite]
        values: dict[str, Any] = dict.fromkeys(
            (f.name for f in dataclasses.fields(ActionError)), float("nan")
        )
        values |= {
            "engine": sequence.meta[name]["engine"],
            "method": label,
            "action": sequence.name,
            "template": name,
            "frames": motion.num_frames,
            "finite_share": float(finite.mean()),
            "ms_per_frame": prediction.ms_per_frame,
            "jitter_reference": jitter(reference, motion.fps),
            "data": str(sequence.meta[name].get("sha256", ""))[:DIGITS],
            "weights": "",
        }
        if not len(x):
            return ActionError(**values)
        error = vertex_error(x, y)
        gap = np.asarray(to_cloth @ jnp.asarray(x - y))[:, np.asarray(to_cloth.valid)]
        texels = float(np.mean(np.sum((1e3 * gap.astype(np.float64)) ** 2, axis=2)))
        sampled = np.flatnonzero(finite)[::_PENETRATION_STRIDE]
        inside = penetration(assembly, motion, shown, frames=sampled, bare_skin=False)
        free = inside.cloth_inside & ~inside.pinched
        faces = np.asarray(assembly.faces)
        strain, wanted = (edge_strain(assembly, p) for p in (x, y))
        looked = np.flatnonzero(finite)[::LOOK_STRIDE]
        spectrum = fold_spectrum(assembly.rest, faces, x[::LOOK_STRIDE])
        if (sequence.name, name) not in self._spectra:
            shape = fold_spectrum(assembly.rest, faces, reference[::LOOK_STRIDE])
            self._spectra[sequence.name, name] = shape
        angles = [dihedral_angles(faces, p) for p in (x, y)]
        values |= {
            "mse_texels_mm2": texels,
            "rmse_texels_mm": texels**0.5,
            "mse_vertices_mm2": error.mse_mm2,
            "rmse_vertices_mm": error.rmse_mm,
            "mean_mm": error.mean_mm,
            "p95_mm": error.p95_mm,
            "max_mm": error.max_mm,
            "penetration_share": float(free.mean()),
            "pinched_share": float((inside.cloth_inside & inside.pinched).mean()),
            "penetration_mm": 1e3 * float(np.where(free, inside.depth, 0.0).max()),
            "strain_p99": float(np.quantile(np.abs(strain), 0.99)),
            "area_strain_p99": float(
                np.quantile(np.abs(area_strain(assembly.rest, faces, x)), 0.99)
            ),
            "wrinkle_deg": angle_error(*angles),
            "fold_strength": angle_strength(angles[0]) / max(angle_strength(angles[1]), 1e-6),
            "strain_p99_reference": float(np.quantile(np.abs(wanted), 0.99)),
            "spectrum": spectrum_distance(spectrum, self._spectra[sequence.name, name]),
            "tension_p99": float(np.quantile(strain, 0.99)),
            "tension_p99_reference": float(np.quantile(wanted, 0.99)),
            "visible_skin": surface_faults(assembly, motion, shown, frames=looked).visible_skin,
        }
        # Accelerations across a missing frame are undefined.
        if finite.all():
            values |= {
                "acceleration_error": acceleration_error(x, y, motion.fps),
                "jitter": jitter(x, motion.fps),
            }
        return ActionError(**values)


def action_name(row: ActionError) -> str:
    """The action of a row, without the number of the outfit that a sequence's name ends with."""
    return row.action.partition(" #")[0]


def means(rows: Items[ActionError], method: str, name: str, engine: str) -> dict[str, float] | None:
    """Means over the actions of a method on a template; None if there is no row."""
    mine = [r for r in rows if (r.method, r.template, r.engine) == (method, name, engine)]
    if not mine:
        return None
    numbers = [f.name for f in dataclasses.fields(ActionError) if f.type is float]
    return {n: float(np.mean([getattr(r, n) for r in mine])) for n in numbers}
