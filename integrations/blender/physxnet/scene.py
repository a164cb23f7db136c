"""Reads persons and garments from the scene, and brings cloth back onto the user's objects."""

import pathlib

import bpy
import numpy as np

from . import bridge

MODIFIER = "PhysXNet"
_HIDDEN = "physxnet_hidden"


class SceneError(Exception):
    """Something in the scene that can't be dressed; the message says what to do."""


def mesh_objects(person, garments):
    """The person's meshes: those that an armature deforms, or the object itself."""
    if person is None:
        raise SceneError("Choose a person: an armature, or a mesh that moves.")
    if person.type == "MESH":
        return [person]
    if person.type != "ARMATURE":
        raise SceneError(f"{person.name} is a {person.type.lower()}: choose an armature or a mesh.")
    found = []
    for o in bpy.context.scene.objects:
        bound = any(m.type == "ARMATURE" and m.object == person for m in o.modifiers)
        if o.type == "MESH" and o not in garments and (bound or o.parent == person):
            if not o.hide_render and len(o.data.polygons):
                found.append(o)
    if not found:
        raise SceneError(f"{person.name} deforms no mesh other than the garments.")
    return found


def evaluated(objects, unit):
    """World coordinates of evaluated meshes [m], Y up, and their triangles."""
    graph = bpy.context.evaluated_depsgraph_get()
    points, faces, start = [], [], 0
    for o in objects:
        at = o.evaluated_get(graph)
        mesh = at.to_mesh()
        try:
            mesh.calc_loop_triangles()
            x = np.empty(3 * len(mesh.vertices), np.float32)
            mesh.vertices.foreach_get("co", x)
            t = np.empty(3 * len(mesh.loop_triangles), np.int32)
            mesh.loop_triangles.foreach_get("vertices", t)
        finally:
            at.to_mesh_clear()
        matrix = np.array(at.matrix_world)
        x = x.reshape(-1, 3) @ matrix[:3, :3].T + matrix[:3, 3]
        points.append(bridge.to_y_up(x, unit))
        faces.append(t.reshape(-1, 3) + start)
        start += len(x)
    return np.concatenate(points), np.concatenate(faces)


def at_rest(person, function):
    """Calls a function while the person's armature is in its rest pose, if it has one."""
    if person.type != "ARMATURE":
        return function()
    before = person.data.pose_position
    person.data.pose_position = "REST"
    try:
        bpy.context.view_layer.update()
        return function()
    finally:
        person.data.pose_position = before
        bpy.context.view_layer.update()


def export(person, garments, folder, frames, fps, unit, step=None):
    """Writes the person's motion and the garments into a folder; the words for `--wear`.

    Args:
        person: An armature, or a mesh in motion.
        garments: Mesh objects, modelled on the person at rest (of a mesh: in the first frame).
        folder: Where the files go.
        frames: First and last frame.
        fps: The scene's frame rate.
        unit: Length of the scene's unit [m].
        step: Called with the frames done and the total.
    """
    folder, scene = pathlib.Path(folder), bpy.context.scene
    meshes = mesh_objects(person, garments)
    first, last = frames
    if last < first:
        raise SceneError(f"The last frame, {last}, is before the first, {first}.")
    current = scene.frame_current
    positions = []
    try:
        scene.frame_set(first)
        bind, faces = at_rest(person, lambda: evaluated(meshes, unit))
        worn = at_rest(person, lambda: [_garment(o, unit) for o in garments])
        for k, frame in enumerate(range(first, last + 1)):
            scene.frame_set(frame)
            x, t = evaluated(meshes, unit)
            if t.shape != faces.shape:
                raise SceneError(
                    f"{meshes[0].name} has another number of faces in frame {frame}: apply or"
                    " remove the modifiers that change it."
                )
            positions.append(x)
            if step is not None:
                step(k + 1, last + 1 - first)
    finally:
        scene.frame_set(current)
    rest = bind if person.type == "ARMATURE" else positions[0]
    bridge.write_person(folder / "person.npz", positions, faces, rest, fps)
    bridge.write_obj(folder / "rest.obj", rest, faces.tolist())
    words = []
    for k, (x, polygons) in enumerate(worn):
        path = folder / f"garment{k}.obj"
        bridge.write_obj(path, x, polygons)
        words.append(str(path))
    return words


def _garment(o, unit):
    if o.type != "MESH" or not len(o.data.polygons):
        raise SceneError(f"{o.name} is no mesh with faces.")
    x = np.empty(3 * len(o.data.vertices), np.float32)
    o.data.vertices.foreach_get("co", x)
    matrix = np.array(o.matrix_world)
    x = x.reshape(-1, 3) @ matrix[:3, :3].T + matrix[:3, 3]
    return bridge.to_y_up(x, unit), [list(p.vertices) for p in o.data.polygons]


def cache_folder(folder):
    """Where caches are kept: beside the .blend file, or in the job's folder if it isn't saved."""
    if bpy.data.filepath:
        return pathlib.Path(bpy.path.abspath("//physxnet_cache"))
    return pathlib.Path(folder) / "cache"


def bring_back(o, positions, cache, first, unit):
    """Plays cloth [frames, vertices, 3] on an object; its materials and modifiers stay.

    Deformations that the cache replaces (armatures, an older cache) are switched off, not removed.
    """
    world = bridge.to_z_up(positions, unit)
    inverse = np.linalg.inv(np.array(o.matrix_world))
    bridge.write_pc2(cache, world @ inverse[:3, :3].T + inverse[:3, 3])
    modifier = o.modifiers.get(MODIFIER) or o.modifiers.new(MODIFIER, "MESH_CACHE")
    modifier.cache_format = "PC2"
    path = str(cache)
    modifier.filepath = bpy.path.relpath(path) if bpy.data.filepath else path
    modifier.frame_start = first
    modifier.forward_axis, modifier.up_axis = "POS_Y", "POS_Z"
    modifier.deform_mode, modifier.interpolation = "OVERWRITE", "LINEAR"
    with bpy.context.temp_override(object=o):
        bpy.ops.object.modifier_move_to_index(modifier=modifier.name, index=0)
    hidden = []
    for m in o.modifiers:
        if m.type in ("ARMATURE", "CLOTH", "SURFACE_DEFORM", "MESH_DEFORM") and m.show_viewport:
            m.show_viewport = m.show_render = False
            hidden.append(m.name)
    o[_HIDDEN] = ",".join([*filter(None, str(o.get(_HIDDEN, "")).split(",")), *hidden])
    return modifier


def new_object(name, positions, faces, unit):
    """Makes an object of a tailored garment."""
    mesh = bpy.data.meshes.new(name)
    mesh.from_pydata(bridge.to_z_up(positions, unit).tolist(), [], faces.tolist())
    mesh.shade_smooth()
    o = bpy.data.objects.new(name, mesh)
    bpy.context.scene.collection.objects.link(o)
    return o


def undress(o):
    """Removes a cache, and switches on again what it replaced."""
    modifier = o.modifiers.get(MODIFIER)
    if modifier is None:
        return False
    o.modifiers.remove(modifier)
    for name in str(o.get(_HIDDEN, "")).split(","):
        if name and name in o.modifiers:
            o.modifiers[name].show_viewport = o.modifiers[name].show_render = True
    if _HIDDEN in o:
        del o[_HIDDEN]
    return True
