"""Runs inside Blender: cloth on a moving body, frame by frame.

Not imported by the package: `simulate_blender` starts it in a separate process.
Argument: a folder with ``scene.npz`` and ``settings.json``; writes ``cloth.npz`` there.
"""

import json
import pathlib
import struct
import sys
import time

import numpy as np

# One frame of Blender's cloth lasts this long [s], whatever the scene's frame rate.
_FRAME = 0.0316


def to_z_up(x):
    """Converts from Y up to Z up."""
    return np.stack([x[..., 0], -x[..., 2], x[..., 1]], axis=-1).astype(np.float32)


def write_pc2(path, positions):
    """Writes a point cache: colliders get a velocity from it, but not from data set in Python."""
    frames, vertices = positions.shape[:2]
    head = struct.pack("<12siiffi", b"POINTCACHE2\0", 1, vertices, 0.0, 1.0, frames)
    path.write_bytes(head + np.ascontiguousarray(positions, "<f4").tobytes())


def add_mesh(name, vertices, faces, cache):
    """Adds a mesh animated by a point cache, whose first frame is frame 1."""
    import bpy  # pyright: ignore[reportMissingImports]

    mesh = bpy.data.meshes.new(name)
    mesh.from_pydata(vertices.tolist(), [], faces.tolist())
    obj = bpy.data.objects.new(name, mesh)
    bpy.context.scene.collection.objects.link(obj)
    moved = obj.modifiers.new("cache", "MESH_CACHE")
    moved.cache_format = "PC2"
    moved.filepath = str(cache)
    moved.frame_start = 1
    moved.forward_axis, moved.up_axis = "POS_Y", "POS_Z"
    return obj


def main():
    """Builds the scene, steps through all frames in order and writes the cloth positions."""
    import bpy  # pyright: ignore[reportMissingImports]

    folder = pathlib.Path(sys.argv[-1])
    data = np.load(folder / "scene.npz")
    options = json.loads((folder / "settings.json").read_text())
    bpy.ops.wm.read_factory_settings(use_empty=True)
    scene = bpy.context.scene
    frames = len(data["skin"])
    scene.frame_start, scene.frame_end = 1, frames
    skin = to_z_up(data["skin"])
    write_pc2(folder / "skin.pc2", skin)
    body = add_mesh("skin", skin[0], data["skin_faces"], folder / "skin.pc2")
    collide = body.modifiers.new("collide", "COLLISION")
    collide.settings.thickness_outer = options["distance"]
    collide.settings.cloth_friction = options["friction"]
    # An explicit collection, or each cloth would be a collider of all others.
    colliders = bpy.data.collections.new("colliders")
    colliders.objects.link(body)
    cloths = []
    parts = data["parts"]
    for k, (i, j) in enumerate(zip(parts, parts[1:])):
        inside = ((data["cloth_faces"] >= i) & (data["cloth_faces"] < j)).all(axis=1)
        cloth = to_z_up(data["cloth"][:, i:j])
        write_pc2(folder / f"cloth{k}.pc2", cloth)
        obj = add_mesh(
            f"cloth{k}",
            to_z_up(data["cloth_rest"][i:j]),
            data["cloth_faces"][inside] - i,
            folder / f"cloth{k}.pc2",
        )
        cloths.append(obj)
        modifier = obj.modifiers.new("cloth", "CLOTH")
        s, c = modifier.settings, modifier.collision_settings
        s.quality = options["quality"]
        s.time_scale = (1.0 / float(data["fps"])) / _FRAME
        s.mass = options["mass"]
        s.tension_stiffness = s.compression_stiffness = s.shear_stiffness = options["tension"]
        s.tension_damping = s.compression_damping = s.shear_damping = options["damping"]
        s.bending_stiffness, s.bending_damping = options["bending"], options["bending_damping"]
        s.air_damping = options["air"]
        c.distance_min = options["distance"]
        c.use_self_collision = options["self_collision"]
        c.collection = colliders
        pinned = np.flatnonzero(data["pinned"][i:j])
        if len(pinned):
            group = obj.vertex_groups.new(name="pinned")
            group.add(pinned.tolist(), 1.0, "REPLACE")
            s.vertex_group_mass = "pinned"
        modifier.point_cache.frame_start, modifier.point_cache.frame_end = 1, frames
    out = np.zeros((frames, int(parts[-1]), 3), np.float32)
    frame_times = np.zeros(frames)
    for f in range(frames):
        start = time.perf_counter()
        scene.frame_set(f + 1)
        graph = bpy.context.evaluated_depsgraph_get()
        for obj, i, j in zip(cloths, parts, parts[1:]):
            mesh = obj.evaluated_get(graph).data
            flat = np.empty(3 * (j - i), np.float32)
            mesh.attributes["position"].data.foreach_get("vector", flat)
            out[f, i:j] = flat.reshape(-1, 3)
        frame_times[f] = 1e3 * (time.perf_counter() - start)
        print(f"frame {f + 1}", flush=True)  # noqa: T201
    y_up = np.stack([out[..., 0], out[..., 2], -out[..., 1]], axis=-1)
    np.savez(folder / "cloth.npz", positions=y_up, milliseconds=frame_times)


if __name__ == "__main__":
    main()
