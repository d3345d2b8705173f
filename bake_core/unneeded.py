"""What kernels do without in a scene, and why: code that is not compiled in (None for a table), or is never entered."""

from __future__ import annotations

from bake_core.light_tree import FEWEST_EMITTERS
from bake_core.selection import LeftOut
from bake_core.tracer import Tables


def unneeded(tables: Tables, *, sealed: bool = False) -> tuple[LeftOut, ...]:
    """All that tracing a scene needs no code for, in the order in which a path would come to it.

    Compiled out are textures, gloss, skies and a light tree, each of which makes a path slower by being there; the rest is one test of a
    length that never changes, and costs nothing that can be measured (docs/method.md says how that was found).

    Parameters
    ----------
    sealed : bool
        Whether there is an environment that the tables do without, for no light of it gets to any probe.
    """
    t = tables
    found = []
    if t.textures is None:
        found.append(("code for textures", "no material has a texture, is cut out, blended or unlit: none of its code is compiled in"))
    elif not len(t.textures.alpha_mode):
        found.append(("code for alpha test", "every material in use is opaque: shadow rays ask whether anything is hit, not what"))
    if t.gloss is None:
        found.append(
            ("code for gloss", "every material in use has metallic 0 and roughness 1, which is exactly Lambert: no GGX is compiled in")
        )
    if t.sky is None and not sealed:
        found.append(
            (
                "code for sky sampling",
                "the environment is one colour, for which cosine sampling is ideal: no search of an image is compiled in",
            )
        )
    if sealed:
        why = "it is sealed off: every probe stands inside an opaque surface without a gap"
        found += [("code for sky sampling", why), ("code for environment", why)]
    elif t.sky is None and not t.environment.any():
        found.append(("code for environment", "it is black: a path's last ray is not traced where nothing is emissive"))
    if not len(t.emitters.cdf):
        found.append(("code for emitter sampling", "no triangle is emissive: no ray is sent to one"))
    elif t.tree is None:
        why = f"fewer than {FEWEST_EMITTERS} triangles are emissive: their power alone chooses, and no tree over them is compiled in"
        found.append(("code for light tree", why))
    if not len(t.lights.cdf):
        found.append(("code for light sampling", "neither scene nor spec has a punctual or directional light: no ray is sent to one"))
    if len(t.item_first_triangle) == 1:
        found.append(("code for instances", "every mesh stands in one place: hits are taken as they are"))
    if not len(t.normals):
        found.append(("code for vertex normals", "no mesh has any: triangles are flat"))
    if not len(t.colors):
        found.append(("code for vertex colours", "no mesh has any"))
    return tuple(LeftOut(what, why) for what, why in found)
