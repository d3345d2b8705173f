"""Compile every shader for every target: `python tests/compile_shaders.py`, part of `make check`.

The module's examples stand in shaders/README.md, so what is compiled is what people copy.
"""

from __future__ import annotations

import re
import subprocess
import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from bake_core.shader_compiler import compile_glsl, shader_text
from bake_core.shader_constants import bundle_constants
from tests.conformance import synthetic

INCLUDE = re.compile(r'^#include "(.+)"$', re.MULTILINE)


def examples() -> dict[str, str]:
    """The README's examples by their ``#version``, with the module pasted in: constants of three volumes."""
    constants = bundle_constants(synthetic.volumes())
    found = {}
    for block in re.findall(r"```glsl\n(#version .*?)```", shader_text("README.md"), re.DOTALL):
        version = block.splitlines()[0].removeprefix("#version ")
        source = block.replace("#extension GL_GOOGLE_include_directive : require\n", "")
        found[version] = INCLUDE.sub(lambda m: constants if m[1] == "constants.glsl" else shader_text(m[1]), source)
    return found


def check_es300(source: str) -> None:
    """Compile and link as a WebGL2 driver would; raises CalledProcessError with what glslangValidator says."""
    subprocess.run(["glslangValidator", "-l", "--stdin", "-S", "frag"], input=source, text=True, check=True, capture_output=True)


def main() -> int:
    found = examples()
    if sorted(found) != ["300 es", "450"]:
        print(f"shaders/README.md should hold one example for each of 450 and 300 es, not {sorted(found)}", file=sys.stderr)
        return 1
    try:
        compile_glsl(found["450"], "frag", "the Vulkan example")
        check_es300(found["300 es"])
    except subprocess.CalledProcessError as e:
        print(f"the WebGL2 example: {e.stdout}{e.stderr}", file=sys.stderr)
        return 1
    print("shaders: the module compiles as Vulkan GLSL 4.50 and as GLSL ES 3.00")
    return 0


if __name__ == "__main__":
    sys.exit(main())
