"""`physxnet inspect`, `fit` and `export-rest`: garment and motion files."""

import dataclasses
import math
import pathlib
from typing import Any

import numpy as np
from rich.console import Console
from rich.table import Table

from ..body import load_body
from ..dressing import (
    CharacterInspection,
    Inspection,
    fit_garment,
    inspect_character,
    inspect_garment,
    is_character,
)
from ..errors import MeshError, PhysXNetError
from ..garment import Opening, template
from ..io import GltfFile, write_obj
from ..motion import CLIPS, MotionInspection, inspect_motion, split_animation
from ._commands import ExportRest, Fit, Inspect
from ._progress import print_json, progress_bars
from ._shape import parse_shape

_Found = Inspection | MotionInspection | CharacterInspection
# Formats that contain only motion.
_MOTION_SUFFIXES = (".bvh", ".amc", ".npz", ".pkl", ".vrma")


def inspect(command: Inspect, console: Console) -> int:
    """Inspects files; returns 1 if one of them has problems."""
    if not command.files:
        raise MeshError("no file to inspect: name one, as in `physxnet inspect my_shirt.obj`.")
    motion_options = {
        "source_fps": command.source_fps,
        "skeleton": command.skeleton,
        "up": command.up,
        "joint_map": command.joint_map,
    }
    given = [f"--{k.replace('_', '-')}" for k, v in motion_options.items() if v is not None]
    found: list[_Found] = []
    failed: list[PhysXNetError] = []
    for file in command.files:
        try:
            if command.motion or _is_motion(file):
                found.append(inspect_motion(file, **motion_options))
            elif given:
                raise MeshError(
                    f"{given[0]} is for motions; {file} has a mesh. Inspect it separately."
                )
            elif is_character(file):
                found.append(inspect_character(file))
            else:
                found.append(inspect_garment(file))
        except PhysXNetError as error:
            # The others are inspected all the same.
            failed.append(error)
            continue
        if not command.terminal.json:
            _show(found[-1], console)
    if command.terminal.json and (found or not failed):
        print_json([_to_json(f) for f in found])
    if len(failed) == 1:
        raise failed[0]
    if failed:
        raise PhysXNetError("\n".join(str(error) for error in failed))
    return int(any(f.problems for f in found))


def _is_motion(file: pathlib.Path) -> bool:
    """Whether a file contains motion and no mesh."""
    file = split_animation(file)[0]
    suffix = file.suffix.lower()
    if suffix in _MOTION_SUFFIXES or str(file) in CLIPS:
        return True
    if suffix not in (".glb", ".gltf") or not file.is_file():
        return False
    document = GltfFile(file).document
    return bool(document.animations) and not document.meshes


def fit(command: Fit, console: Console) -> int:
    """Repairs a file; reports the steps and the inspection of the result."""
    longest, coarser = (
        None if mm is None else 1e-3 * mm for mm in (command.edge_length, command.decimate)
    )
    with progress_bars(console) as bars:
        bars("fitting", 0, 1)
        done, result = fit_garment(
            command.file,
            command.out,
            like=command.like,
            edge_length=longest,
            coarser=coarser,
            draped=command.drape,
            progress=lambda k, n: bars("settling", k, n),
        )
    if command.terminal.json:
        print_json({"done": done, "result": _to_json(result), "files": [command.out]})
        return int(bool(result.problems))
    for step in done:
        console.print(step, highlight=False)
    _show(result, console)
    console.print(f"wrote {command.out}", highlight=False)
    return int(bool(result.problems))


def export_rest(command: ExportRest, console: Console) -> int:
    """Writes a body of a given shape and templates fitted to it, at rest."""
    body, files = load_body(), []
    shape = body.shape(**parse_shape(command.shape))
    meshes = {"body": body.rest_mesh(shape)}
    for name in command.wear:
        garment = template(name)
        meshes[name] = garment.mesh.replace(
            vertices=garment.rest_vertices(body.rest_vertices(shape))
        )
    for name, mesh in meshes.items():
        path = command.out / f"{name}.obj"
        chart = (None if x is None else np.asarray(x) for x in (mesh.uv, mesh.uv_faces))
        write_obj(path, np.asarray(mesh.vertices), np.asarray(mesh.faces), *chart)
        files.append(path)
        console.print(f"wrote {path}", highlight=False)
    if command.terminal.json:
        print_json({"files": files})
    return 0


