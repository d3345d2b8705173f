"""Hosts for GLSL under test: one piece of a shader, run for many items on Vulkan and in a browser's WebGL2 alike.

Each takes GLSL that defines ``void answer(vec4 given[INPUTS], out vec4 found[ROWS])``; the module stands before it.
"""

from __future__ import annotations

import base64
import json
import re
from collections.abc import Callable, Sequence
from pathlib import Path
from shutil import copy
from tempfile import TemporaryDirectory

import numpy as np
from numpy.typing import NDArray

from bake_core.bundle import VolumeData
from bake_core.item_shader import answer_items, packed
from bake_core.probe_textures import probe_layers, probe_module
from bake_core.shader_compiler import shader_text
from bake_core.vulkan import Device
from tests.chromium import document

F32 = NDArray[np.float32]
F64 = NDArray[np.float64]
# GLSL, vectors (n, 3) for each item, how many vec4 it answers with, volumes to bind; (n, rows, 4) float32.
Host = Callable[[str, Sequence[F64], int, Sequence[VolumeData]], F32]

# Items along a row of the browser's texture: every WebGL2 takes so many.
WIDTH = 2048

_FRAGMENT = """#version 300 es
precision highp float;
precision highp int;
precision highp sampler2DArray;
uniform sampler2DArray host0;
{outs}
{module}
{answer}
void main() {{
    vec4 given[{inputs}], found[{rows}];
    for (int k = 0; k < {inputs}; ++k) given[k] = texelFetch(host0, ivec3(ivec2(gl_FragCoord.xy), k), 0);
    answer(given, found);
    {copies}
}}
"""


def on_vulkan(answer: str, inputs: Sequence[F64], rows: int, volumes: Sequence[VolumeData] = ()) -> F32:
    """As a compute shader, on the driver that the environment names."""
    with Device() as device:
        return answer_items(device, answer, inputs, rows, volumes)


def on_webgl2(answer: str, inputs: Sequence[F64], rows: int, volumes: Sequence[VolumeData] = ()) -> F32:
    """As a fragment shader of GLSL ES 3.00, in headless Chromium; one pixel an item, one render target a row."""
    given = packed(inputs)
    n, height = len(given), -(-len(given) // WIDTH)
    items = np.zeros((len(inputs), height * WIDTH, 4), np.float32)
    items[:, :n] = given.swapaxes(0, 1)
    layers = [(items.reshape(-1, height, WIDTH, 4), False), *(probe_layers(volumes) if volumes else [])]
    module = probe_module(volumes, 1) if volumes else shader_text("octahedral.glsl")
    # There, textures are bound by name.
    names = re.findall(r"uniform sampler2DArray (\w+);", module)
    source = _FRAGMENT.format(
        module=re.sub(r"layout\(set = 0, binding = \d+\) ", "", module),
        answer=answer,
        inputs=len(inputs),
        rows=rows,
        outs="\n".join(f"layout(location = {k}) out vec4 out{k};" for k in range(rows)),
        copies=" ".join(f"out{k} = found[{k}];" for k in range(rows)),
    )
    textures = [
        {"name": name, "shape": texels.shape, "linear": linear, "texels": base64.b64encode(texels.tobytes()).decode()}
        for name, (texels, linear) in zip(["host0", *names], layers, strict=True)
    ]
    job = {"source": source, "width": WIDTH, "height": height, "rows": rows, "textures": textures}
    found = np.frombuffer(base64.b64decode(_browse(job)), np.float32).reshape(rows, -1, 4)[:, :n]
    return np.ascontiguousarray(found.swapaxes(0, 1))


def _browse(job: dict[str, object]) -> str:
    """Open webgl2.html with a job in Chromium, and return what it leaves in the page."""
    with TemporaryDirectory() as place:
        page = Path(copy(Path(__file__).with_name("webgl2.html"), place))
        # Not in the page: Chromium takes a minute over one of 20 MB.
        page.with_name("job.js").write_text(f"const job = {json.dumps(job)};", "utf-8")
        left = document(page.as_uri(), "--enable-unsafe-swiftshader")
    found = re.search(r"<pre>(.*?)</pre>", left, re.DOTALL)
    assert found, left
    assert not found[1].startswith("error"), found[1]
    return found[1]
