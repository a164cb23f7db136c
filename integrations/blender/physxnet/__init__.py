"""PhysXNet in Blender: choose a person and garments, press *Dress*."""

import pathlib
import shutil
import tempfile
import time

import bpy

from . import bridge, scene


class Garment(bpy.types.PropertyGroup):
    """An entry of the list of garments."""

    target: bpy.props.PointerProperty(
        type=bpy.types.Object, poll=lambda self, o: o.type == "MESH", name="Garment"
    )


class Settings(bpy.types.PropertyGroup):
    """Options of a scene."""

    person: bpy.props.PointerProperty(
        type=bpy.types.Object,
        name="Person",
        description="An armature, or a mesh that moves",
        poll=lambda self, o: o.type in ("ARMATURE", "MESH"),
    )
    garments: bpy.props.CollectionProperty(type=Garment)
    index: bpy.props.IntProperty()
    tailored: bpy.props.StringProperty(
        name="Tailored",
        description="Garments that are cut to measure, such as: shirt:ease=0.12 trousers",
    )
    method: bpy.props.EnumProperty(
        name="Method",
        items=[
            ("guided", "Guided", "A network, and a few steps of simulation: fast, with folds"),
            ("simulate", "Simulation", "The cloth simulator alone: most accurate"),
            ("network", "Network", "The network alone: fastest with looseness"),
            ("lbs", "Skinning", "Moves with the skin"),
        ],
    )
    fabric: bpy.props.EnumProperty(
        name="Fabric", items=[(f, f.title() or "As it is", "") for f in bridge.FABRICS]
    )
    wind: bpy.props.FloatVectorProperty(
        name="Wind", description="Steady wind [m/s]", size=3, subtype="VELOCITY"
    )
    use_range: bpy.props.BoolProperty(name="Own frame range")
    first: bpy.props.IntProperty(name="First frame", default=1)
    last: bpy.props.IntProperty(name="Last frame", default=120)
    progress: bpy.props.FloatProperty(name="Progress", subtype="FACTOR", max=1.0)
    stage: bpy.props.StringProperty()
    running: bpy.props.BoolProperty()


class Preferences(bpy.types.AddonPreferences):
    """Where the command is."""

    bl_idname = __package__
    command: bpy.props.StringProperty(
        name="physxnet command",
        description="Path of the installed command; found on the PATH if empty",
        subtype="FILE_PATH",
    )

    def draw(self, context):
        """Draws the preference, and whether the command is found."""
        self.layout.prop(self, "command")
        found = bridge.find_command(self.command)
        self.layout.label(text=f"uses {found}" if found else "not found: install physxnet-jax")


def _command(context):
    entry = context.preferences.addons.get(__package__)
    return bridge.find_command(entry.preferences.command if entry else "")


class Dress(bpy.types.Operator):
    """Dress the person in the chosen garments"""

    bl_idname = "physxnet.dress"
    bl_label = "Dress"
    bl_options = {"REGISTER"}
    _job = _timer = None

    def invoke(self, context, event):
        """Runs beside Blender, which stays usable."""
        if not self._start(context):
            return {"CANCELLED"}
        manager = context.window_manager
        self._timer = manager.event_timer_add(0.2, window=context.window)
        manager.modal_handler_add(self)
        return {"RUNNING_MODAL"}

    def modal(self, context, event):
        """Shows progress; Esc cancels."""
        settings = context.scene.physxnet
        if event.type == "ESC" or not settings.running:
            self._job.cancel()
            self.report({"WARNING"}, "Dressing was cancelled; nothing was changed")
            return self._end(context, {"CANCELLED"})
        if event.type != "TIMER":
            return {"PASS_THROUGH"}
        settings.stage, settings.progress = self._job.stage, self._job.share
        for area in context.screen.areas:
            area.tag_redraw()
        if self._job.code is None:
            return {"RUNNING_MODAL"}
        return self._end(context, self._finish(context))

    def execute(self, context):
        """Runs to the end before it returns: from scripts and without a window."""
        if not self._start(context):
            return {"CANCELLED"}
        while self._job.code is None:
            time.sleep(0.1)
        return self._end(context, self._finish(context))

    def _start(self, context):
        settings = context.scene.physxnet
        command = _command(context)
        if not command:
            self.report({"ERROR"}, "No physxnet command: name it in the extension's preferences")
            return False
        self._garments = [g.target for g in settings.garments if g.target is not None]
        tailored = settings.tailored.split()
        if not self._garments and not tailored:
            self.report({"ERROR"}, "Choose a garment of the scene, or name a tailored one")
            return False
        render, units = context.scene.render, context.scene.unit_settings
        self._unit = units.scale_length if units.system != "NONE" else 1.0
        whole = (context.scene.frame_start, context.scene.frame_end)
        self._frames = (settings.first, settings.last) if settings.use_range else whole
        self._folder = pathlib.Path(tempfile.mkdtemp(prefix="physxnet-"))
        fps = render.fps / render.fps_base
        try:
            words = scene.export(
                settings.person, self._garments, self._folder, self._frames, fps, self._unit
            )
        except scene.SceneError as error:
            self.report({"ERROR"}, str(error))
            shutil.rmtree(self._folder, ignore_errors=True)
            return False
        self._job = bridge.Job(
            bridge.dress_command(
                command,
                self._folder,
                [*words, *tailored],
                fps=fps,
                method=settings.method,
                fabric=settings.fabric,
                wind=tuple(settings.wind),
                made_on=bool(words),
            )
        )
        settings.running, settings.progress, settings.stage = True, 0.0, "starting"
        return True

    def _finish(self, context):
        if self._job.code:
            self.report({"ERROR"}, self._job.message().removeprefix("physxnet: "))
            return {"CANCELLED"}
        cloth = bridge.read_cloth(self._folder / "cloth.npz")
        folder = scene.cache_folder(self._folder)
        for k, o in enumerate(self._garments):
            positions, _ = cloth.pop(f"garment{k}")
            if positions.shape[1] != len(o.data.vertices):
                self.report({"ERROR"}, f"{o.name}: the result has other vertices than the mesh")
                return {"CANCELLED"}
            self._play(o, positions, folder)
        for name, (positions, faces) in cloth.items():
            o = scene.new_object(name, positions[0], faces, self._unit)
            self._play(o, positions, folder)
        context.view_layer.update()
        count = len(self._garments) + len(cloth)
        self.report({"INFO"}, f"Dressed {count} garments; caches in {folder}")
        return {"FINISHED"}

    def _play(self, o, positions, folder):
        name = bpy.path.clean_name(o.name)
        scene.bring_back(o, positions, folder / f"{name}.pc2", self._frames[0], self._unit)

    def _end(self, context, result):
        if self._timer is not None:
            context.window_manager.event_timer_remove(self._timer)
        context.scene.physxnet.running = False
        # Caches of a file that was never saved are in this folder.
        if bpy.data.filepath or result == {"CANCELLED"}:
            shutil.rmtree(self._folder, ignore_errors=True)
        return result


