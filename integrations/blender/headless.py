"""Uses the extension in Blender without a window; runs in a Python that has bpy.

Command: experiments/blender_extension.py calls it, once for each Blender.
         PYTHON_WITH_BPY integrations/blender/headless.py ZIP PERSON.glb GARMENT.obj FOLDER
         [--pictures FOLDER] [--mpfb ZIP]
Result:  a line of JSON for each check on stdout.
"""

import argparse
import importlib
import json
import os
import pathlib
import sys

import bpy
import numpy as np


def say(check: str, passed: bool, note: str = "") -> None:
    """Prints the result of a check."""
    print(
        "RESULT " + json.dumps({"check": check, "passed": bool(passed), "note": note}), flush=True
    )


def vertices(o) -> np.ndarray:
    """World coordinates of an evaluated object."""
    graph = bpy.context.evaluated_depsgraph_get()
    at = o.evaluated_get(graph)
    mesh = at.to_mesh()
    x = np.empty(3 * len(mesh.vertices), np.float32)
    mesh.vertices.foreach_get("co", x)
    at.to_mesh_clear()
    matrix = np.array(at.matrix_world)
    return x.reshape(-1, 3) @ matrix[:3, :3].T + matrix[:3, 3]


def picture(path: pathlib.Path, frame: int, focus) -> None:
    """Renders a frame on the processor, the person in the middle."""
    scene = bpy.context.scene
    scene.frame_set(frame)
    x = vertices(focus)
    middle = 0.5 * (x.min(axis=0) + x.max(axis=0))
    if scene.camera is None:
        scene.camera = bpy.data.objects.new("camera", bpy.data.cameras.new("camera"))
        sun = bpy.data.objects.new("sun", bpy.data.lights.new("sun", "SUN"))
        sun.data.energy, sun.rotation_euler = 3.0, (0.7, 0.2, 0.5)
        bpy.ops.mesh.primitive_plane_add(size=30.0)
        for o in (scene.camera, sun):
            scene.collection.objects.link(o)
        scene.world = bpy.data.worlds.new("world")
        scene.world.use_nodes = True
        scene.world.node_tree.nodes["Background"].inputs["Color"].default_value = (
            0.8,
            0.85,
            0.9,
            1,
        )
    scene.camera.location = (middle[0] + 1.6, middle[1] - 3.6, middle[2] + 0.5)
    scene.camera.rotation_euler = (1.45, 0.0, 0.42)
    scene.render.engine, scene.cycles.samples = "CYCLES", 24
    scene.cycles.device, scene.cycles.use_denoising = "CPU", False
    scene.render.resolution_x, scene.render.resolution_y = 400, 480
    scene.render.filepath = str(path)
    bpy.ops.render.render(write_still=True)


def error_of(call) -> str:
    """The text of the error that an operator reports."""
    try:
        call()
    except RuntimeError as error:
        return str(error)
    return ""


def worn(cloth, body):
    """Largest median distance from the person over ten frames, and the cloth in each [m]."""
    count, far, places = len(cloth.data.vertices), [], []
    for frame in range(1, 11):
        bpy.context.scene.frame_set(frame)
        x, skin = vertices(cloth)[:count], vertices(body)
        gap = np.linalg.norm(x[::7, None] - skin[None, ::5], axis=2).min(axis=1)
        far.append(float(np.median(gap)))
        places.append(x.mean(axis=0))
    return max(far), places


def try_mpfb(archive) -> None:
    """Dresses a character of MPFB, whose mesh holds helpers that a modifier hides."""
    bpy.ops.extensions.package_install_files(
        filepath=archive, repo="user_default", enable_on_install=True
    )
    scene, settings = bpy.context.scene, bpy.context.scene.physxnet
    for o in list(scene.objects):
        bpy.data.objects.remove(o)
    settings.garments.clear()
    module = next(a.module for a in bpy.context.preferences.addons if a.module.endswith(".mpfb"))
    service = importlib.import_module(module + ".services.humanservice").HumanService
    body = service.create_human()
    settings.person = armature = service.add_builtin_rig(body, "game_engine")
    for frame, turn in ((1, 0.0), (10, -0.7)):
        for name in ("thigh_l", "upperarm_r"):
            bone = armature.pose.bones[name]
            bone.rotation_mode, bone.rotation_euler = "XYZ", (turn, 0.0, 0.0)
            bone.keyframe_insert("rotation_euler", frame=frame)
    settings.tailored, settings.method = "shirt trousers", "guided"
    settings.first, settings.last = 1, 10
    bpy.ops.physxnet.dress()
    found = []
    for name in ("shirt", "trousers"):
        far, places = worn(scene.objects[name], body)
        found.append((far, float(np.linalg.norm(places[-1] - places[0]))))
    say(
        "a character of MPFB is dressed",
        all(far < 0.04 and way > 0.005 for far, way in found),
        ", ".join(f"{1e3 * far:.0f} mm" for far, _ in found),
    )


