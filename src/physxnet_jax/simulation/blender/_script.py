"""Runs inside Blender: cloth on a moving body, frame by frame.

Not imported by the package: `simulate_blender` starts it in a process of its own.
Arguments: a folder with ``scene.npz`` and ``settings.json``; writes ``cloth.npz`` there.
"""

import json
import pathlib
import struct
import sys
import time

import numpy as np

# One frame of Blender's cloth lasts this long [s], whatever the scene's frame rate.
_FRAME = 0.0316


def turned(x):
    """Y up to Z up."""
    return np.stack([x[..., 0], -x[..., 2], x[..., 1]], axis=-1).astype(np.float32)


def write_pc2(path, positions):
    """Only a mesh cache gives the collider a velocity: data set from Python doesn't."""
    frames, vertices = positions.shape[:2]
    head = struct.pack("<12siiffi", b"POINTCACHE2\0", 1, vertices, 0.0, 1.0, frames)
    path.write_bytes(head + np.ascontiguousarray(positions, "<f4").tobytes())


def add_mesh(name, vertices, faces, cache):
    """A mesh that a point cache moves; frame 1 is the cache's first."""
    import bpy  # pyright: ignore[reportMissingImports]

    mesh = bpy.data.meshes.new(name)
    mesh.from_pydata(vertices.tolist(), [], faces.tolist())
    thing = bpy.data.objects.new(name, mesh)
    bpy.context.scene.collection.objects.link(thing)
    moved = thing.modifiers.new("cache", "MESH_CACHE")
    moved.cache_format = "PC2"
    moved.filepath = str(cache)
    moved.frame_start = 1
    moved.forward_axis, moved.up_axis = "POS_Y", "POS_Z"
    return thing


def main():
    """Builds the scene, steps through every frame in order, keeps what the cloth does."""
    import bpy  # pyright: ignore[reportMissingImports]

    folder = pathlib.Path(sys.argv[-1])
    data = np.load(folder / "scene.npz")
    wanted = json.loads((folder / "settings.json").read_text())
    bpy.ops.wm.read_factory_settings(use_empty=True)
    scene = bpy.context.scene
    frames = len(data["skin"])
    scene.frame_start, scene.frame_end = 1, frames
    skin = turned(data["skin"])
    write_pc2(folder / "skin.pc2", skin)
    body = add_mesh("skin", skin[0], data["skin_faces"], folder / "skin.pc2")
    collide = body.modifiers.new("collide", "COLLISION")
    collide.settings.thickness_outer = wanted["distance"]
    collide.settings.cloth_friction = wanted["friction"]
    # Colliders are named, or every cloth would be one of every other's.
    only = bpy.data.collections.new("colliders")
    only.objects.link(body)
    things = []
    parts = data["parts"]
    for k, (i, j) in enumerate(zip(parts, parts[1:])):
        inside = ((data["cloth_faces"] >= i) & (data["cloth_faces"] < j)).all(axis=1)
        cloth = turned(data["cloth"][:, i:j])
        write_pc2(folder / f"cloth{k}.pc2", cloth)
        thing = add_mesh(
            f"cloth{k}",
            turned(data["cloth_rest"][i:j]),
            data["cloth_faces"][inside] - i,
            folder / f"cloth{k}.pc2",
        )
        things.append(thing)
        soft = thing.modifiers.new("cloth", "CLOTH")
        s, c = soft.settings, soft.collision_settings
        s.quality = wanted["quality"]
        s.time_scale = (1.0 / float(data["fps"])) / _FRAME
        s.mass = wanted["mass"]
        s.tension_stiffness = s.compression_stiffness = s.shear_stiffness = wanted["tension"]
        s.tension_damping = s.compression_damping = s.shear_damping = wanted["damping"]
        s.bending_stiffness, s.bending_damping = wanted["bending"], wanted["bending_damping"]
        s.air_damping = wanted["air"]
        c.distance_min = wanted["distance"]
        c.use_self_collision = wanted["self_collision"]
        c.collection = only
        held = np.flatnonzero(data["pinned"][i:j])
        if len(held):
            group = thing.vertex_groups.new(name="pinned")
            group.add(held.tolist(), 1.0, "REPLACE")
            s.vertex_group_mass = "pinned"
        soft.point_cache.frame_start, soft.point_cache.frame_end = 1, frames
    out = np.zeros((frames, int(parts[-1]), 3), np.float32)
    taken = np.zeros(frames)
    for f in range(frames):
        began = time.perf_counter()
        scene.frame_set(f + 1)
        graph = bpy.context.evaluated_depsgraph_get()
        for thing, i, j in zip(things, parts, parts[1:]):
            mesh = thing.evaluated_get(graph).data
            flat = np.empty(3 * (j - i), np.float32)
            mesh.attributes["position"].data.foreach_get("vector", flat)
            out[f, i:j] = flat.reshape(-1, 3)
        taken[f] = 1e3 * (time.perf_counter() - began)
        print(f"frame {f + 1}", flush=True)  # noqa: T201
    back = np.stack([out[..., 0], out[..., 2], -out[..., 1]], axis=-1)
    np.savez(folder / "cloth.npz", positions=back, milliseconds=taken)


if __name__ == "__main__":
    main()
