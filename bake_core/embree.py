"""The one module that touches libembree: acceleration structures, and ray queries that numba kernels call.

embreex ships the whole of Embree 4 but calls it one ray at a time from Python. Its library is loaded here by ctypes, and the two
queries are made known to LLVM by name, so that kernels call them at native speed, without the GIL, and can be cached on disk.
"""

from __future__ import annotations

import ctypes
import importlib.metadata
import platform
import weakref
from functools import cache
from pathlib import Path
from typing import NamedTuple

import llvmlite.binding
import numpy as np
from numba import types
from numpy.typing import NDArray

from bake_core.errors import BakeError, MachineError
from bake_core.kernels import kernel
from bake_core.scene import Scene

# RTCRayHit of Embree 4.4 as embreex builds it (RTC_MAX_INSTANCE_LEVEL_COUNT 1, instPrimID compiled in), in 4-byte words:
#  0-2 origin, 3 tnear, 4-6 direction, 7 time, 8 tfar, 9 mask, 10 id, 11 flags, 12-14 Ng, 15-16 u v, 17 primID, 18 geomID, 19 instID, 20
#  instPrimID; 21-23 fill the structure up. Embree leaves them alone, so the number of rays is counted in the last two.
RAYHIT_WORDS = 24
_COUNT_LOW, _COUNT_HIGH = 22, 23
# Rays are 16-byte aligned; a cache line keeps a ray from straddling two. A packet needs it.
RAYHIT_ALIGNMENT = 64
# RTCRayHit16: the same words, but for the last three, of so many rays side by side.
LANES = 16
_PACKET_WORDS = 21
# What a hit leaves behind: its distance, u and v, and which triangle of which item it is.
_HIT_WORDS = (8, 15, 16, 17, 18, 19)

_TRIANGLE, _INSTANCE = 0, 121
_BUFFER_INDEX, _BUFFER_VERTEX = 0, 1
_UINT3, _FLOAT3, _FLOAT3X4_ROW_MAJOR = 0x5003, 0x9003, 0x9134
# Watertight. Without it rays slip between triangles that share an edge (28 of 50 million inside a closed box of 49,152 triangles, against
# none), and a sealed room is no longer dark.
_SCENE_ROBUST = 1 << 2
_QUALITY_MEDIUM = 1
# RTCIntersectArguments begins with flags and a mask of features (all of them); after them come four pointers to nothing. Rays that start in
# one point and part little are followed together; without the flag Embree follows each one by itself as soon as they part.
_COHERENT = (1 << 16, 0xFFFFFFFF)
_ARGUMENT_WORDS = 10

_query = types.void(types.uintp, types.uintp, types.uintp)
# (scene, RTCRayHit*, NULL): nearest hit. Kernels must be called through a Geometry, which registers the names first.
intersect1 = types.ExternalFunction("rtcIntersect1", _query)
# (int[16], scene, RTCRayHit16*, RTCIntersectArguments*): nearest hits of the rays of a packet for which the first is -1.
_intersect16 = types.ExternalFunction("rtcIntersect16", types.void(types.uintp, types.uintp, types.uintp, types.uintp))
# (scene, RTCRay*, NULL): any hit; tfar becomes -inf where something is in the way.
occluded1 = types.ExternalFunction("rtcOccluded1", _query)


@cache
def _library() -> ctypes.CDLL:
    """libembree4 of the installed embreex, its signatures declared and its queries registered with LLVM."""
    # Not loaded globally: its TBB would then stand in for numba's.
    try:
        files = importlib.metadata.files("embreex") or []
    except importlib.metadata.PackageNotFoundError:
        files = []
    paths = [Path(str(f.locate())) for f in files if f.name.startswith("libembree4")]
    if not paths:
        raise MachineError("machine.no_embree", "embreex and its libembree4 are not installed; run `make setup`")
    # embreex's own module pulls in libtbb, which libembree4 finds by its RPATH.
    lib = ctypes.CDLL(str(paths[0]))
    p, u, z = ctypes.c_void_p, ctypes.c_uint, ctypes.c_size_t
    for name, result, arguments in (
        ("rtcNewDevice", p, [ctypes.c_char_p]),
        ("rtcReleaseDevice", None, [p]),
        ("rtcGetDeviceError", ctypes.c_int, [p]),
        ("rtcNewScene", p, [p]),
        ("rtcReleaseScene", None, [p]),
        ("rtcSetSceneFlags", None, [p, u]),
        ("rtcSetSceneBuildQuality", None, [p, u]),
        ("rtcCommitScene", None, [p]),
        ("rtcNewGeometry", p, [p, u]),
        ("rtcReleaseGeometry", None, [p]),
        ("rtcSetSharedGeometryBuffer", None, [p, u, u, u, p, z, z, z]),
        ("rtcSetGeometryInstancedScene", None, [p, p]),
        ("rtcSetGeometryTransform", None, [p, u, u, p]),
        ("rtcCommitGeometry", None, [p]),
        ("rtcAttachGeometryByID", None, [p, p, u]),
    ):
        function = getattr(lib, name)
        function.restype, function.argtypes = result, arguments
    for name in ("rtcIntersect1", "rtcIntersect16", "rtcOccluded1"):
        llvmlite.binding.add_symbol(name, ctypes.cast(getattr(lib, name), p).value)
    return lib


