"""`physxnet tailor`: cuts a garment to measure and writes it for other programs."""

import dataclasses
import json
import pathlib

import numpy as np
from rich.console import Console

from ..body import load_body
from ..errors import PhysXNetError
from ..files import atomic_write
from ..garment import KINDS, Garment, parse_wear, resolve_measures, tailor
from ..io import AnimatedMesh, write_clip, write_obj
from ._commands import Tailor
from ._progress import print_json
from ._shape import parse_shape


def run_tailor(command: Tailor, console: Console) -> int:
    """Cuts a garment and writes its mesh, and its measures and fabric beside it."""
    item, body = parse_wear(command.garment), load_body()
    if item.name not in KINDS:
        raise PhysXNetError(f"The tailor makes no '{item.name}'; there are {', '.join(KINDS)}.")
    shape = body.shape(**parse_shape(command.shape))
    options: dict = dict(item.measures)
    garment = tailor(item.name, **options, fabric=item.fabric, hold=item.hold, shape=shape)
    vertices = np.asarray(garment.rest_vertices(body.rest_vertices(shape)))
    files = _write_mesh(command.out, garment, vertices)
    sheet = command.out.with_suffix(".json")
    measures = {k: float(v) for k, v in resolve_measures(item.name, item.measures).items()}
    found = {
        "kind": item.name,
        "measures": {k: round(v, 6) for k, v in measures.items()},
        "shape": dict(zip(body.shape_names, np.asarray(shape).round(6).tolist())),
        "fabric": dataclasses.asdict(garment.fabric),
        "held": np.flatnonzero(np.asarray(garment.pinned)).tolist(),
        "vertices": garment.num_vertices,
        "files": [str(f) for f in files],
    }
    with atomic_write(sheet) as part:
        part.write_text(json.dumps(found, indent=1) + "\n", encoding="utf-8")
    if command.terminal.json:
        print_json(found | {"files": [*files, sheet]})
        return 0
    cut = ", ".join(f"{k} {v:g} m" for k, v in found["measures"].items())
    console.print(f"{item.name}: {cut}; {garment.num_vertices:,} vertices", highlight=False)
    console.print(f"wrote {', '.join(map(str, [*files, sheet]))}", highlight=False, soft_wrap=True)
    return 0


def _write_mesh(path: pathlib.Path, garment: Garment, vertices: np.ndarray) -> list[pathlib.Path]:
    mesh = garment.mesh
    assert mesh.uv is not None and mesh.uv_faces is not None
    faces, uv, uv_faces = np.asarray(mesh.faces), np.asarray(mesh.uv), np.asarray(mesh.uv_faces)
    if path.suffix.lower() == ".obj":
        write_obj(path, vertices, faces, uv, uv_faces)
        return [path]
    return write_clip(path, [AnimatedMesh(garment.name, vertices[None], faces, uv, uv_faces)], 30.0)
