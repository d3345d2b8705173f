"""Light through a wall of 2 cm: two sealed rooms of 4 × 3 × 4 m beside each other, probes 1 m apart, one of them lit; at three scales."""

from __future__ import annotations

from bake_core.examples import two_rooms
from bake_core.irradiance import sample
from bake_core.leaks import COUNT, leak_ratio
from bake_core.stability.case import Baker, Case, Result, at_most, samples

# What may leak: a fifth of a per cent is nine stops below the lit room.
MOST = 0.002


def _leak(scale: float) -> Case:
    def run(baker: Baker) -> Result:
        bundle = baker(two_rooms(scale=scale), stop=samples(16))
        found = leak_ratio(lambda positions, normals: sample(bundle.volumes, positions, normals).irradiance, scale)
        side = bundle.volumes[0].atlases["walls"].interior
        note = f"irradiance at {COUNT} points of the dark room within a spacing of the wall, over as many mirrored ones; {side}² maps"
        return at_most(MOST, found, note)

    return Case(f"light through a wall of {0.02 * scale:g} m", run)


CASES = tuple(_leak(scale) for scale in (1.0, 1e-3, 1e4))
