"""Sample points: Owen-scrambled Sobol' pairs, padded over dimensions; and the warps that kernels use.

Functions here are numba kernels on scalars.
"""

from __future__ import annotations

import math

import numpy as np
from numba import uint32, uint64

from bake_core.kernels import kernel

# Path vertices beyond this many take plain random numbers: a padded low-discrepancy pair gains nothing there any more.
STRATIFIED_VERTICES = 8
_PI = np.float32(math.pi)


@kernel
def mix64(x):  # type: ignore[no-untyped-def]
    """A bijection of 64-bit words that looks random.

    Steele, Lea and Flood 2014, "Fast Splittable Pseudorandom Number Generators" (variant 13 of Stafford's mixers).
    """
    x = uint64(x)
    x = (x ^ (x >> uint64(30))) * uint64(0xBF58476D1CE4E5B9)
    x = (x ^ (x >> uint64(27))) * uint64(0x94D049BB133111EB)
    return x ^ (x >> uint64(31))


@kernel
def reverse_bits(x):  # type: ignore[no-untyped-def]
    x = uint32(x)
    x = ((x >> uint32(1)) & uint32(0x55555555)) | ((x & uint32(0x55555555)) << uint32(1))
    x = ((x >> uint32(2)) & uint32(0x33333333)) | ((x & uint32(0x33333333)) << uint32(2))
    x = ((x >> uint32(4)) & uint32(0x0F0F0F0F)) | ((x & uint32(0x0F0F0F0F)) << uint32(4))
    x = ((x >> uint32(8)) & uint32(0x00FF00FF)) | ((x & uint32(0x00FF00FF)) << uint32(8))
    return uint32((x >> uint32(16)) | (x << uint32(16)))


@kernel
def scramble_reversed(x, seed):  # type: ignore[no-untyped-def]
    """A nested uniform (Owen) scramble of a word whose bits are reversed: bit i is flipped by a hash of the bits below it.

    Laine and Karras 2011, "Stratified Sampling for Stochastic Transparency"; Burley 2020, "Practical Hash-based Owen Scrambling",
    JCGT 9(4); constants by Vegdahl 2021, whose permutations pass where the first ones show structure.
    """
    x = uint32(x)
    seed = uint32(seed)
    x = uint32(x ^ uint32(x * uint32(0x3D20ADEA)))
    x = uint32(x + seed)
    x = uint32(x * uint32((seed >> uint32(16)) | uint32(1)))
    x = uint32(x ^ uint32(x * uint32(0x05526C56)))
    return uint32(x ^ uint32(x * uint32(0x53A22864)))


@kernel
def pascal(x):  # type: ignore[no-untyped-def]
    """Bits times Pascal's triangle mod 2: the second Sobol' dimension with reversed bits.

    The matrix is the Kronecker power of [[1, 1], [0, 1]], so five shifts do it (Sobol' 1967; Joe and Kuo 2008 for the direction numbers).
    """
    x = uint32(x)
    x ^= (x >> uint32(1)) & uint32(0x55555555)
    x ^= (x >> uint32(2)) & uint32(0x33333333)
    x ^= (x >> uint32(4)) & uint32(0x0F0F0F0F)
    x ^= (x >> uint32(8)) & uint32(0x00FF00FF)
    return uint32(x ^ (x >> uint32(16)))


@kernel
def unit_float(x):  # type: ignore[no-untyped-def]
    """The upper 24 bits as a float32 in [0, 1): never 1, which a rounding of all 32 bits would give."""
    return np.float32(uint32(x) >> uint32(8)) * np.float32(2.0**-24)


@kernel
def sobol_pair(reversed_index, key):  # type: ignore[no-untyped-def]
    """One point of an Owen-scrambled (0, 2)-sequence in base 2, in shuffled order.

    Two pairs with different keys are independent, so any number of dimensions is padded from pairs (Burley 2020).

    Parameters
    ----------
    reversed_index : uint32
        Index of the point, bits reversed.
    key : uint64
        Picks shuffle and scrambles.

    Returns
    -------
    (float32, float32) in [0, 1)^2
    """
    h = mix64(key)
    i = reverse_bits(scramble_reversed(reversed_index, uint32(h)))
    x = reverse_bits(scramble_reversed(i, uint32(h >> uint64(32))))
    # The halves of h are independent; their product's upper half is a third seed at the price of one multiplication.
    y = reverse_bits(scramble_reversed(pascal(i), uint32((h * uint64(0x9E3779B97F4A7C15)) >> uint64(32))))
    return unit_float(x), unit_float(y)


