"""Renders what Blender shows of a world: run with the arguments KIND COMPANION OUTPUT.

A fisheye of 340 degrees that looks along Blender's -X, 64 x 64, one sample a pixel.
"""

# pyright: reportMissingImports=false, reportUnknownMemberType=false, reportUnknownVariableType=false, reportUnknownArgumentType=false
import math
import sys

import bpy
from mathutils import Vector

kind, path, output = sys.argv[1:4]
bpy.ops.wm.read_factory_settings(use_empty=False)
scene = bpy.context.scene
if kind == "usd":
    bpy.ops.wm.usd_import(filepath=path)
else:
    with open(path) as file:
        code = compile(file.read(), path, "exec")
    exec(code, {"__file__": path, "__name__": "__main__"})
for thing in list(bpy.data.objects):
    bpy.data.objects.remove(thing)
scene.render.engine = "CYCLES"
scene.cycles.samples = 1
scene.cycles.use_denoising = False
scene.render.threads_mode = "FIXED"
scene.render.threads = 2
scene.render.resolution_x = scene.render.resolution_y = 64
scene.render.image_settings.file_format = "OPEN_EXR"
scene.render.image_settings.color_depth = "32"
data = bpy.data.cameras.new("eye")
data.type = "PANO"
data.panorama_type = "FISHEYE_EQUIDISTANT"
data.fisheye_fov = math.radians(340)
eye = bpy.data.objects.new("eye", data)
scene.collection.objects.link(eye)
scene.camera = eye
eye.rotation_mode = "QUATERNION"
eye.rotation_quaternion = Vector((-1, 0, 0)).to_track_quat("-Z", "Y")
scene.render.filepath = output
bpy.ops.render.render(write_still=True)