def _show(found: _Found, console: Console) -> None:
    if isinstance(found, Inspection):
        rows = _garment_rows(found)
    elif isinstance(found, CharacterInspection):
        rows = _character_rows(found)
    else:
        rows = _motion_rows(found)
    table = Table(title=str(found.path), title_justify="left", show_header=False)
    for name, value in rows:
        table.add_row(name, value)
    console.print(table)
    for line in found.problems:
        console.print(f"wrong: {line}", highlight=False, markup=False)
    for line in found.notes:
        console.print(f"note:  {line}", highlight=False, markup=False)
    console.print(found.verdict, highlight=False, markup=False, soft_wrap=True)


def _motion_rows(found: MotionInspection) -> list[tuple[str, str]]:
    return [
        ("frames", f"{found.frames:,} at {found.fps:g} a second: {found.seconds:.2f} s"),
        ("joint names", found.skeleton),
        ("joints", f"{found.joints}, followed by {found.carried} joints of the body"),
        ("reference pose", found.reference),
        ("unit", found.unit or "not a usual one; motions don't need it"),
        ("path of the hips", f"{found.travelled:.1f} m, at up to {found.fastest:.1f} m/s"),
        ("lower foot", f"{100 * found.feet:.1f} cm above the floor (median)"),
    ]


def _character_rows(found: CharacterInspection) -> list[tuple[str, str]]:
    return [
        ("meshes", f"{', '.join(found.meshes[:6])}: {found.vertices:,} vertices"),
        ("height", f"{found.height:.4g} ({found.unit or 'unknown unit'})"),
        ("joint names", found.skeleton),
        ("joints", f"{found.joints}, followed by {found.carried} joints of the body"),
        ("saved in", "a pose" if found.saved_in_a_pose else "its bind pose"),
        ("animations", ", ".join(found.animations[:6]) or "none"),
    ]


def _garment_rows(found: Inspection) -> list[tuple[str, str]]:
    h = found.health
    unit = "unknown unit" if found.unit is None else found.unit
    rows: list[tuple[str, str]] = [
        ("size", " x ".join(f"{s:.4g}" for s in found.size) + f" ({unit})"),
        ("up axis", found.up or "unknown"),
        ("vertices, faces", f"{h.vertices:,}, {found.polygons:,} ({h.faces:,} triangles)"),
        ("parts", str(h.components)),
        ("texture coordinates", "yes" if h.uv else "no"),
    ]
    if found.unit is not None:
        around = ", ".join(f"{x:.2f}" for x in h.openings[:6])
        rows += [
            ("openings", f"{len(h.openings)}: {around} m around" if h.openings else "none"),
            ("edges", f"{1e3 * h.median_edge:.1f} mm, up to {1e3 * h.longest_edge:.0f} mm"),
            ("above the skin", f"{1e3 * found.distance:.0f} mm, up to {1e3 * found.farthest:.0f}"),
            ("gap at its top", f"{1e3 * found.hangs:.0f} mm to the skin"),
            ("inside the body", f"{100 * found.inside:.1f} %"),
            ("facing outwards", f"{100 * found.outward:.0f} %"),
            ("template", found.template or "-"),
            ("distance from", ", ".join(f"{t} {1e3 * d:.0f} mm" for t, d in found.apart.items())),
            ("rays that hit the body", f"{100 * found.hit_rate:.1f} %"),
            ("limbs", "; ".join(_opening(o) for o in found.openings[:8]) or "no opening"),
            ("covers", f"{100 * found.covered:.0f} % of the skin"),
            ("skin shows through", f"{100 * found.visible_skin:.2f} %"),
        ]
    return rows


def _opening(opening: Opening) -> str:
    """An opening and the limbs that pass through it."""
    return f"{' + '.join(opening.limbs) or 'none'} ({opening.around:.2f} m around)"


def _to_json(found: _Found) -> dict[str, Any]:
    values = dataclasses.asdict(found) | {"path": str(found.path), "verdict": found.verdict}
    if isinstance(found, Inspection):
        values["openings"] = [{"around": o.around, "limbs": o.limbs} for o in found.openings]
    return {k: None if isinstance(v, float) and math.isnan(v) else v for k, v in values.items()}
