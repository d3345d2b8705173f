"""Run by an interpreter that has Mitsuba 3: renders the scene that a test put in a file. Usage: render_with_mitsuba.py IN.npz OUT.npz."""

from __future__ import annotations

import sys
from typing import Any

import mitsuba as mi
import numpy as np

# Compiled ahead: the others need an LLVM library that knows the processor.
VARIANT = "scalar_rgb"


def material(name: str, given: Any) -> dict[str, Any]:
    if name + ".texture" in given:
        texture = mi.Bitmap(np.ascontiguousarray(given[name + ".texture"], np.float32))
        reflectance: dict[str, Any] = {"type": "bitmap", "bitmap": texture, "raw": True, "filter_type": "nearest"}
    else:
        reflectance = {"type": "rgb", "value": given[name + ".color"].tolist()}
    if name + ".alpha" in given:
        alpha = float(given[name + ".alpha"])
        inner = {"type": "roughconductor", "distribution": "ggx", "alpha": alpha, "material": "none", "specular_reflectance": reflectance}
    else:
        inner = {"type": "diffuse", "reflectance": reflectance}
    return {"type": "twosided", "inner": inner}


def mesh(name: str, given: Any) -> Any:
    properties = mi.Properties()
    properties["bsdf"] = mi.load_dict(material(name, given))
    properties["face_normals"] = True
    positions, indices = given[name + ".positions"], given[name + ".indices"]
    out = mi.Mesh(name, len(positions), len(indices), props=properties, has_vertex_normals=False, has_vertex_texcoords=True)
    parameters = mi.traverse(out)
    parameters["vertex_positions"] = positions.astype(np.float32).ravel()
    parameters["vertex_texcoords"] = given[name + ".uvs"].astype(np.float32).ravel()
    parameters["faces"] = indices.astype(np.uint32).ravel()
    parameters.update()
    return out


def main(source: str, target: str) -> None:
    """Render `runs` independent pictures, (runs, height, width, 3)."""
    mi.set_variant(VARIANT)
    given = np.load(source)
    height, width = given["size"].tolist()
    film = {"type": "hdrfilm", "width": width, "height": height, "rfilter": {"type": "box"}, "pixel_format": "rgb"}
    eye, at = given["eye"].tolist(), given["target"].tolist()
    view = mi.ScalarTransform4f().look_at(origin=eye, target=at, up=[0, 1, 0])
    scene: dict[str, Any] = {"type": "scene", **{str(n): mesh(str(n), given) for n in given["names"]}}
    scene["sky"] = {"type": "envmap", "bitmap": mi.Bitmap(np.ascontiguousarray(given["sky"], np.float32))}
    scene["camera"] = {
        "type": "perspective",
        "fov": float(given["yfov"]),
        "fov_axis": "y",
        "near_clip": 0.001,
        "to_world": view,
        "film": {**film, "component_format": "float32"},
    }
    scene["integrator"] = {"type": "path", "max_depth": int(given["max_depth"]), "rr_depth": 1000}
    loaded = mi.load_dict(scene)
    pictures = [np.array(mi.render(loaded, spp=int(given["samples"]), seed=run)) for run in range(int(given["runs"]))]
    np.savez(target, radiance=np.stack(pictures))


if __name__ == "__main__":
    main(sys.argv[1], sys.argv[2])