@cache
def instruction_set() -> str:
    """What bits may depend on: the processor features that LLVM and Embree choose code by.

    Returns
    -------
    str
        ``x86_64-avx512``, ``x86_64-avx2`` or ``x86_64``.
    """
    features = llvmlite.binding.get_host_cpu_features()
    level = "-avx512" if features.get("avx512f") and features.get("avx512vl") else "-avx2" if features.get("avx2") else ""
    return platform.machine() + level


def new_rayhit() -> NDArray[np.float32]:
    """An aligned RTCRayHit to be filled by a kernel: (24,) float32."""
    return _aligned(RAYHIT_WORDS).view(np.float32)


class Packet(NamedTuple):
    """Rays that a kernel asks for together.

    Attributes
    ----------
    rays : (_PACKET_WORDS, LANES) float32, and the same as uint32
        An aligned RTCRayHit16.
    valid : (LANES,) int32
        -1 for the rays that there are, else 0.
    arguments : (_ARGUMENT_WORDS,) uint32
        RTCIntersectArguments.
    """

    rays: NDArray[np.float32]
    bits: NDArray[np.uint32]
    valid: NDArray[np.int32]
    arguments: NDArray[np.uint32]


def new_packet() -> Packet:
    """A packet to be filled by a kernel with rays that stay together."""
    bits, arguments = _aligned(_PACKET_WORDS * LANES).reshape(_PACKET_WORDS, LANES), _aligned(_ARGUMENT_WORDS)
    arguments[: len(_COHERENT)] = _COHERENT
    return Packet(bits.view(np.float32), bits, _aligned(LANES).view(np.int32), arguments)


def _aligned(words: int) -> NDArray[np.uint32]:
    raw = np.zeros(words * 4 + RAYHIT_ALIGNMENT, np.uint8)
    start = -raw.ctypes.data % RAYHIT_ALIGNMENT
    return raw[start : start + words * 4].view(np.uint32)


def rays_traced(ray: NDArray[np.float32]) -> int:
    """How many rays have gone out of this RTCRayHit since it was new; each was filled by :func:`set_ray`."""
    words = ray.view(np.uint32)
    return int(words[_COUNT_LOW]) + (int(words[_COUNT_HIGH]) << 32)


@kernel
def set_ray(ray, ray_bits, ox, oy, oz, dx, dy, dz, tfar):  # type: ignore[no-untyped-def]
    """Fill a ray for either query, and count it; `ray_bits` is the same memory seen as uint32."""
    ray[0], ray[1], ray[2], ray[3] = ox, oy, oz, np.float32(0)
    ray[4], ray[5], ray[6], ray[7] = dx, dy, dz, np.float32(0)
    ray[8] = tfar
    ray_bits[9] = np.uint32(0xFFFFFFFF)
    ray_bits[10] = np.uint32(0)
    ray_bits[11] = np.uint32(0)
    ray_bits[18] = np.uint32(0xFFFFFFFF)
    ray_bits[19] = np.uint32(0xFFFFFFFF)
    ray_bits[_COUNT_LOW] += np.uint32(1)
    if ray_bits[_COUNT_LOW] == 0:
        ray_bits[_COUNT_HIGH] += np.uint32(1)


@kernel
def set_lane(packet, lane, ox, oy, oz, dx, dy, dz):  # type: ignore[no-untyped-def]
    """Fill one ray of a packet, without an end; it is counted when it is taken out."""
    rays, bits = packet.rays, packet.bits
    rays[0, lane], rays[1, lane], rays[2, lane], rays[3, lane] = ox, oy, oz, np.float32(0)
    rays[4, lane], rays[5, lane], rays[6, lane], rays[7, lane] = dx, dy, dz, np.float32(0)
    rays[8, lane] = np.float32(np.inf)
    bits[9, lane] = np.uint32(0xFFFFFFFF)
    bits[10, lane] = bits[11, lane] = np.uint32(0)
    bits[18, lane] = bits[19, lane] = np.uint32(0xFFFFFFFF)
    packet.valid[lane] = -1


