"""Bakes and verifies metal boxes in a Cornell box, mirrors and rough ones: `python -m tests.reference.glossy_pictures`.

Writes docs/images/glossy-NAME.jpg (rasterised with the bundle, path-traced, difference) and prints the figures that README.md shows.
"""

from __future__ import annotations

import json
import subprocess
import sys
import tempfile
from pathlib import Path

from bake_core.examples import glossy_cornell
from tests.reference.gallery import ROOT, side_by_side

# Roughness and colour: silver, and copper.
METALS = {"mirror": (0.0, (0.95, 0.93, 0.88)), "metal": (0.35, (0.93, 0.62, 0.48))}


def main() -> int:
    octobake = str(Path(sys.executable).with_name("octobake"))
    for name, (roughness, color) in METALS.items():
        glb, spec = glossy_cornell(roughness, color)
        spec["stop"] = {"target_error": None, "max_samples": 64}
        with tempfile.TemporaryDirectory() as folder:
            work = Path(folder)
            (work / "scene.glb").write_bytes(glb)
            (work / "spec.json").write_text(json.dumps(spec))
            subprocess.run([octobake, "bake", "scene.glb", "--spec", "spec.json", "-o", "baked"], cwd=work, check=True)
            size = ["--width", "320", "--height", "240", "--samples", "64"]
            verify = [octobake, "verify", "baked", "--scene", "scene.glb", "-o", "verified", *size, "--json"]
            # 5 where a limit for matt scenes is not kept: the figures are what is wanted.
            report = json.loads(subprocess.run(verify, cwd=work, stdout=subprocess.PIPE, check=False).stdout)
            files = [work / "verified" / f"front.{kind}.png" for kind in ("raster", "path", "difference")]
            side_by_side(files, ROOT / "docs" / "images" / f"glossy-{name}.jpg")
        whole, rays = report["cameras"][0]["whole"], report["glossy"]
        print(f"{name}: HDR-FLIP {whole['flip']:.3f}, mean ratio {whole['mean_ratio']:.3f}; ", end="")
        print(f"rays: {100 * rays['rays']['agree']:.2f} % agree, mean ratio {rays['mean_ratio']:.3f}, relMSE {rays['relmse']:.3f}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