class Cancel(bpy.types.Operator):
    """Stop dressing"""

    bl_idname = "physxnet.cancel"
    bl_label = "Cancel"

    def execute(self, context):
        """Tells the running operator to stop."""
        context.scene.physxnet.running = False
        return {"FINISHED"}


class Undress(bpy.types.Operator):
    """Remove the caches, and switch on again what they replaced"""

    bl_idname = "physxnet.undress"
    bl_label = "Remove cloth"
    bl_options = {"REGISTER", "UNDO"}

    def execute(self, context):
        """Applies to the garments of the list."""
        targets = [g.target for g in context.scene.physxnet.garments if g.target]
        count = sum(scene.undress(o) for o in targets)
        self.report({"INFO"}, f"Removed the cloth of {count} garments")
        return {"FINISHED"}


class AddSelected(bpy.types.Operator):
    """Add the selected meshes to the garments"""

    bl_idname = "physxnet.add_selected"
    bl_label = "Add selected"
    bl_options = {"REGISTER", "UNDO"}

    def execute(self, context):
        """Adds those that aren't in the list."""
        settings = context.scene.physxnet
        known = {g.target for g in settings.garments}
        for o in context.selected_objects:
            if o.type == "MESH" and o not in known and o != settings.person:
                settings.garments.add().target = o
        return {"FINISHED"}


class RemoveGarment(bpy.types.Operator):
    """Remove the garment from the list"""

    bl_idname = "physxnet.remove_garment"
    bl_label = "Remove"

    def execute(self, context):
        """Removes the chosen entry."""
        settings = context.scene.physxnet
        settings.garments.remove(settings.index)
        settings.index = max(0, settings.index - 1)
        return {"FINISHED"}


class GarmentList(bpy.types.UIList):
    """The garments."""

    bl_idname = "PHYSXNET_UL_garments"

    def draw_item(self, context, layout, data, item, icon, active, prop):
        """Draws one garment."""
        layout.prop(item, "target", text="", emboss=False)


class Panel(bpy.types.Panel):
    """The panel in the sidebar of the 3D view."""

    bl_label = "PhysXNet"
    bl_idname = "PHYSXNET_PT_main"
    bl_space_type = "VIEW_3D"
    bl_region_type = "UI"
    bl_category = "PhysXNet"

    def draw(self, context):
        """Draws options, and progress while it runs."""
        s, layout = context.scene.physxnet, self.layout
        layout.prop(s, "person")
        row = layout.row()
        row.template_list(GarmentList.bl_idname, "", s, "garments", s, "index", rows=2)
        buttons = row.column(align=True)
        buttons.operator(AddSelected.bl_idname, text="", icon="ADD")
        buttons.operator(RemoveGarment.bl_idname, text="", icon="REMOVE")
        layout.prop(s, "tailored")
        layout.prop(s, "method")
        layout.prop(s, "fabric")
        layout.prop(s, "wind")
        layout.prop(s, "use_range")
        if s.use_range:
            row = layout.row(align=True)
            row.prop(s, "first")
            row.prop(s, "last")
        if s.running:
            layout.progress(factor=s.progress, text=s.stage)
            layout.operator(Cancel.bl_idname, icon="CANCEL")
        else:
            layout.operator(Dress.bl_idname, icon="MOD_CLOTH")
            layout.operator(Undress.bl_idname)


_CLASSES = (
    *(Garment, Settings, Preferences, Dress, Cancel, Undress),
    *(AddSelected, RemoveGarment, GarmentList, Panel),
)


def register():
    """Adds the extension to Blender."""
    for c in _CLASSES:
        bpy.utils.register_class(c)
    bpy.types.Scene.physxnet = bpy.props.PointerProperty(type=Settings)


def unregister():
    """Removes it."""
    del bpy.types.Scene.physxnet
    for c in reversed(_CLASSES):
        bpy.utils.unregister_class(c)
