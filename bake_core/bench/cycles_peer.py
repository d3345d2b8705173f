"""Run by an interpreter that has Blender as a module (bpy), and nothing of ours: Cycles renders the radiance of probes' texels.

Usage: cycles_peer.py WORK.npz. Speaks as :mod:`bake_core.bench.mitsuba_peer` does. All probes are one picture, through a camera that is a
program in OSL.
"""

from __future__ import annotations

import json
import os
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

import bpy
import numpy as np

# The wheel brings oslquery, without which a camera in OSL stays black, but not on the path.
sys.path.extend(str(p) for p in Path(bpy.utils.resource_path("LOCAL")).glob("python/lib/python3*/site-packages"))
import OpenEXR
from mathutils import Matrix, Vector

# Blender's own limit.
_MOST_BOUNCES = 1024


def material(name: str, work: Any) -> Any:
    """Lambert and emission; from behind black where it is single-sided."""
    out = bpy.data.materials.new(name)
    out.use_nodes = True
    nodes, links = out.node_tree.nodes, out.node_tree.links
    nodes.clear()
    double_sided, emission = bool(work[name + ".double_sided"]), work[name + ".emission"]
    shader = nodes.new("ShaderNodeBsdfDiffuse")
    shader.inputs["Color"].default_value = (*work[name + ".albedo"].tolist(), 1)
    if len(work[name + ".color"]):
        attribute = nodes.new("ShaderNodeAttribute")
        # Not "vertex_color", which Cycles takes for a standard attribute of its own, and finds black.
        attribute.attribute_name = "octobake_albedo"
        links.new(attribute.outputs["Vector"], shader.inputs["Color"])
    surface = shader.outputs[0]
    if emission.any():
        emits = nodes.new("ShaderNodeEmission")
        emits.inputs["Color"].default_value = (*emission.tolist(), 1)
        both = nodes.new("ShaderNodeAddShader")
        links.new(surface, both.inputs[0])
        links.new(emits.outputs[0], both.inputs[1])
        surface = both.outputs[0]
        out.cycles.emission_sampling = "FRONT_BACK" if double_sided else "FRONT"
    if not double_sided:
        side, black, mix = nodes.new("ShaderNodeNewGeometry"), nodes.new("ShaderNodeBsdfDiffuse"), nodes.new("ShaderNodeMixShader")
        black.inputs["Color"].default_value = (0, 0, 0, 1)
        links.new(side.outputs["Backfacing"], mix.inputs[0])
        links.new(surface, mix.inputs[1])
        links.new(black.outputs[0], mix.inputs[2])
        surface = mix.outputs[0]
    links.new(surface, nodes.new("ShaderNodeOutputMaterial").inputs["Surface"])
    return out


def mesh(name: str, work: Any) -> Any:
    out = bpy.data.meshes.new(name)
    points, triangles, color = work[name + ".points"], work[name + ".triangles"], work[name + ".color"]
    out.vertices.add(len(points))
    out.vertices.foreach_set("co", points.ravel())
    out.loops.add(triangles.size)
    out.loops.foreach_set("vertex_index", triangles.astype(np.int32).ravel())
    out.polygons.add(len(triangles))
    out.polygons.foreach_set("loop_start", np.arange(0, triangles.size, 3, dtype=np.int32))
    out.update(calc_edges=True)
    out.shade_flat()
    if len(color):
        out.attributes.new("octobake_albedo", "FLOAT_VECTOR", "POINT").data.foreach_set("vector", color.ravel())
    out.materials.append(material(name, work))
    return out


def camera_program(work: Any, across: int, down: int) -> str:
    """The camera in OSL: tile by tile, each volume's probes in flat order. Blender's camera space has z the other way round."""
    side, first, places = int(work["side"]), 0, []
    for origin, spacing, counts in zip(work["origin"].tolist(), work["spacing"].tolist(), work["counts"].tolist(), strict=True):
        nx, ny, nz = counts
        at = [f"{o:.9g}+{s:.9g}*({i})" for o, s, i in zip(origin, spacing, (f"k%{nx}", f"(k/{nx})%{ny}", f"k/{nx * ny}"), strict=True)]
        places.append(f"if (probe>={first}) {{ int k=probe-{first}; position=point({at[0]},{at[1]},-({at[2]})); }}")
        first += nx * ny * nz
    return f"""
shader probes(output point position=0.0, output vector direction=0.0, output color throughput=1.0) {{
  point r=camera_shader_raster_position();
  float px=r[0]*{across * side}.0; float py=(1.0-r[1])*{down * side}.0;
  int column=clamp((int)floor(px/{side}.0),0,{across - 1}); int row=clamp((int)floor(py/{side}.0),0,{down - 1});
  int probe=min(row*{across}+column,{first - 1});
  {" ".join(places)}
  float x=2.0*(px/{side}.0-column)-1.0; float y=2.0*(py/{side}.0-row)-1.0; float z=1.0-fabs(x)-fabs(y);
  float fold=max(-z,0.0);
  x+=(x>=0.0)?-fold:fold; y+=(y>=0.0)?-fold:fold;
  direction=normalize(vector(x,y,-z));
  throughput=color(1.0);
}}"""


