"""One frozen scene of arrays: what every reader produces and every kernel consumes.

All positions in a :class:`Scene` are relative to `origin` (float64, world), so that float32 keeps its accuracy in a scene that
stands 1,000 km from zero. World position = origin + local position.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

F32 = NDArray[np.float32]
F64 = NDArray[np.float64]
I32 = NDArray[np.int32]
I64 = NDArray[np.int64]
U32 = NDArray[np.uint32]
Bool = NDArray[np.bool_]

LIGHT_DIRECTIONAL, LIGHT_POINT, LIGHT_SPOT = 0, 1, 2
ALPHA_OPAQUE, ALPHA_MASK, ALPHA_BLEND = 0, 1, 2
WRAP_REPEAT, WRAP_MIRRORED, WRAP_CLAMP = 0, 1, 2
NO_TEXTURE = -1


@dataclass(frozen=True)
class Image:
    """One decoded picture, as its file holds it.

    Attributes
    ----------
    name : str
        How messages call it.
    pixels : (height, width, 4) uint8 or uint16
        RGBA, not premultiplied; row 0 is the top, where v = 0. No alpha in the file: all ones. Whether RGB is sRGB or linear is a matter
        of use.
    """

    name: str
    pixels: NDArray[np.uint8] | NDArray[np.uint16]


@dataclass(frozen=True)
class Texture:
    """One use of an image by materials.

    Attributes
    ----------
    image : int
        Into `Scene.images`.
    srgb : bool
        RGB is decoded by the sRGB transfer function (IEC 61966-2-1); alpha never is.
    wrap : (int, int)
        WRAP_REPEAT, WRAP_MIRRORED or WRAP_CLAMP along u and v.
    nearest : bool
        No interpolation between texels.
    uv_set : int
        Which pair of columns of `Scene.uvs`.
    transform : ((float, float, float), (float, float, float))
        KHR_texture_transform: rows of the matrix that takes (u, v, 1) to the image's (u, v).
    """

    image: int
    srgb: bool
    wrap: tuple[int, int]
    nearest: bool
    uv_set: int
    transform: tuple[tuple[float, float, float], tuple[float, float, float]]


@dataclass(frozen=True)
class Materials:
    """Materials as columns; a triangle's `triangle_material` indexes them. Row order is the reader's.

    Attributes
    ----------
    name : tuple of str
    base_color : (m, 3) float32
        Linear Rec.709 reflectance factor in [0, 1].
    metallic, roughness : (m,) float32
        glTF's factors. (0, 1) is exactly Lambert.
    emission : (m, 3) float32
        Radiance (emissiveFactor × emissiveStrength), from the front, and from the back too where double-sided.
    double_sided : (m,) bool
        False: black from behind, and such hits count as backface hits.
    unlit : (m,) bool
        KHR_materials_unlit: the reader has moved the base colour into the emission and set (0, 0, 1) for base colour, metallic, roughness;
        here the vertex colour multiplies the emission too.
    alpha_mode : (m,) uint8
        ALPHA_OPAQUE: alpha does not matter. ALPHA_MASK: a hole where alpha < cutoff. ALPHA_BLEND: there with probability alpha.
    alpha, alpha_cutoff : (m,) float32
        Factors; alpha is this × COLOR_0's × the base colour texture's.
    base_color_texture, metallic_roughness_texture, emissive_texture : (m,) int32
        Into `Scene.textures`, or NO_TEXTURE. Factors multiply what they hold: RGB, (·, roughness, metallic), RGB.
    """

    name: tuple[str, ...]
    base_color: F32
    metallic: F32
    roughness: F32
    emission: F32
    double_sided: Bool
    unlit: Bool
    alpha_mode: NDArray[np.uint8]
    alpha: F32
    alpha_cutoff: F32
    base_color_texture: I32
    metallic_roughness_texture: I32
    emissive_texture: I32

    @property
    def lambert(self) -> Bool:
        """(m,) bool: exactly Lambert at every point."""
        flat: Bool = (self.metallic == 0) & (self.roughness == 1) & (self.metallic_roughness_texture == NO_TEXTURE)
        return flat


@dataclass(frozen=True)
class Lights:
    """Punctual and directional lights as columns, positions relative to the scene's origin.

    Attributes
    ----------
    kind : (n,) int32
        LIGHT_DIRECTIONAL, LIGHT_POINT or LIGHT_SPOT.
    position : (n, 3) float32
        Metres, relative to `Scene.origin`; zeros for directional lights.
    direction : (n, 3) float32
        Unit, the way the light travels; zeros for point lights.
    value : (n, 3) float32
        Directional: irradiance on a plane perpendicular to `direction`. Point and spot: radiant intensity.
    cos_inner, cos_outer : (n,) float32
        Cosines of a spot's cone angles (inner ≥ outer in cosine); 1 and -1 elsewhere.
    range : (n,) float32
        Metres; inf where the light has none. KHR_lights_punctual's window (1 - (d/range)^4)+ applies.
    """

    kind: I32
    position: F32
    direction: F32
    value: F32
    cos_inner: F32
    cos_outer: F32
    range: F32


@dataclass(frozen=True)
class Camera:
    """A perspective camera. `matrix` is (4, 4) float64, camera to world (looks along its -Z, up is +Y); `yfov` in radians."""

    name: str
    matrix: F64
    yfov: float


@dataclass(frozen=True)
class SceneNode:
    """A node that a spec can name. `matrix` is (4, 4) float64, local to world."""

    name: str
    index: int
    matrix: F64


@dataclass(frozen=True)
class Scene:
    """Everything a bake needs to know of a scene.

    Attributes
    ----------
    digest : str
        ``sha256:HEX`` of the scene's bytes (see the reader for scenes of several files).
    origin : (3,) float64
        World position of the local frame's zero.
    bounds : (2, 3) float64
        World-space box of all triangles, [min, max]; zeros where there is no geometry.
    positions, normals : (v, 3) float32
        Vertices of all meshes, concatenated. A zero normal means: none given, shade flat. `normals` is (0, 3) where no mesh has any.
    colors : (v, 4) float32
        COLOR_0, linear; (0, 4) where no mesh has any.
    uvs : (v, 2 s) float32
        Texture coordinates: a pair of columns for each set that a texture in use names (`Texture.uv_set`); s may be 0.
    indices : (t, 3) uint32
        Triangles of all meshes, concatenated, into the vertex arrays above (not relative to the mesh).
        Counter-clockwise from the front, after mirrored transforms are accounted for.
    triangle_material : (t,) uint32
    mesh_first_triangle : (m + 1,) int64
        Mesh i owns triangles [mesh_first_triangle[i], mesh_first_triangle[i + 1]).
        Mesh 0 is everything that occurs once, already in the local frame (it may be empty); meshes 1.. are prototypes, used by instances
        only.
    instance_mesh : (i,) int32
        The prototype of each instance, ≥ 1.
    instance_transform : (i, 3, 4) float64
        Prototype space to local frame. A mirrored instance keeps its front: normals follow the inverse transpose.
    materials, lights, cameras, nodes
    textures : tuple of Texture
    images : tuple of Image
        What materials in use look at, each once.
    ignored : tuple of str
        What was read over because it does not matter to a bake or is optional, one line each.
    """

    digest: str
    origin: F64
    bounds: F64
    positions: F32
    normals: F32
    colors: F32
    uvs: F32
    indices: U32
    triangle_material: U32
    mesh_first_triangle: I64
    instance_mesh: I32
    instance_transform: F64
    materials: Materials
    lights: Lights
    cameras: tuple[Camera, ...]
    nodes: tuple[SceneNode, ...]
    textures: tuple[Texture, ...]
    images: tuple[Image, ...]
    ignored: tuple[str, ...]

    @property
    def triangle_count(self) -> int:
        """Triangles as seen by rays: every instance's counted."""
        per_mesh = np.diff(self.mesh_first_triangle)
        return int(per_mesh[0]) + int(per_mesh[self.instance_mesh].sum())
