"""A program for Blender's Python: renders a mesh from many cameras with Cycles on the CPU.

`kronc_ns.synthetic.blender` runs it as ``python blender_worker.py JOB.json`` in a process of its own, for Blender
keeps one global state, prints as it likes, and is GPL. It imports nothing of kronc_ns. For every view that is
finished it prints one line, the file it has written; everything else goes to stderr.
"""
# pyright: reportAttributeAccessIssue=false, reportMissingImports=false

import json
import os
import sys
from typing import Any

import bpy
import mathutils

SUN_STRENGTH, SUN_ANGLE_RAD, SKY_STRENGTH = 1.6, 0.02, 0.7


def main() -> None:
    """Set the scene up and render each frame of the job."""
    finished = os.fdopen(os.dup(1), "w", buffering=1)
    os.dup2(2, 1)  # Blender reports every tile on stdout
    with open(sys.argv[1], encoding="utf-8") as file:
        job = json.load(file)
    bpy.ops.wm.read_factory_settings(use_empty=True)
    bpy.ops.import_scene.gltf(filepath=job["mesh"])
    for extra in [o for o in bpy.data.objects if o.type in ("CAMERA", "LIGHT")]:
        bpy.data.objects.remove(extra)
    _light(job["sky"], job["sun"])
    if job["ground"]:
        _add_ground(**job["ground"])
        _add_wall(**job["wall"])
    camera = _add_camera(**job["camera"])
    scene = bpy.context.scene
    _set_cycles(scene, job["samples"], transparent=not job["ground"])
    for number, frame in enumerate(job["frames"]):
        camera.matrix_world = mathutils.Matrix(frame["c2w_opengl"])
        scene.cycles.seed = number
        scene.render.filepath = frame["file"]
        bpy.ops.render.render(write_still=True)
        print(frame["file"], file=finished)


def _set_cycles(scene: Any, samples: int, transparent: bool) -> None:
    """Path tracing on the CPU, denoised; colours as they are (no film-like tone curve); 8-bit PNG."""
    scene.render.engine = "CYCLES"
    scene.cycles.device = "CPU"
    scene.cycles.samples = samples
    scene.cycles.use_adaptive_sampling = False
    scene.cycles.use_denoising = True
    scene.cycles.denoiser = "OPENIMAGEDENOISE"
    scene.cycles.denoising_prefilter, scene.cycles.denoising_quality = "FAST", "BALANCED"  # best takes 3 s more a view
    scene.cycles.max_bounces, scene.cycles.diffuse_bounces = 4, 1
    scene.cycles.caustics_reflective = scene.cycles.caustics_refractive = False
    scene.cycles.sample_clamp_indirect = 4.0
    scene.render.use_persistent_data = True
    scene.render.film_transparent = transparent
    scene.view_settings.view_transform = "Standard"
    scene.render.image_settings.file_format = "PNG"
    scene.render.image_settings.color_mode = "RGBA"


def _add_camera(fx: float, fy: float, cx: float, cy: float, width: int, height: int) -> Any:
    """A pinhole camera; Blender knows no focal lengths in pixels but a sensor, its shift, and the shape of pixels."""
    render = bpy.context.scene.render
    render.resolution_x, render.resolution_y, render.resolution_percentage = width, height, 100
    render.pixel_aspect_x, render.pixel_aspect_y = max(1.0, fy / fx), max(1.0, fx / fy)
    data = bpy.data.cameras.new("camera")
    data.sensor_fit, data.sensor_width = "HORIZONTAL", 36.0
    data.lens = fx / width * data.sensor_width
    data.shift_x = 0.5 - cx / width
    data.shift_y = (cy - height / 2) / width * fx / fy
    data.clip_start, data.clip_end = 0.01, 1000.0
    camera = bpy.data.objects.new("camera", data)
    bpy.context.collection.objects.link(camera)
    bpy.context.scene.camera = camera
    return camera


def _light(sky: str, sun: list[float]) -> None:
    """A picture of the sky all around, and the sun in the direction ``sun``."""
    world = bpy.data.worlds.new("sky")
    world.use_nodes = True
    nodes, links = world.node_tree.nodes, world.node_tree.links
    picture = nodes.new("ShaderNodeTexEnvironment")
    picture.image = bpy.data.images.load(sky)
    links.new(picture.outputs["Color"], nodes["Background"].inputs["Color"])
    nodes["Background"].inputs["Strength"].default_value = SKY_STRENGTH
    bpy.context.scene.world = world
    data = bpy.data.lights.new("sun", "SUN")
    data.energy, data.angle = SUN_STRENGTH, SUN_ANGLE_RAD
    lamp = bpy.data.objects.new("sun", data)
    lamp.rotation_euler = mathutils.Vector(sun).to_track_quat("Z", "Y").to_euler()
    bpy.context.collection.objects.link(lamp)


def _add_ground(texture: str, half_m: float) -> None:
    """The square z = 0; seen from above, the picture's first row is at the largest x, its first column at largest y."""
    corners = [(half_m, half_m, 0), (-half_m, half_m, 0), (-half_m, -half_m, 0), (half_m, -half_m, 0)]
    _add_textured("ground", corners, [(0, 1, 2, 3)], [(0, 1), (0, 0), (1, 0), (1, 1)], texture, emits=False)


def _add_wall(texture: str, vertices: list, faces: list, uv: list) -> None:
    """Buildings all around."""
    _add_textured("wall", vertices, faces, uv, texture, emits=True)


def _add_textured(name: str, vertices: list, faces: list, uv: list, texture: str, emits: bool) -> None:
    """A mesh with a picture on it, that either shines with its colours or is lit; ``uv`` belongs to the vertices."""
    mesh = bpy.data.meshes.new(name)
    mesh.from_pydata(vertices, [], faces)
    layer = mesh.uv_layers.new()
    for loop in mesh.loops:
        layer.data[loop.index].uv = uv[loop.vertex_index]
    material = bpy.data.materials.new(name)
    material.use_nodes = True
    nodes, links = material.node_tree.nodes, material.node_tree.links
    picture = nodes.new("ShaderNodeTexImage")
    picture.image = bpy.data.images.load(texture)
    surface = nodes["Principled BSDF"].inputs
    surface["Roughness"].default_value, surface["Specular IOR Level"].default_value = 1.0, 0.0
    body = bpy.data.objects.new(name, mesh)
    if emits:  # what lies far away: seen and mirrored, but no light to sample and no shadow
        links.new(picture.outputs["Alpha"], surface["Alpha"])
        material.cycles.emission_sampling = "NONE"
        body.visible_shadow = False
        surface["Base Color"].default_value = (0, 0, 0, 1)
        surface["Emission Strength"].default_value = 1.0
        links.new(picture.outputs["Color"], surface["Emission Color"])
    else:
        links.new(picture.outputs["Color"], surface["Base Color"])
    mesh.materials.append(material)
    bpy.context.collection.objects.link(body)


if __name__ == "__main__":
    main()