def main(path: str) -> None:
    began = time.perf_counter()
    work = np.load(path)
    bpy.ops.wm.read_factory_settings(use_empty=True)
    scene = bpy.context.scene
    scene.render.engine = "CYCLES"
    for name in work["names"]:
        scene.collection.objects.link(bpy.data.objects.new(str(name), mesh(str(name), work)))
    world = bpy.data.worlds.new("sky")
    scene.world = world
    world.use_nodes = True
    background = world.node_tree.nodes["Background"]
    background.inputs["Color"].default_value = (*work["sky"].tolist(), 1)
    background.inputs["Strength"].default_value = 1.0
    for direction, irradiance in zip(work["sun_direction"].tolist(), work["sun_irradiance"].tolist(), strict=True):
        sun = bpy.data.lights.new("sun", "SUN")
        sun.angle, sun.energy, sun.color = 0, max(irradiance), [c / max(irradiance) for c in irradiance]
        held = bpy.data.objects.new("sun", sun)
        held.rotation_euler = Vector(direction).to_track_quat("-Z", "Y").to_euler()
        scene.collection.objects.link(held)
    count, side = len(work["positions"]), int(work["side"])
    across = 1 << max(0, int(np.ceil(np.log2(np.sqrt(count)))))
    down = -(-count // across)
    settle(scene, int(work["threads"]), int(work["max_bounces"]))
    camera = bpy.data.cameras.new("probes")
    # The default of 0.1 would leave out what is near a probe.
    camera.clip_start, camera.clip_end = 1e-4, 1e6
    program = bpy.data.texts.new("probes.osl")
    program.write(camera_program(work, across, down))
    camera.type, camera.custom_mode, camera.custom_shader = "CUSTOM", "INTERNAL", program
    holder = bpy.data.objects.new("probes", camera)
    holder.matrix_world = Matrix.Identity(4)
    scene.collection.objects.link(holder)
    scene.camera = holder
    scene.render.resolution_x, scene.render.resolution_y = across * side, down * side
    with tempfile.TemporaryDirectory() as folder:
        scene.render.filepath = str(Path(folder) / "probes.exr")

        def render(samples: int, seed: int) -> Any:
            scene.cycles.samples, scene.cycles.seed = samples, seed
            # Data that persists does not hear of changed samples and seeds by itself.
            scene.update_tag()
            bpy.context.view_layer.update()
            bpy.ops.render.render(write_still=True)
            with OpenEXR.File(scene.render.filepath) as file:
                channels = file.channels()
                (packed,) = [c for c in channels if c in ("RGB", "RGBA")]
                picture = np.array(channels[packed].pixels)[..., :3]
            tiles = picture.reshape(down, side, across, side, 3).transpose(0, 2, 1, 3, 4)
            return tiles.reshape(across * down, side, side, 3)[:count]

        read = time.perf_counter()
        render(1, 0)
        tell(name=f"Cycles (bpy {bpy.app.version_string})", load=read - began, compile=time.perf_counter() - read)
        for line in sys.stdin:
            wanted = json.loads(line)
            started = time.perf_counter()
            tiles = render(wanted["samples"], wanted["seed"])
            seconds = time.perf_counter() - started
            np.save(wanted["out"], tiles.astype(np.float32))
            tell(seconds=seconds)


def settle(scene: Any, threads: int, bounces: int) -> None:
    """All that trades truth for looks or speed is off."""
    cycles, render = scene.cycles, scene.render
    cycles.device = "CPU"
    # Cycles counts from the first bounce, ours from the ray's first surface.
    cycles.max_bounces = cycles.diffuse_bounces = _MOST_BOUNCES if bounces < 0 else max(bounces - 1, 0)
    cycles.glossy_bounces = cycles.transmission_bounces = cycles.transparent_max_bounces = cycles.volume_bounces = 0
    cycles.use_adaptive_sampling = cycles.use_denoising = cycles.caustics_reflective = cycles.caustics_refractive = False
    cycles.sample_clamp_direct = cycles.sample_clamp_indirect = cycles.blur_glossy = 0
    cycles.pixel_filter_type = "BOX"
    cycles.filter_width = 1.0
    if bounces >= 0:
        cycles.min_light_bounces = cycles.min_transparent_bounces = _MOST_BOUNCES
    cycles.light_sampling_threshold = 0
    cycles.use_light_tree = False
    cycles.use_auto_tile = False
    render.use_persistent_data = True
    render.threads_mode, render.threads = "FIXED", threads
    scene.view_settings.view_transform = "Raw"
    render.image_settings.file_format, render.image_settings.color_depth = "OPEN_EXR", "32"
    render.image_settings.exr_codec = "NONE"
    render.resolution_percentage = 100
    render.use_compositing = render.use_sequencer = False


# Blender writes to stdout: answers go where it led at first.
_ANSWERS = os.fdopen(os.dup(1), "w")


def tell(**document: Any) -> None:
    _ANSWERS.write(json.dumps(document) + "\n")
    _ANSWERS.flush()


if __name__ == "__main__":
    os.dup2(2, 1)
    main(sys.argv[1])