def main() -> None:
    """Runs all checks."""
    parser = argparse.ArgumentParser()
    for name in ("archive", "person", "garment", "folder"):
        parser.add_argument(name)
    parser.add_argument("--pictures", type=pathlib.Path)
    parser.add_argument("--mpfb")
    words = parser.parse_args()
    archive, person, garment, folder = words.archive, words.person, words.garment, words.folder
    pictures = words.pictures
    bpy.ops.wm.read_factory_settings(use_empty=True)
    bpy.ops.extensions.package_install_files(
        filepath=archive, repo="user_default", enable_on_install=True
    )
    say(
        "the zip installs and registers",
        hasattr(bpy.types.Scene, "physxnet"),
        bpy.app.version_string,
    )
    scene = bpy.context.scene
    bpy.ops.import_scene.gltf(filepath=person)
    armature = next(o for o in scene.objects if o.type == "ARMATURE")
    body = max((o for o in scene.objects if o.type == "MESH"), key=lambda o: len(o.data.vertices))
    before = set(scene.objects)
    bpy.ops.wm.obj_import(filepath=garment)
    (cloth,) = set(scene.objects) - before
    scene.render.fps, scene.frame_start, scene.frame_end = 30, 1, 10
    material = bpy.data.materials.new("linen")
    cloth.data.materials.clear()
    cloth.data.materials.append(material)
    cloth.modifiers.new("Armature", "ARMATURE").object = armature
    cloth.modifiers.new("Thickness", "SOLIDIFY").thickness = 0.001
    settings = scene.physxnet
    say("no garment is an error", "Choose a garment" in error_of(bpy.ops.physxnet.dress))
    for o in scene.objects:
        o.select_set(o == cloth)
    settings.person = armature
    bpy.ops.physxnet.add_selected()
    say("selected meshes are added", [g.target for g in settings.garments] == [cloth])
    settings.person = None
    say("no person is an error", "Choose a person" in error_of(bpy.ops.physxnet.dress))
    settings.person = armature
    bpy.ops.wm.save_as_mainfile(filepath=str(pathlib.Path(folder) / "scene.blend"))
    settings.method, settings.fabric = "guided", "silk"
    material.use_nodes = True
    material.node_tree.nodes["Principled BSDF"].inputs[0].default_value = (0.25, 0.4, 0.6, 1.0)
    if pictures is not None:
        picture(pictures / "blender-before.png", 10, body)
    bpy.ops.physxnet.dress()
    if pictures is not None:
        picture(pictures / "blender-dressed.png", 10, body)
    names = [m.name for m in cloth.modifiers]
    say("the cache is the first modifier", names[0] == "PhysXNet", ", ".join(names))
    kept = cloth.data.materials[0] == material and "Thickness" in names
    say("materials and modifiers are kept", kept)
    off = not cloth.modifiers["Armature"].show_viewport
    say("the armature no longer moves the garment", off)
    far, places = worn(cloth, body)
    say("cloth lies on the person in every frame", far < 0.04, f"{1e3 * far:.0f} mm")
    way = float(np.linalg.norm(places[-1] - places[0]))
    say("cloth goes where the person goes", way > 0.1, f"{way:.2f} m in ten frames")
    cache = list((pathlib.Path(folder) / "physxnet_cache").glob("*.pc2"))
    say("the cache lies beside the file", len(cache) == 1)
    bpy.ops.physxnet.undress()
    on = cloth.modifiers["Armature"].show_viewport and "PhysXNet" not in cloth.modifiers
    scene.frame_set(1)
    say("removing the cloth restores the garment", on)
    settings.tailored, settings.use_range, settings.first, settings.last = "shorts", True, 2, 5
    settings.method = "lbs"
    bpy.ops.physxnet.dress()
    shorts = scene.objects.get("shorts")
    say("tailored garments become objects", shorts is not None and "PhysXNet" in shorts.modifiers)
    settings.tailored = "spacesuit"
    text = error_of(bpy.ops.physxnet.dress)
    say("errors of the command are reported", "spacesuit" in text, text.strip()[:160])
    settings.tailored = ""
    cloth.location.x += 40.0
    bpy.context.view_layer.update()
    text = error_of(bpy.ops.physxnet.dress)
    say("a garment elsewhere is refused with a reason", "from one scene" in text)
    cloth.location.x -= 40.0
    if words.mpfb is not None:
        try_mpfb(words.mpfb)
    module = next(a.module for a in bpy.context.preferences.addons if "physxnet" in a.module)
    bpy.ops.preferences.addon_disable(module=module)
    say("it unregisters", not hasattr(bpy.types.Scene, "physxnet"))


if __name__ == "__main__":
    main()
    sys.stdout.flush()
    # The bpy 4.2.0 of PyPI crashes at its exit once it has imported a glTF, with any extension.
    os._exit(0)
