"""Textures: samplers, images and how materials use them. Every field is checked; only what a used material looks at is decoded."""

from __future__ import annotations

import math
from dataclasses import replace

from bake_core.errors import SceneError
from bake_core.gltf.accessors import Accessors
from bake_core.gltf.container import Document
from bake_core.gltf.fields import Fields, Notes, fail, quoted
from bake_core.images import decode_picture, picture_size
from bake_core.scene import WRAP_CLAMP, WRAP_MIRRORED, WRAP_REPEAT, Image, Texture

WRAPS = {10497: WRAP_REPEAT, 33648: WRAP_MIRRORED, 33071: WRAP_CLAMP}
NEAREST, LINEAR = 9728, 9729
MIN_FILTERS = (9728, 9729, 9984, 9985, 9986, 9987)
TYPES = ("image/png", "image/jpeg")
TRANSFORM = "KHR_texture_transform"
# Decoded with its pyramid, a texel takes 15 bytes: about 4 GB for all of a scene's, and the largest one takes thrice as much while it is
# prepared.
MAX_TEXELS, MAX_IMAGE_TEXELS = 1 << 28, 1 << 26
# A texture repeated more often than this over one step of its coordinates is a mistake, and leaves float64 nothing to interpolate by.
_MAX_TRANSFORM = 1e6


class Textures:
    """A document's textures, and those of them that are used.

    Raises
    ------
    SceneError
        On making: what :class:`Fields` raises for samplers, images and textures, used or not.
    """

    def __init__(self, document: Document, accessors: Accessors, notes: Notes) -> None:
        self._document = document
        self._accessors = accessors
        self._notes = notes
        self._images = document.root.children("images")
        for image in self._images:
            _check_image(image, accessors)
        self._samplers = [_sampler(f) for f in document.root.children("samplers")]
        self._textures = document.root.children("textures")
        for texture in self._textures:
            texture.index("source", len(self._images), "images")
            texture.index("sampler", len(self._samplers), "samplers")
        self._used: dict[Texture, int] = {}
        self._rows: dict[int, int] = {}

    def check(self, info: Fields) -> tuple[int, tuple[tuple[float, float, float], tuple[float, float, float]]]:
        """Check a material's textureInfo; the number of its TEXCOORD, and its transform."""
        info.required_index("index", len(self._textures), "textures")
        number = info.integer("texCoord", default=0)
        extension = info.child("extensions").child(TRANSFORM)
        number = extension.integer("texCoord", default=number)
        limit = {"low": -_MAX_TRANSFORM, "high": _MAX_TRANSFORM}
        x, y = extension.numbers("offset", (0.0, 0.0), **limit)
        width, height = extension.numbers("scale", (1.0, 1.0), **limit)
        turn = extension.number("rotation", default=0.0, **limit)
        c, s = math.cos(turn), math.sin(turn)
        # The extension's translation · rotation · scale; its rotation turns v, which points down, towards u.
        return number, ((c * width, s * height, x), (-s * width, c * height, y))

    def use(self, info: Fields, *, srgb: bool) -> int:
        """Row of :meth:`read`'s textures for a textureInfo of a material in use; its `uv_set` is the number of its TEXCOORD until then.

        Raises
        ------
        SceneError
            ``gltf.unsupported_image`` where the texture has no image that could be read.
        """
        number, transform = self.check(info)
        texture = self._textures[info.value["index"]]
        source = texture.value.get("source")
        if source is None:
            others = ", ".join(map(quoted, texture.child("extensions").value))
            only = f", only what {others} names" if others else ""
            fail("unsupported_image", f"a texture without PNG or JPEG{only}; convert it to PNG or JPEG", texture.where)
        wrap, nearest = ((WRAP_REPEAT, WRAP_REPEAT), False)
        if "sampler" in texture:
            sampler = texture.value["sampler"]
            wrap, nearest = self._samplers[sampler]
            if "minFilter" in self._document.root.value["samplers"][sampler]:
                self._notes.add("minFilter: textures are averaged over what a ray stands for", f"samplers[{sampler}]")
        image = self._rows.setdefault(source, len(self._rows))
        return self._used.setdefault(Texture(image, srgb, wrap, nearest, number, transform), len(self._used))

    def number(self, row: int) -> int:
        """Which TEXCOORD a used texture looks at."""
        return list(self._used)[row].uv_set

    def sets(self) -> list[int]:
        """The numbers of all TEXCOORDs that used textures look at, in order."""
        return sorted({t.uv_set for t in self._used})

    def read(self) -> tuple[tuple[Texture, ...], tuple[Image, ...]]:
        """The textures in use and their decoded images.

        Raises
        ------
        SceneError
            ``gltf.images_too_large`` before anything is decoded, ``gltf.bad_image``, and what reading a file may raise.
        """
        encoded = [(_name(self._images[i]), self._bytes(self._images[i])) for i in self._rows]
        total = 0
        for name, data in encoded:
            width, height = picture_size(data, SceneError, "gltf.bad_image", name)
            total += width * height
            if width * height > MAX_IMAGE_TEXELS:
                fail("images_too_large", f"has {width} × {height} texels, more than {MAX_IMAGE_TEXELS} (2^26); scale it down", name)
            if total > MAX_TEXELS:
                fail("images_too_large", f"with it, the images in use have more than {MAX_TEXELS} (2^28) texels; scale them down", name)
        images = tuple(Image(name, decode_picture(data, SceneError, "gltf.bad_image", name)) for name, data in encoded)
        sets = self.sets()
        return tuple(replace(t, uv_set=sets.index(t.uv_set)) for t in self._used), images

    def _bytes(self, image: Fields) -> bytes:
        if "uri" in image:
            return self._document.resources.get(image.text("uri"), image.place("uri"))
        kind = image.text("mimeType")
        if kind not in TYPES:
            fail("unsupported_image", f"an image of type {quoted(kind)}; convert it to PNG or JPEG", image.place("mimeType"))
        return self._accessors.view_bytes(image.value["bufferView"])


def _check_image(f: Fields, accessors: Accessors) -> None:
    view = f.index("bufferView", accessors.views, "bufferViews")
    if (view is None) == ("uri" not in f):
        fail("bad_texture", "must have either a uri or a bufferView", f.where)
    if "uri" in f:
        f.text("uri")
    if view is not None or "mimeType" in f:
        f.text("mimeType")


def _sampler(f: Fields) -> tuple[tuple[int, int], bool]:
    """Wrap modes along u and v, and whether magnified texels stay sharp."""

    def choice(key: str, allowed: tuple[int, ...], default: int) -> int:
        value = f.integer(key, default=default)
        if value not in allowed:
            fail("out_of_range", f"is {value}, must be one of {', '.join(map(str, allowed))}", f.place(key))
        return value

    wrap = WRAPS[choice("wrapS", tuple(WRAPS), 10497)], WRAPS[choice("wrapT", tuple(WRAPS), 10497)]
    choice("minFilter", MIN_FILTERS, LINEAR)
    return wrap, choice("magFilter", (NEAREST, LINEAR), LINEAR) == NEAREST


def _name(f: Fields) -> str:
    """An image's place and, where it has one, its name or file."""
    name = f.text("name", "") or (f.text("uri") if "uri" in f and not f.text("uri").startswith("data:") else "")
    return f"image {quoted(name)} ({f.where})" if name else f.where
