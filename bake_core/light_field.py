"""Tracing rays through what probes saw: the numpy twin of ``shaders/trace.glsl``, compiled by numba.

McGuire, Mara, Nowrouzezahrai and Luebke 2017, "Real-Time Global Illumination using Precomputed Light Field Probes", march a ray through the
octahedral distance maps of the probes around it. Here, too; what differs is what a probe may answer. Its map knows one point of a surface,
and the plane of that surface, through each texel's centre. Between four centres (a *cell*) three things can be told:

- all four planes are farther than the ray: there is nothing, the ray goes on;
- the four points are one surface, flat, hollow or bulging: it is cut by the ray or it is not;
- they are not one surface: where one ends and what is behind it, no plane can say. A ray that goes behind any of them is lost to this
  probe, and so is one that enters a cell behind its surface.

A ray that is lost is UNKNOWN from there on, and free up to there: the next probe takes it up where the last one lost it. Every function
mirrors the GLSL function of the same name. Texels are the bundle's float32, all else is float64.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from bake_core.bundle import Atlas, VolumeData
from bake_core.chains import chain_places
from bake_core.gloss_levels import gloss_alphas, gloss_levels
from bake_core.irradiance import bilinear, sample
from bake_core.kernels import entry_kernel, kernel
from bake_core.nearest import nearest_levels
from bake_core.octahedral import dir_to_oct
from bake_core.shader_constants import FAR
from bake_core.volume_chains import tiles_of

F32 = NDArray[np.float32]
F64 = NDArray[np.float64]
I64 = NDArray[np.int64]

UNKNOWN, HIT, MISS = 0, 1, 2

# Of a texel's footprint: less than this apart across a surface, two texels are on one surface, and a ray is on it rather than behind it.
# A map places a surface no better: half a texel is how far its centre lies from where else in the texel a ray may go.
TOLERANCE = 0.5
# Of a cell's diagonal: a ray that starts on a probe has no direction from there. Nothing but the probe itself is so near to it.
_START = 2.0**-20
# Of a cell's diagonal and the way behind: a probe that takes a ray less far has only rounded it otherwise, and would answer for others.
PROGRESS = 2.0**-12
# The corners of a cell by how many sides lie between them and the nearest one, three bits each.
_ORDER = 0x76534210


class Field(NamedTuple):
    """A bundle's maps as kernels read them; volumes and tiles one after another.

    Attributes
    ----------
    origins, spacings : (v, 3) float64
        Metres, world.
    counts : (v, 3) int64
    first : (v,) int64
        Each volume's first probe.
    tiles : (p,) int64
        Each probe's tile; -1: none.
    positions : (p, 3) float64
        Where probes stand.
    distance : (t, n + 2, n + 2) float32
    normal : (t, m + 2, m + 2, 3) float32
    nearest : (t, height, width) float32
        Chains of :func:`bake_core.nearest.nearest_levels`.
    places : (k, 2) int64
        Where each level begins in a chain's tile.
    miss : float64
    rounds : int64
        Most cells that a ray crosses.
    """

    origins: F64
    spacings: F64
    counts: I64
    first: I64
    tiles: I64
    positions: F64
    distance: F32
    normal: F32
    nearest: F32
    places: I64
    miss: float
    rounds: int


@dataclass(frozen=True)
class Traces:
    """What became of n rays.

    Attributes
    ----------
    verdict : (n,) int64
        HIT, MISS or UNKNOWN.
    distance : (n,) float64
        Metres along the ray: to the hit; up to where it is known to be free where the verdict is UNKNOWN; inf for a miss.
    normal : (n, 3) float64
        Of the surface that is hit; zeros where none is.
    volume, probe : (n,) int64
        Who answered, and its flat index in its volume; who followed an UNKNOWN one farthest, -1 where nobody could follow it at all.
    probes : (n,) int64
        How many were asked.
    """

    verdict: I64
    distance: F64
    normal: F64
    volume: I64
    probe: I64
    probes: I64


def light_field(volumes: Sequence[VolumeData]) -> Field:
    """What rays are traced through.

    Parameters
    ----------
    volumes : sequence of VolumeData
        A bundle's, for which :func:`bake_core.volume_chains.traceable` is true: all of its maps of one output have one resolution.
    """
    miss = min(volumes[0].atlases["distance"].miss, FAR)
    counts = [int((v.states == 1).sum()) for v in volumes]
    distance = np.concatenate([tiles_of(v.atlases["distance"], n)[..., 0] for v, n in zip(volumes, counts, strict=True)])
    normal = np.concatenate([tiles_of(v.atlases["normal"], n) for v, n in zip(volumes, counts, strict=True)])
    levels = nearest_levels(distance, normal, miss)
    places, (width, height) = chain_places([level.shape[1] for level in levels])
    nearest = np.zeros((len(distance), height, width), np.float32)
    for (x, y), level in zip(places, levels, strict=True):
        nearest[:, y : y + level.shape[1], x : x + level.shape[1]] = level[..., 0]
    offsets = np.cumsum([0, *counts[:-1]])
    return Field(
        origins=np.array([v.origin for v in volumes]),
        spacings=np.array([v.spacing for v in volumes]),
        counts=np.array([v.counts for v in volumes]),
        first=np.cumsum([0] + [len(v.states) for v in volumes[:-1]]),
        tiles=np.concatenate([np.where(v.tiles >= 0, v.tiles + offset, -1) for v, offset in zip(volumes, offsets, strict=True)]),
        positions=np.concatenate([v.positions() for v in volumes]),
        distance=distance,
        normal=normal,
        nearest=nearest,
        places=np.array(places),
        miss=miss,
        rounds=sum(int(v.counts.sum()) for v in volumes),
    )


def trace(field: Field, origins: ArrayLike, directions: ArrayLike) -> Traces:
    """Trace rays. Mirrors ``obTrace``.

    Parameters
    ----------
    field : Field
    origins : (n, 3) float
        World, metres; in the open, or on a surface that the ray leaves.
    directions : (n, 3) float
        Unit.
    """
    o, d = (np.ascontiguousarray(np.asarray(x, np.float64).reshape(-1, 3)) for x in (origins, directions))
    n = len(o)
    whole, real = np.zeros((n, 4), np.int64), np.zeros((n, 4))
    _trace_kernel(field, o, d, whole, real)
    return Traces(whole[:, 0], real[:, 0], real[:, 1:], whole[:, 1], whole[:, 2], whole[:, 3])


@entry_kernel
def _trace_kernel(field, origins, directions, whole, real):  # type: ignore[no-untyped-def]
    for i in range(origins.shape[0]):
        o, d = origins[i], directions[i]
        verdict, t, normal, volume, probe, asked = trace_ray(field, o[0], o[1], o[2], d[0], d[1], d[2])
        whole[i, 0], whole[i, 1], whole[i, 2], whole[i, 3] = verdict, volume, probe, asked
        real[i, 0], real[i, 1], real[i, 2], real[i, 3] = t, normal[0], normal[1], normal[2]


@kernel
def _select_volume(field, x, y, z):  # type: ignore[no-untyped-def]
    """Mirrors ``obSelectVolume``."""
    nearest, least = 0, np.inf
    for v in range(field.counts.shape[0]):
        total = 0.0
        for axis, p in enumerate((x, y, z)):
            spacing, count = field.spacings[v, axis], field.counts[v, axis]
            margin = 0.5 * spacing if count == 1 else 0.0
            along = p - field.origins[v, axis]
            over = max(max(-margin - along, along - (count - 1) * spacing - margin), 0.0)
            total += over * over
        if total < least:
            nearest, least = v, total
    return nearest


@kernel
def trace_ray(field, ox, oy, oz, dx, dy, dz):  # type: ignore[no-untyped-def]
    """Mirrors ``obTrace``: verdict, distance, normal, volume, probe, how many probes were asked."""
    t = 0.0
    last_v, last_probe = -1, -1
    asked = 0
    rounds = 0
    while True:
        x, y, z = ox + t * dx, oy + t * dy, oz + t * dz
        v = _select_volume(field, x, y, z)
        nx, ny, nz = field.counts[v, 0], field.counts[v, 1], field.counts[v, 2]
        gx = min(max((x - field.origins[v, 0]) / field.spacings[v, 0], 0.0), nx - 1.0)
        gy = min(max((y - field.origins[v, 1]) / field.spacings[v, 1], 0.0), ny - 1.0)
        gz = min(max((z - field.origins[v, 2]) / field.spacings[v, 2], 0.0), nz - 1.0)
        bx, by, bz = min(int(gx), max(nx - 2, 0)), min(int(gy), max(ny - 2, 0)), min(int(gz), max(nz - 2, 0))
        near = (1 if gx - bx > 0.5 else 0) + (2 if gy - by > 0.5 else 0) + (4 if gz - bz > 0.5 else 0)
        sx, sy, sz = field.spacings[v, 0], field.spacings[v, 1], field.spacings[v, 2]
        scale = math.sqrt(sx * sx + sy * sy + sz * sz)
        before = t
        for k in range(8):
            corner = near ^ (_ORDER >> (4 * k) & 7)
            px, py, pz = bx + (corner & 1), by + (corner >> 1 & 1), bz + (corner >> 2)
            if px >= nx or py >= ny or pz >= nz:
                continue
            probe = px + nx * (py + ny * pz)
            flat = field.first[v] + probe
            tile = field.tiles[flat]
            if tile < 0:
                continue
            asked += 1
            c = field.positions[flat]
            verdict, end, normal = _trace_probe(field, tile, scale, (ox - c[0], oy - c[1], oz - c[2]), (dx, dy, dz), t)
            if verdict != UNKNOWN:
                return verdict, end, normal, v, probe, asked
            if end > t + PROGRESS * (t + scale):
                t, last_v, last_probe = end, v, probe
        rounds += 1
        # A ray crosses no more cells than so many; one that no probe of its cell takes any farther is lost.
        if not t > before or rounds == field.rounds:
            return UNKNOWN, t, (0.0, 0.0, 0.0), last_v, last_probe, asked


@kernel
def _trace_probe(field, tile, scale, q, d, t0):  # type: ignore[no-untyped-def]
    """Mirrors ``obTraceProbe``: verdict, distance, normal. `q` is the ray's origin as seen from the probe.

    The ray is (1 - s) q + s e, s from 0 to 1, with e = d times `scale`; the point stands (1 - s) times as far away as it says, so that
    s = 1 is the direction d itself, and whatever is linear along the ray is linear in s.
    """
    ex, ey, ez = scale * d[0], scale * d[1], scale * d[2]
    qx, qy, qz = q
    n = field.distance.shape[1] - 2
    top = field.places.shape[0]
    begins = t0 <= 0
    a = max(t0 / (t0 + scale), _START)
    level = 0
    # An octant at a time: there the map takes the ray to a straight line.
    for _ in range(4):
        b = 1.0
        if qx * ex < 0 and qx / (qx - ex) > a:
            b = min(b, qx / (qx - ex))
        if qy * ey < 0 and qy / (qy - ey) > a:
            b = min(b, qy / (qy - ey))
        if qz * ez < 0 and qz / (qz - ez) > a:
            b = min(b, qz / (qz - ez))
        s = 0.5 * (a + b)
        hx = 1.0 if (1 - s) * qx + s * ex >= 0 else -1.0
        hy = 1.0 if (1 - s) * qy + s * ey >= 0 else -1.0
        hz = 1.0 if (1 - s) * qz + s * ez >= 0 else -1.0
        # Coordinates in the square are ratios of what is linear: u / l and v / l.
        lq, le = hx * qx + hy * qy + hz * qz, hx * ex + hy * ey + hz * ez
        fold = 0.0 if hz > 0 else 1.0
        uq, ue = qx - fold * hx * qz, ex - fold * hx * ez
        vq, ve = qy - fold * hy * qz, ey - fold * hy * ez
        turn_u, turn_v = ue * lq - uq * le, ve * lq - vq * le
        i = _first_cell(_cell(uq, ue, lq, le, a, n), _cell(uq, ue, lq, le, s, n), turn_u)
        j = _first_cell(_cell(vq, ve, lq, le, a, n), _cell(vq, ve, lq, le, s, n), turn_v)
        for _ in range(8 * (n + 2)):
            block_i, block_j = i >> level, j >> level
            edge_i = (block_i + (1 if turn_u > 0 else 0)) << level
            edge_j = (block_j + (1 if turn_v > 0 else 0)) << level
            cross_i = _crossing(uq, ue, lq, le, edge_i, n, b, turn_u)
            cross_j = _crossing(vq, ve, lq, le, edge_j, n, b, turn_v)
            end = max(min(min(cross_i, cross_j), b), a)
            if level > 0:
                x, y = field.places[level - 1, 0] + block_i, field.places[level - 1, 1] + block_j
                nearest = np.float64(field.nearest[tile, y, x])
                passed = _nearer(q, (ex, ey, ez), a, nearest) and _nearer(q, (ex, ey, ez), end, nearest)
                if nearest < field.miss and not passed:
                    level -= 1
                    continue
            else:
                verdict, at, normal = _trace_cell(field, tile, i, j, q, (ex, ey, ez), a, end, begins)
                if verdict == HIT:
                    return HIT, at * scale, normal
                if verdict == UNKNOWN:
                    # Lost where it begins, it has not come any farther.
                    return UNKNOWN, 0.0 if begins and at <= a else scale * at / (1 - at), normal
            begins = False
            if end >= b:
                break
            low_i, low_j = block_i << level, block_j << level
            last = (1 << level) - 1
            a = end
            if cross_i <= cross_j:
                i = edge_i if turn_u > 0 else edge_i - 1
                j = min(max(_cell(vq, ve, lq, le, a, n), low_j), low_j + last)
            else:
                j = edge_j if turn_v > 0 else edge_j - 1
                i = min(max(_cell(uq, ue, lq, le, a, n), low_i), low_i + last)
            i, j = min(max(i, 0), n), min(max(j, 0), n)
            level = min(level + 1, top)
        if b >= 1:
            return MISS, np.inf, (0.0, 0.0, 0.0)
        a = b
    return MISS, np.inf, (0.0, 0.0, 0.0)


@kernel
def _cell(q, e, lq, le, s, n):  # type: ignore[no-untyped-def]
    """Mirrors ``obCellAlong``: the cell in which a coordinate of the square lies."""
    length = (1 - s) * lq + s * le
    ratio = ((1 - s) * q + s * e) / length if length > 0 else 0.0
    return min(max(int((ratio * 0.5 + 0.5) * n + 0.5), 0), n)


@kernel
def _first_cell(at_start, halfway, turn):  # type: ignore[no-untyped-def]
    """Mirrors ``obFirstCell``: a ray that comes out of the probe itself has any direction there, but none that it turns back from."""
    return min(at_start, halfway) if turn > 0 else max(at_start, halfway) if turn < 0 else halfway


@kernel
def _crossing(q, e, lq, le, edge, n, b, turn):  # type: ignore[no-untyped-def]
    """Mirrors ``obCrossing``: where along the ray a coordinate of the square meets the lower edge of cell `edge`; 2 where not before b."""
    c = (2.0 * edge - n - 1.0) / n
    at_q, at_e = q - c * lq, e - c * le
    # A ratio has a pole, and meets the edge behind that, too: ask on which side it ends.
    return at_q / (at_q - at_e) if at_q != at_e and ((1 - b) * at_q + b * at_e) * turn > 0 else 2.0


@kernel
def _nearer(q, e, s, distance):  # type: ignore[no-untyped-def]
    """Mirrors ``obNearer``: whether the ray's point at s is nearer to the probe than a distance."""
    x, y, z = (1 - s) * q[0] + s * e[0], (1 - s) * q[1] + s * e[1], (1 - s) * q[2] + s * e[2]
    return x * x + y * y + z * z < (1 - s) * (1 - s) * distance * distance


