"""`octobake warmup`: compile every kernel, ahead of the first job."""

from __future__ import annotations

import argparse
import os
import tempfile
import time
from pathlib import Path
from typing import Any

from service.cli.bake import positive


def add(commands: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    """Add the command."""
    parser = commands.add_parser("warmup", help="compile every kernel, so that no job waits for it; an image's build runs this")
    parser.add_argument("--threads", type=positive, default=os.cpu_count() or 1, help="default: all cores")
    parser.set_defaults(run=run)


def run(args: argparse.Namespace) -> int:
    """Bake and verify a few probes; prints where the compiled kernels lie."""
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
    # A kernel's machine code hangs on the types of its arguments and never on a scene: so one small bake of everything compiles all.
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
    print(f"kernels are ready in {numba.config.CACHE_DIR} after {time.monotonic() - began:.1f} s{without}")
    return 0
