"""Where the rays of Blender's camera go: run with the arguments SCRIPT OUTPUT.

A sphere around the camera, seen at one sample a pixel through its centre; OUTPUT becomes an
array (N, 5) of pixels, x first, and points in Blender's world.
"""

# pyright: reportMissingImports=false, reportUnknownMemberType=false, reportUnknownVariableType=false, reportUnknownArgumentType=false
import sys
import tempfile
from pathlib import Path
from typing import Any

import bpy as blender
import numpy as np

bpy: Any = blender

script, output = sys.argv[1:3]
bpy.ops.wm.read_factory_settings(use_empty=True)
exec(compile(Path(script).read_text(), script, "exec"), {"__name__": "__main__"})
scene = bpy.context.scene
size = scene.render.resolution_x, scene.render.resolution_y
bpy.ops.mesh.primitive_uv_sphere_add(
    segments=128, ring_count=64, radius=50, location=scene.camera.matrix_world.translation
)
scene.render.engine = "CYCLES"
scene.cycles.samples = 1
scene.cycles.pixel_filter_type = "BOX"
scene.cycles.filter_width = 0.01
scene.cycles.use_denoising = False
scene.render.threads_mode = "FIXED"
scene.render.threads = 2
view_layer = scene.view_layers[0]
view_layer.use_pass_position = True
scene.render.image_settings.media_type = "MULTI_LAYER_IMAGE"
scene.render.image_settings.file_format = "OPEN_EXR_MULTILAYER"
scene.render.image_settings.color_depth = "32"
with tempfile.TemporaryDirectory() as folder:
    scene.render.filepath = f"{folder}/seen.exr"
    bpy.ops.render.render(write_still=True)
    import OpenImageIO as oiio

    picture: Any = oiio.ImageInput.open(f"{folder}/seen.exr")
    part = 0
    points: Any = None
    while points is None and picture.seek_subimage(part, 0):
        if any("Position" in name for name in picture.spec().channelnames):
            points = picture.read_image(part, 0, 0, 3, "float")
        part += 1
    picture.close()
assert points is not None, "no positions"
y, x = np.mgrid[0 : size[1] : 17, 0 : size[0] : 17]
found = np.column_stack([x.ravel(), y.ravel(), points[y.ravel(), x.ravel()]])
np.save(output, found[np.abs(found[:, 2:]).sum(axis=1) > 0])