@kernel
def _texel(field, tile, x, y):  # type: ignore[no-untyped-def]
    """Mirrors ``obTexel``: a texel's distance, its direction and its normal; texel (0, 0) is the border's."""
    n, m = field.distance.shape[1] - 2, field.normal.shape[1] - 2
    u, v = (2.0 * x - n - 1.0) / n, (2.0 * y - n - 1.0) / n
    if abs(u) > 1:
        u, v = (2.0 if u > 0 else -2.0) - u, -v
    if abs(v) > 1:
        u, v = -u, (2.0 if v > 0 else -2.0) - v
    wz = 1 - abs(u) - abs(v)
    t = max(-wz, 0.0)
    wx, wy = u + (-t if u >= 0 else t), v + (-t if v >= 0 else t)
    length = math.sqrt(wx * wx + wy * wy + wz * wz)
    nx = 0 if x == 0 else m + 1 if x == n + 1 else (2 * x - 1) * m // (2 * n) + 1
    ny = 0 if y == 0 else m + 1 if y == n + 1 else (2 * y - 1) * m // (2 * n) + 1
    normal = field.normal[tile, ny, nx]
    return (
        np.float64(field.distance[tile, y, x]),
        (wx / length, wy / length, wz / length),
        (np.float64(normal[0]), np.float64(normal[1]), np.float64(normal[2])),
    )


