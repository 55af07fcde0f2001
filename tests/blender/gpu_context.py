"""A GPU context in the module bpy: Blender gives one to render engines, also without a window."""

import bpy


def run_with_gpu(work):
    """Call `work` while a render engine with a GPU context renders; raises what it raised."""
    errors = []

    class Engine(bpy.types.RenderEngine):
        bl_idname = "STGA_TEST_GPU"
        bl_label = "Test"
        bl_use_gpu_context = True

        def render(self, depsgraph):
            try:
                work()
            except BaseException as error:
                errors.append(error)

    scene = bpy.context.scene
    before = scene.render.engine
    if scene.camera is None:  # no engine is asked to render without one
        scene.camera = bpy.data.objects.new("camera", bpy.data.cameras.new("camera"))
        scene.collection.objects.link(scene.camera)
    bpy.utils.register_class(Engine)
    try:
        scene.render.engine = Engine.bl_idname
        bpy.ops.render.render()
    finally:
        scene.render.engine = before
        bpy.utils.unregister_class(Engine)
    if errors:
        raise errors[0]
