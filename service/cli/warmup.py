"""`octobake warmup`: compile every kernel, ahead of the first job."""

from __future__ import annotations

import argparse
import os
import tempfile
import time
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from service.cli.bake import positive

if TYPE_CHECKING:
    from bake_core.scene import Scene
    from bake_core.spec import Spec


def add(commands: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    """Add the command."""
    parser = commands.add_parser("warmup", help="compile every kernel, so that no job waits for it; an image's build runs this")
    parser.add_argument("--threads", type=positive, default=os.cpu_count() or 1, help="default: all cores")
    parser.set_defaults(run=run)


def run(args: argparse.Namespace) -> int:
    """Verify a small bake, and compile what other scenes will ask for; prints where the compiled kernels lie."""
    import numba

    from bake_core import verification
    from bake_core.bake import bake
    from bake_core.bundle import read_bundle
    from bake_core.errors import MachineError
    from bake_core.examples import cornell
    from bake_core.scene_files import load_scene
    from bake_core.spec import OUTPUTS, parse_spec

    began = time.monotonic()
    glb, spec = cornell()
    few: dict[str, Any] = {**spec["volumes"][0], "counts": [2, 2, 2]}
    whole = parse_spec({**spec, "volumes": [few], "outputs": list(OUTPUTS), "stop": {"target_error": None, "max_samples": 16}})
    with tempfile.TemporaryDirectory(prefix="octobake-warmup-") as name:
        folder = Path(name)
        (folder / "cornell.glb").write_bytes(glb)
        bake(folder / "cornell.glb", whole, folder / "bundle.zip", threads=args.threads)
        scene, bundle = load_scene(folder / "cornell.glb"), read_bundle(folder / "bundle.zip")
        try:
            verification.verify(bundle, scene, None, folder / "verified", width=32, height=18, samples=2, threads=args.threads)
            without = ""
        except MachineError as e:
            # Where nothing can be verified, its kernels are not wanted.
            without = f" (without those of verification: {e})"
        _compile_the_others(scene, whole, folder)
    print(f"kernels are ready in {numba.config.CACHE_DIR} after {time.monotonic() - began:.1f} s{without}")
    return 0


def _compile_the_others(scene: Scene, spec: Spec, folder: Path) -> None:
    """For each kind of scene: a kernel's machine code hangs on whether there are gloss, textures, an image for a sky, caches, a tree."""
    import numpy as np

    from bake_core.bake import compile_kernels
    from bake_core.environment import beside
    from bake_core.ggx_albedo import albedo_table
    from bake_core.images import write_exr
    from bake_core.light_tree import light_tree
    from bake_core.lights import emitter_table
    from bake_core.prepared import prepare
    from bake_core.spec import ConstantEnvironment, EquirectEnvironment

    _, tree = light_tree(scene, *emitter_table(scene))
    write_exr(folder / "sky.exr", np.ones((2, 4, 3), np.float32), ("R", "G", "B"))
    for environment in (ConstantEnvironment(), EquirectEnvironment(kind="equirect", image="sky.exr")):
        for integrator in ("path", "cache"):
            changed = spec.model_copy(update={"environment": environment, "integrator": integrator})
            prepared = prepare(scene, changed, beside(folder))
            whole = prepared.whole
            glossy = replace(whole, tables=whole.tables._replace(gloss=albedo_table()))
            for tracer in (whole, glossy, whole.general(scene)):
                many_lamps = replace(tracer, tables=tracer.tables._replace(tree=tree))
                for one in (tracer, many_lamps):
                    compile_kernels(prepared.traced_with(one), audited=True)