@kernel
def _height(normal, offset, x, y, z, weight):  # type: ignore[no-untyped-def]
    """Mirrors ``obHeight``: how high a point, `weight` times as far away as it says, stands above a plane; the probe stands at `offset`."""
    return normal[0] * x + normal[1] * y + normal[2] * z + offset * weight


@kernel
def _trace_cell(field, tile, i, j, q, e, a, b, begins):  # type: ignore[no-untyped-def]
    """Mirrors ``obTraceCell``: from a to b the ray is within cell (i, j); `begins`: at a it does, else it came there through empty space.

    MISS: nothing. HIT: distance in units of `scale`, and normal. UNKNOWN: the place along the ray up to which it is free.
    """
    n = field.distance.shape[1] - 2
    ax, ay, az = (1 - a) * q[0] + a * e[0], (1 - a) * q[1] + a * e[1], (1 - a) * q[2] + a * e[2]
    bx, by, bz = (1 - b) * q[0] + b * e[0], (1 - b) * q[1] + b * e[1], (1 - b) * q[2] + b * e[2]
    texel = math.sqrt(4 * math.pi) / n
    slack_a = TOLERANCE * texel * math.sqrt(ax * ax + ay * ay + az * az)
    corners = (
        _texel(field, tile, i, j),
        _texel(field, tile, i + 1, j),
        _texel(field, tile, i, j + 1),
        _texel(field, tile, i + 1, j + 1),
    )
    # When the ray goes behind the first and behind the last of the four planes, and when it comes out of one again.
    first, last, out = 2.0, -1.0, 2.0
    first_normal = last_normal = (0.0, 0.0, 0.0)
    # How high above its planes the ray enters: above the one that it is farthest behind, and above the one that it is least behind.
    lowest, highest = np.inf, -np.inf
    for distance, w, normal in corners:
        if distance >= field.miss:
            last, highest = 2.0, np.inf
            continue
        offset = distance * max(-(normal[0] * w[0] + normal[1] * w[1] + normal[2] * w[2]), 0.0)
        at_a = _height(normal, offset, ax, ay, az, 1 - a)
        at_b = _height(normal, offset, bx, by, bz, 1 - b)
        if at_b < at_a:
            crossed = a + (b - a) * at_a / (at_a - at_b)
        elif at_a < -slack_a:
            # Comes out of what it is behind: behind from before.
            crossed = -1.0
            out = min(out, a + (b - a) * at_a / (at_a - at_b) if at_b > at_a else 2.0)
        else:
            # Leaves the surface, from on it or from before it.
            crossed = 2.0
        if crossed < first:
            first, first_normal = crossed, normal
        if crossed > last:
            last, last_normal = crossed, normal
        lowest, highest = min(lowest, at_a), max(highest, at_a)
    if first > b:
        return MISS, 0.0, (0.0, 0.0, 0.0)
    hollow, bulging = _shape(field.miss, texel, corners)
    if hollow:
        enters, normal, depth = first, first_normal, lowest
    elif bulging:
        enters, normal, depth = last, last_normal, highest
        if enters > b or enters > out:
            return MISS, 0.0, (0.0, 0.0, 0.0)
    else:
        return UNKNOWN, max(first, a), (0.0, 0.0, 0.0)
    # Who comes from empty space and is a little behind the surface has just met it; who begins there may be anywhere.
    if enters < a and (begins or depth < -slack_a):
        return UNKNOWN, a, (0.0, 0.0, 0.0)
    at = max(enters, a)
    return HIT, at / (1 - at), normal