@kernel
def random_pair(index, key):  # type: ignore[no-untyped-def]
    """Two plain random numbers in [0, 1), a function of (index, key)."""
    h = mix64(uint64(key) + uint64(index) * uint64(0x9E3779B97F4A7C15))
    return unit_float(uint32(h)), unit_float(uint32(h >> uint64(32)))


@kernel
def cosine_hemisphere(u, v):  # type: ignore[no-untyped-def]
    """Directions around +Z with pdf cosθ/π, by the concentric map (Shirley and Chiu 1997, "A Low Distortion Map Between Disk and Square").

    Inverse: :func:`cosine_hemisphere_inverse`. Pdf: :func:`cosine_hemisphere_pdf`.
    """
    a = np.float32(2) * u - np.float32(1)
    b = np.float32(2) * v - np.float32(1)
    if a == 0 and b == 0:
        return np.float32(0), np.float32(0), np.float32(1)
    if abs(a) > abs(b):
        r = a
        phi = (_PI / np.float32(4)) * (b / a)
    else:
        r = b
        phi = (_PI / np.float32(2)) - (_PI / np.float32(4)) * (a / b)
    x = r * np.float32(math.cos(phi))
    y = r * np.float32(math.sin(phi))
    return x, y, np.float32(math.sqrt(max(np.float32(0), np.float32(1) - r * r)))


@kernel
def cosine_hemisphere_pdf(z):  # type: ignore[no-untyped-def]
    """Per solid angle, of :func:`cosine_hemisphere`."""
    return max(z, np.float32(0)) / _PI


@kernel
def cosine_hemisphere_inverse(x, y):  # type: ignore[no-untyped-def]
    """The square's point that :func:`cosine_hemisphere` takes to (x, y, ·)."""
    r = math.sqrt(x * x + y * y)
    if r == 0:
        return 0.5, 0.5
    phi = math.atan2(y, x)
    if phi < -math.pi / 4:
        phi += 2 * math.pi
    if phi < math.pi / 4:
        a, b = r, phi * r / (math.pi / 4)
    elif phi < 3 * math.pi / 4:
        a, b = -(phi - math.pi / 2) * r / (math.pi / 4), r
    elif phi < 5 * math.pi / 4:
        a, b = -r, -(phi - math.pi) * r / (math.pi / 4)
    else:
        a, b = (phi - 3 * math.pi / 2) * r / (math.pi / 4), -r
    return (a + 1) / 2, (b + 1) / 2


@kernel
def uniform_triangle(u, v):  # type: ignore[no-untyped-def]
    """Barycentrics (of vertices 1 and 2) uniform over a triangle's area.

    Heitz 2019, "A Low-Distortion Map Between Triangle and Square": keeps neighbours together, which the square-root map does not.
    Inverse: :func:`uniform_triangle_inverse`; pdf_area is 1 over the area.
    """
    if v > u:
        b1 = u * np.float32(0.5)
        return b1, v - b1
    b2 = v * np.float32(0.5)
    return u - b2, b2


@kernel
def uniform_triangle_inverse(b1, b2):  # type: ignore[no-untyped-def]
    """The square's point that :func:`uniform_triangle` takes to (b1, b2)."""
    if b2 > b1:
        return b1 * 2, b2 + b1
    return b1 + b2, b2 * 2


@kernel
def basis(nx, ny, nz):  # type: ignore[no-untyped-def]
    """Two tangents that make a right-handed basis with a unit normal.

    Duff et al. 2017, "Building an Orthonormal Basis, Revisited", JCGT 6(1); branch-free, accurate at -Z.
    """
    sign = np.float32(math.copysign(np.float32(1), nz))
    a = np.float32(-1) / (sign + nz)
    b = nx * ny * a
    return np.float32(1) + sign * nx * nx * a, sign * b, -sign * nx, b, sign + ny * ny * a, -ny
