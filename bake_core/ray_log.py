"""Ray queries as kernels make them, and written down where the tables hold a log, so that Embree alone can be asked the same again."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from bake_core.embree import LANES, intersect1, intersect_packet, new_packet, new_rayhit, occluded1, set_lane, set_ray
from bake_core.kernels import either, entry_kernel, kernel

F32 = NDArray[np.float32]
U8 = NDArray[np.uint8]
I64 = NDArray[np.int64]

# The first ray of a packet, and the others of it, all for their nearest hits; else rays are asked for alone.
NEAREST, ANY, FIRST_OF_PACKET, OF_PACKET = 0, 1, 2, 3


class RayLog(NamedTuple):
    """Room for rays, in the order in which one thread asks.

    Attributes
    ----------
    rays : (n, 8) float32
        Origin, near end, direction, far end: the words 0 to 6 and 8 of an RTCRay before the query.
    kinds : (n,) uint8
        :data:`NEAREST`, :data:`ANY`, :data:`FIRST_OF_PACKET` or :data:`OF_PACKET`.
    found : (n,) float32
        The word 8 after it: the distance of the hit, or -inf where something is in the way; else the far end as it was.
    asked : (1,) int64
        How many were asked; what found no room was not written down.
    """

    rays: F32
    kinds: U8
    found: F32
    asked: I64


def new_log(size: int) -> RayLog:
    """An empty log with room for so many rays."""
    return RayLog(np.empty((size, 8), np.float32), np.empty(size, np.uint8), np.empty(size, np.float32), np.zeros(1, np.int64))


@kernel
def _write_down(log, ray, kind):  # type: ignore[no-untyped-def]
    """Note a ray's words before it is asked for; its place in the log, -1 where that is full."""
    i = log.asked[0]
    log.asked[0] += 1
    if i >= log.rays.shape[0]:
        return -1
    for word in range(7):
        log.rays[i, word] = ray[word]
    log.rays[i, 7] = ray[8]
    log.kinds[i] = kind
    return i


def _nearest(t, ray):  # type: ignore[no-untyped-def]
    intersect1(t.handle, ray.ctypes.data, 0)


def _nearest_logged(t, ray):  # type: ignore[no-untyped-def]
    i = _write_down(t.log, ray, NEAREST)
    intersect1(t.handle, ray.ctypes.data, 0)
    if i >= 0:
        t.log.found[i] = ray[8]


def _any(t, ray):  # type: ignore[no-untyped-def]
    occluded1(t.handle, ray.ctypes.data, 0)


def _any_logged(t, ray):  # type: ignore[no-untyped-def]
    i = _write_down(t.log, ray, ANY)
    occluded1(t.handle, ray.ctypes.data, 0)
    if i >= 0:
        t.log.found[i] = ray[8]


def _packet(t, packet):  # type: ignore[no-untyped-def]
    intersect_packet(t.handle, packet)


def _packet_logged(t, packet):  # type: ignore[no-untyped-def]
    first = -1
    for lane in range(LANES):
        if packet.valid[lane]:
            i = _write_down(t.log, packet.rays[:, lane], OF_PACKET if first >= 0 else FIRST_OF_PACKET)
            first = i if first < 0 else first
    intersect_packet(t.handle, packet)
    for lane in range(LANES):
        if packet.valid[lane] and 0 <= first < t.log.found.shape[0]:
            t.log.found[first] = packet.rays[8, lane]
            first += 1


# The nearest hits of the rays in a packet, and of the ray in an RTCRayHit that `set_ray` has filled, and whether anything is in its way.
ask_packet = either("log")(_packet_logged)(_packet)
ask_nearest = either("log")(_nearest_logged)(_nearest)
ask_any = either("log")(_any_logged)(_any)


@entry_kernel
def _replay(handle, ray, packet, rays, kinds, found):  # type: ignore[no-untyped-def]
    """Ask again; `found` is filled as the log's."""
    ray_bits = ray.view(np.uint32)
    i = 0
    while i < rays.shape[0]:
        r = rays[i]
        if kinds[i] >= FIRST_OF_PACKET:
            lanes = 0
            while lanes < LANES and i + lanes < rays.shape[0] and kinds[i + lanes] == (OF_PACKET if lanes else FIRST_OF_PACKET):
                r = rays[i + lanes]
                set_lane(packet, lanes, r[0], r[1], r[2], r[4], r[5], r[6])
                lanes += 1
            intersect_packet(handle, packet)
            for lane in range(lanes):
                found[i + lane] = packet.rays[8, lane]
                packet.valid[lane] = 0
            i += lanes
            continue
        set_ray(ray, ray_bits, r[0], r[1], r[2], r[4], r[5], r[6], r[7])
        ray[3] = r[3]
        if kinds[i] == NEAREST:
            intersect1(handle, ray.ctypes.data, 0)
        else:
            occluded1(handle, ray.ctypes.data, 0)
        found[i] = ray[8]
        i += 1
    return 0


def replay(handle: np.uint64, rays: F32, kinds: U8, *, threads: int = 1) -> F32:
    """Ask Embree for logged rays, with nothing in between: the least time that a tracer which asks them the same way can take.

    Parameters
    ----------
    handle : uint64
        ``tracer.tables.handle``.
    rays : (n, 8) float32
    kinds : (n,) uint8
    threads : int
        Each takes a run of them, of whole packets.

    Returns
    -------
    (n,) float32
        As :attr:`RayLog.found`.
    """
    found = np.empty(len(rays), np.float32)
    whole = np.append(np.flatnonzero(kinds != OF_PACKET), len(rays))
    cuts = whole[np.linspace(0, len(whole) - 1, threads + 1).astype(np.int64)]

    def some(part: int) -> None:
        among = slice(cuts[part], cuts[part + 1])
        _replay(handle, new_rayhit(), new_packet(), rays[among], kinds[among], found[among])

    with ThreadPoolExecutor(threads) as pool:
        list(pool.map(some, range(threads)))
    return found


def coherent_order(rays: F32) -> I64:
    """Rays by octant of their direction and then by the Morton code of their origin, (n,): the order that suits a tree best.

    Morton 1966, "A computer oriented geodetic data base and a new technique in file sequencing"; ten bits an axis.
    """
    low, high = rays[:, :3].min(0), rays[:, :3].max(0)
    cells = ((rays[:, :3] - low) / np.maximum(high - low, np.finfo(np.float32).tiny) * 1023).astype(np.uint64)
    code = np.zeros(len(rays), np.uint64)
    for axis in range(3):
        for bit in range(10):
            code |= (cells[:, axis] >> np.uint64(bit) & np.uint64(1)) << np.uint64(3 * bit + axis)
    octant = (rays[:, 4:7] < 0).astype(np.uint64) @ np.array([1, 2, 4], np.uint64)
    return np.asarray(np.argsort(octant << np.uint64(30) | code, kind="stable"), np.int64)