@kernel
def _shape(miss, texel, corners):  # type: ignore[no-untyped-def]
    """Mirrors ``obShape``: whether the four points are one surface that is hollow (or flat), or one that bulges.

    Hollow: none of the points is behind the plane of another; what is solid is behind any plane. Bulging: none is before the plane of
    another; what is solid is behind all of them.
    """
    hollow = bulging = True
    for distance, w, normal in corners:
        if distance >= miss:
            # Nothing is behind the sky.
            bulging = False
            continue
        offset = distance * max(-(normal[0] * w[0] + normal[1] * w[1] + normal[2] * w[2]), 0.0)
        for other, u, _ in corners:
            along = normal[0] * u[0] + normal[1] * u[1] + normal[2] * u[2]
            if other >= miss:
                # A point as far as can be: behind the plane, unless the plane never gets there.
                hollow = hollow and along >= 0
                continue
            slack = TOLERANCE * texel * min(distance, other)
            height = other * along + offset
            if height < -slack:
                hollow = False
            if height > slack:
                bulging = False
    return hollow, bulging


def arriving(volumes: Sequence[VolumeData], traces: Traces, origins: ArrayLike, directions: ArrayLike, roughness: float) -> F64:
    """Radiance along rays that have been traced. Mirrors what ``obTraceRadiance`` makes of a trace.

    Parameters
    ----------
    volumes : sequence of VolumeData
    traces : Traces
        Of the same rays.
    origins, directions : (n, 3) float
    roughness : float
        Perceptual, of the lobe that radiance is averaged over; 0: none.

    Returns
    -------
    (n, 3) float64
    """
    o, d = (np.asarray(x, np.float64).reshape(-1, 3) for x in (origins, directions))
    out = np.zeros((len(o), 3))
    lost = traces.volume < 0
    out[lost] = sample(volumes, o[lost], d[lost], d[lost], d[lost]).irradiance / math.pi
    for v, volume in enumerate(volumes):
        of = np.flatnonzero(~lost & (traces.volume == v))
        hit = traces.verdict[of] != MISS
        seen, alpha = d[of].copy(), np.full(len(of), roughness * roughness)
        far = traces.distance[of][hit]
        seen[hit] = o[of][hit] + far[:, None] * d[of][hit] - volume.positions()[traces.probe[of][hit]]
        alpha[hit] *= far / np.maximum(np.linalg.norm(seen[hit], axis=1), 1e-20)
        out[of] = _blurred(volume, volume.tiles[traces.probe[of]], dir_to_oct(seen), np.minimum(alpha, 1))
    return out


def _blurred(volume: VolumeData, tile: I64, oct_xy: NDArray[np.floating], alpha: F64) -> F64:
    """Mirrors ``obRadianceOfProbe``."""
    radiance = volume.atlases["radiance"]
    levels = [radiance]
    for texels in gloss_levels(tiles_of(radiance, int((volume.states == 1).sum()))[:, 1:-1, 1:-1]):
        side = texels.shape[1]
        levels.append(Atlas("gloss", texels, side, side - 2, 1, 1, len(texels), "float"))
    first, steps = gloss_alphas(radiance.interior)[0], len(levels) - 2
    with np.errstate(divide="ignore", invalid="ignore"):
        level = np.where(alpha <= first, alpha / first, 1 + steps * (1 - np.log(alpha) / math.log(first)) if first < 1 else 1.0)
    lower = np.clip(np.floor(level), 0, steps).astype(np.int64)
    share = np.clip(level - lower, 0, 1)[:, None]
    out = np.zeros((len(tile), 3))
    for k in range(steps + 1):
        at = lower == k
        sharper, softer = (bilinear(levels[k + i], tile[at], oct_xy[at]) for i in (0, 1))
        out[at] = sharper * (1 - share[at]) + softer * share[at]
    return out