@kernel
def intersect_packet(handle, packet):  # type: ignore[no-untyped-def]
    """Nearest hits of the rays that a packet has."""
    _intersect16(packet.valid.ctypes.data, handle, packet.rays.ctypes.data, packet.arguments.ctypes.data)


@kernel
def take_lane(packet, lane, ray, ray_bits):  # type: ignore[no-untyped-def]
    """A ray and its hit out of a packet, as if it had been asked for alone."""
    rays = packet.rays
    set_ray(ray, ray_bits, rays[0, lane], rays[1, lane], rays[2, lane], rays[4, lane], rays[5, lane], rays[6, lane], rays[8, lane])
    for word in _HIT_WORDS:
        ray_bits[word] = packet.bits[word, lane]
    packet.valid[lane] = 0


class Geometry:
    """A scene's acceleration structure.

    A hit's item is its instID where that is valid, else its geomID: item 0 is mesh 0, item 1 + i is instance i.

    Parameters
    ----------
    scene : Scene

    Attributes
    ----------
    handle : int
        What kernels pass to :data:`intersect1` and :data:`occluded1`; valid as long as this object lives.

    Raises
    ------
    BakeError
        ``bake.embree`` where Embree reports an error (out of memory, as a rule).
    """

    handle: int

    def __init__(self, scene: Scene) -> None:
        lib = _library()
        device = lib.rtcNewDevice(None)
        if not device:
            raise BakeError("bake.embree", f"Embree gives no device (error {lib.rtcGetDeviceError(None)})")
        # Embree reads 16 bytes at a vertex, so the last one needs room behind it.
        self._vertices = np.concatenate([scene.positions.ravel(), np.zeros(4, np.float32)])
        self._indices = np.ascontiguousarray(scene.indices)
        first = scene.mesh_first_triangle
        scenes = [self._new_scene(lib, device) for _ in range(len(first) - 1)]
        for mesh, handle in enumerate(scenes):
            if first[mesh + 1] > first[mesh]:
                self._attach_triangles(lib, device, handle, int(first[mesh]), int(first[mesh + 1]), len(scene.positions))
            if mesh:
                lib.rtcCommitScene(handle)
        for i, (mesh, transform) in enumerate(zip(scene.instance_mesh, scene.instance_transform, strict=True)):
            self._attach_instance(lib, device, scenes[0], scenes[mesh], transform, 1 + i)
        lib.rtcCommitScene(scenes[0])
        self.handle = scenes[0]
        weakref.finalize(self, _release, lib, device, scenes)
        error = lib.rtcGetDeviceError(device)
        if error:
            raise BakeError("bake.embree", f"Embree failed to build the acceleration structure (error {error})")

    @staticmethod
    def _new_scene(lib: ctypes.CDLL, device: int) -> int:
        handle: int = lib.rtcNewScene(device)
        lib.rtcSetSceneFlags(handle, _SCENE_ROBUST)
        lib.rtcSetSceneBuildQuality(handle, _QUALITY_MEDIUM)
        return handle

    def _attach_triangles(self, lib: ctypes.CDLL, device: int, scene: int, first: int, end: int, vertices: int) -> None:
        geometry = lib.rtcNewGeometry(device, _TRIANGLE)
        lib.rtcSetSharedGeometryBuffer(geometry, _BUFFER_VERTEX, 0, _FLOAT3, self._vertices.ctypes.data, 0, 12, vertices)
        lib.rtcSetSharedGeometryBuffer(geometry, _BUFFER_INDEX, 0, _UINT3, self._indices.ctypes.data, 12 * first, 12, end - first)
        lib.rtcCommitGeometry(geometry)
        lib.rtcAttachGeometryByID(scene, geometry, 0)
        lib.rtcReleaseGeometry(geometry)

    @staticmethod
    def _attach_instance(lib: ctypes.CDLL, device: int, scene: int, prototype: int, transform: NDArray[np.float64], item: int) -> None:
        geometry = lib.rtcNewGeometry(device, _INSTANCE)
        lib.rtcSetGeometryInstancedScene(geometry, prototype)
        rows = np.ascontiguousarray(transform, np.float32)
        lib.rtcSetGeometryTransform(geometry, 0, _FLOAT3X4_ROW_MAJOR, rows.ctypes.data)
        lib.rtcCommitGeometry(geometry)
        lib.rtcAttachGeometryByID(scene, geometry, item)
        lib.rtcReleaseGeometry(geometry)


def _release(lib: ctypes.CDLL, device: int, scenes: list[int]) -> None:
    for handle in scenes:
        lib.rtcReleaseScene(handle)
    lib.rtcReleaseDevice(device)
