"""The Vulkan layer: what it says where something is missing or wrong, and that nothing of a device outlives it."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from bake_core.errors import MachineError
from bake_core.shader_compiler import compile_glsl
from bake_core.vulkan import Bindings, Device, Draw, color_target, compute_pipeline, depth_target, graphics_pipeline, storage, texture
from tests import chromium

DOUBLE = """#version 450
layout(local_size_x = 64) in;
layout(set = 0, binding = 0) buffer Values { float values[]; };
layout(push_constant) uniform Push { int count; };
void main() {
    int i = int(gl_GlobalInvocationID.x);
    if (i < count) { values[i] *= 2.0; }
}
"""
TRIANGLE = """#version 450
void main() { gl_Position = vec4(vec2(gl_VertexIndex & 1, gl_VertexIndex >> 1) * 4.0 - 1.0, 0.25, 1.0); }
"""
LOOK_UP = """#version 450
layout(set = 0, binding = 0) uniform sampler2DArray image;
layout(location = 0) out vec4 color;
void main() { color = textureLod(image, vec3(gl_FragCoord.xy / 8.0, 1.0), 0.0); }
"""


def test_a_program_runs_on_the_cpu_and_validation_is_silent() -> None:
    with Device() as device:
        assert "llvmpipe" in device.name
        values = storage(device, np.arange(1000, dtype=np.float32))
        pipeline = compute_pipeline(device, compile_glsl(DOUBLE, "comp", "double"), Bindings(device, [values]))
        device.run(lambda commands: commands.dispatch(pipeline, 16, np.int32(990).tobytes()))
        expected = np.arange(1000) * np.where(np.arange(1000) < 990, 2, 1)
        np.testing.assert_array_equal(values.read(np.float32, (1000,)), expected)


def test_a_picture_of_a_texture_comes_back_as_it_was() -> None:
    texels = np.arange(2 * 8 * 8 * 4, dtype=np.float32).reshape(2, 8, 8, 4)
    with Device() as device:
        bindings = Bindings(device, [texture(device, texels, linear=True)])
        program = graphics_pipeline(
            device, compile_glsl(TRIANGLE, "vert", "triangle"), compile_glsl(LOOK_UP, "frag", "look up"), bindings, 1
        )
        color, depth = color_target(device, 8, 8), depth_target(device, 8, 8)
        pixels, depths = storage(device, color.bytes), storage(device, depth.bytes)
        device.run(lambda c: c.draw(program, [Draw(3, 1, 0, 0)], b"", colors=[color], depth=depth, clear=[(0, 0, 0, 0)]))
        device.run(lambda c: c.download(color, pixels))
        device.run(lambda c: c.download(depth, depths))
        np.testing.assert_allclose(pixels.read(np.float32, (8, 8, 4)), texels[1], rtol=1e-6)
        np.testing.assert_array_equal(depths.read(np.float32, (8, 8)), 0.25)


def test_what_the_validation_layers_say_is_an_error() -> None:
    with Device() as device:
        if not device.validated:
            pytest.skip("the Vulkan validation layers are not installed (Debian: vulkan-validationlayers)")
        values = storage(device, 16)
        pipeline = compute_pipeline(device, compile_glsl(DOUBLE, "comp", "double"), Bindings(device, [values]))
        with pytest.raises(MachineError) as caught:
            device.run(lambda commands: commands.dispatch(pipeline, 1 << 20, b"\0\0\0\0"))  # more groups than the device takes
        assert caught.value.slug == "vulkan.validation"


def test_an_image_or_a_buffer_larger_than_the_device_takes_is_refused() -> None:
    with Device() as device, pytest.raises(MachineError) as caught:
        depth_target(device, 1 << 20, 1)
    assert caught.value.slug == "vulkan.image_too_large"
    with Device() as device, pytest.raises(MachineError) as caught:
        storage(device, 1 << 40)
    assert caught.value.slug == "vulkan.buffer_too_large"


def test_the_environment_names_another_driver(monkeypatch: pytest.MonkeyPatch) -> None:
    chromium.needed("SwiftShader")
    monkeypatch.setenv("VK_DRIVER_FILES", str(chromium.SWIFTSHADER))
    with Device() as device:
        assert "SwiftShader" in device.name


def test_a_device_that_is_not_there_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("OCTOBAKE_VULKAN_DEVICE", "no such device")
    with pytest.raises(MachineError, match="llvmpipe") as caught:
        Device()
    assert caught.value.slug == "vulkan.missing"


def test_without_a_driver_the_package_to_install_is_named() -> None:
    """In a process of its own: the loader reads this variable once."""
    lines = ("from bake_core.errors import MachineError", "from bake_core.vulkan import Device", "try:", "    Device()")
    code = "\n".join((*lines, "except MachineError as e:", "    print(e.slug, e)"))
    environment = os.environ | {"VK_ICD_FILENAMES": "/nonexistent.json", "VK_DRIVER_FILES": "/nonexistent.json"}
    done = subprocess.run([sys.executable, "-c", code], env=environment, capture_output=True, text=True, check=True)
    assert done.stdout.startswith("vulkan.missing")
    assert "mesa-vulkan-drivers" in done.stdout


def test_without_a_loader_only_what_needs_pictures_fails(tmp_path: Path) -> None:
    """Importing verification must not: the service bakes on machines that have no Vulkan."""
    # The package of this name opens libvulkan.so.1 when it is imported, and this is what it does where there is none.
    (tmp_path / "vulkan.py").write_text('raise OSError("Cannot find Vulkan SDK version")')
    lines = ("from bake_core import verification", "from bake_core.errors import MachineError", "try:", "    verification.Device()")
    code = "\n".join((*lines, "except MachineError as e:", "    print(e.slug, e)"))
    environment = os.environ | {"PYTHONPATH": os.pathsep.join((str(tmp_path), *sys.path))}
    done = subprocess.run([sys.executable, "-c", code], env=environment, capture_output=True, text=True, check=True)
    assert done.stdout.startswith("vulkan.missing"), done.stderr
    assert "libvulkan1" in done.stdout


def test_two_devices_do_not_disturb_each_other() -> None:
    with Device() as first:
        values = storage(first, np.ones(4, np.float32))
        with Device() as second:
            assert storage(second, np.zeros(4, np.float32)).read(np.float32, (4,)).sum() == 0
        assert values.read(np.float32, (4,)).sum() == 4
