"""The GLSL module on a Vulkan device, for many items at once: a piece of GLSL answers for each."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike, NDArray

from bake_core.bundle import VolumeData
from bake_core.probe_textures import probe_module, probe_textures
from bake_core.shader_compiler import compile_glsl, shader_text
from bake_core.vulkan import Bindings, Device, compute_pipeline, storage

F32 = NDArray[np.float32]
F64 = NDArray[np.float64]

_GROUP = 64
_SHADER = """#version 450
layout(local_size_x = {group}) in;
layout(set = 0, binding = 0) readonly buffer Inputs {{ vec4 inputs[]; }};
layout(set = 0, binding = 1) writeonly buffer Outputs {{ vec4 outputs[]; }};
layout(push_constant) uniform Push {{ int count; }};
{module}
{answer}
void main() {{
    int i = int(gl_GlobalInvocationID.x);
    if (i < count) {{
        vec4 given[{inputs}], found[{rows}];
        for (int k = 0; k < {inputs}; ++k) given[k] = inputs[{inputs} * i + k];
        answer(given, found);
        for (int k = 0; k < {rows}; ++k) outputs[{rows} * i + k] = found[k];
    }}
}}
"""


def packed(inputs: Sequence[ArrayLike]) -> F32:
    """Vectors (n, 3) each, as vec4s: (n, inputs, 4) float32."""
    vectors = np.stack([np.asarray(v, np.float64).reshape(-1, 3) for v in inputs], 1)
    return np.concatenate([vectors, np.zeros((*vectors.shape[:2], 1))], -1).astype(np.float32)


def answer_items(
    device: Device,
    answer: str,
    inputs: Sequence[ArrayLike],
    rows: int,
    volumes: Sequence[VolumeData] = (),
    frame: ArrayLike = (0.0, 0.0, 0.0),
) -> F32:
    """Run a compute shader, an invocation for each item.

    Parameters
    ----------
    answer : str
        GLSL that defines ``void answer(vec4 given[INPUTS], out vec4 found[ROWS])``; the module stands before it, all of it where there are
        volumes, else the octahedral map alone.
    inputs : sequence of (n, 3) float
    frame : (3,) float
        World position at which the module's positions are zero.

    Returns
    -------
    (n, rows, 4) float32
    """
    given = packed(inputs)
    n = len(given)
    module = probe_module(volumes, 2, frame) if volumes else shader_text("octahedral.glsl")
    source = _SHADER.format(group=_GROUP, module=module, answer=answer, inputs=len(inputs), rows=rows)
    buffers = [storage(device, given), storage(device, n * rows * 16)]
    bindings = Bindings(device, [*buffers, *(probe_textures(device, volumes) if volumes else [])])
    pipeline = compute_pipeline(device, compile_glsl(source, "comp", "answer"), bindings)
    device.run(lambda commands: commands.dispatch(pipeline, (n + _GROUP - 1) // _GROUP, np.int32(n).tobytes()))
    return buffers[1].read(np.float32, (n, rows, 4))
