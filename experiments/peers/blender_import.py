"""Runs in a Python with bpy: opens clips of `import_in_blender.py` and says where vertices are.

Arguments: a folder that holds clip.usdc, clip.glb, clip_NAME.pc2, .mdd and .obj, and the
file to write positions to, in Blender's own axes, by format and frame.
"""

import pathlib
import sys

import bpy
import numpy as np

folder, answer, name, frames = pathlib.Path(sys.argv[1]), sys.argv[2], sys.argv[3], int(sys.argv[4])


def cached(kind: str) -> None:
    bpy.ops.wm.obj_import(filepath=str(folder / f"clip_{name}.obj"))
    mesh = bpy.context.selected_objects[0]
    # Everything but the file is left at its default.
    modifier = mesh.modifiers.new("cache", "MESH_CACHE")
    modifier.cache_format = kind.upper()
    modifier.filepath = str(folder / f"clip_{name}.{kind}")


def through_alembic() -> None:
    """What other programs take from Blender: the stage, exported once more."""
    bpy.ops.wm.usd_import(filepath=str(folder / "clip.usdc"))
    path = str(folder / "clip.abc")
    bpy.ops.wm.alembic_export(filepath=path, start=0, end=frames - 1)
    bpy.ops.wm.read_factory_settings(use_empty=True)
    bpy.context.scene.render.fps = 30
    bpy.ops.wm.alembic_import(filepath=path)


def seen() -> np.ndarray:
    mesh = next(o for o in bpy.context.scene.objects if o.type == "MESH")
    shown = mesh.evaluated_get(bpy.context.evaluated_depsgraph_get())
    data = shown.to_mesh()
    out = np.array([shown.matrix_world @ v.co for v in data.vertices])
    shown.to_mesh_clear()
    return out


ways = {
    "usdc": lambda: bpy.ops.wm.usd_import(filepath=str(folder / "clip.usdc")),
    "glb": lambda: bpy.ops.import_scene.gltf(filepath=str(folder / "clip.glb")),
    "pc2": lambda: cached("pc2"),
    "mdd": lambda: cached("mdd"),
    "abc": through_alembic,
}
found = {}
for kind, load in ways.items():
    bpy.ops.wm.read_factory_settings(use_empty=True)
    # The rate is the clip's; importers that know it set it themselves.
    bpy.context.scene.render.fps = 30
    load()
    for k in range(frames):
        # Frame 0 of the clip is frame 0, in glTF's importer too.
        bpy.context.scene.frame_set(k)
        found[f"{kind}_{k}"] = seen()
np.savez(answer, **found)
