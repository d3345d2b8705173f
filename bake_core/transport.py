"""Unbiased path tracing: one path, from a ray to the radiance that comes back along it.

Kajiya 1986, "The Rendering Equation"; next-event estimation and multiple importance sampling after Veach 1997, "Robust Monte Carlo
Methods for Light Transport Simulation" (balance heuristic). Compiled strictly: no fastmath, so the same bits on every run.
"""

from __future__ import annotations

import math

import numpy as np
from numba import uint64

from bake_core.embree import set_ray
from bake_core.environment import environment_radiance, has_sky
from bake_core.kernels import kernel
from bake_core.light_cache import cached_light
from bake_core.light_tree import emitter_share
from bake_core.materials import INV_PI, gloss, is_glossy, lambert_cosine, no_gloss, sample_gloss, sample_lambert, scattered
from bake_core.next_event import emitter_strength, from_emitters, from_lights, from_sky, pdf_emitter
from bake_core.ray_log import ask_nearest
from bake_core.sampling import STRATIFIED_VERTICES, random_pair, sobol_pair
from bake_core.surfaces import INFINITE, INVALID, MAX_PASSED, blocked, hit_item, surface
from bake_core.textures import emission_at, lets_through, reflectance, scattered_spread, widened

# Roulette by throughput begins where a path has lost 90 % of its weight. With the chance to go on equal to throughput / τ below τ, a
# furnace of albedo a has a relative σ of τ√a from roulette: 10 % of a path here, against 100 % where τ = 1.
ROULETTE_THROUGHPUT = 0.1
# Where throughput does not fall (white walls), a path that has met no light for m > 64 vertices goes on with chance (m/(m+1))². Survival
# falls as 1/m², slower than any physical decay, so the variance stays finite; yet in a sealed dark room a path takes 128 vertices on
# average. From 16 on, a white street with narrow ways out (godot_zdm2) had 15 times the variance, at 0.7 times the cost.
ROULETTE_DARK_VERTICES = 64
# The same against light that never dies away (a sealed box of albedo 1 with an emitter in it has no finite answer): late enough that no
# path of an albedo below 0.999 gets here.
ROULETTE_LAST_VERTICES = 8192


@kernel
def sample_pair(reversed_index, index, depth, key):  # type: ignore[no-untyped-def]
    """Two sample coordinates of a path's vertex: stratified at the first vertices, plain random numbers after."""
    if depth <= STRATIFIED_VERTICES:
        return sobol_pair(reversed_index, key)
    return random_pair(index, key)


@kernel
def trace_path(t, ray, ray_bits, ox, oy, oz, dx, dy, dz, reversed_index, index, key, camera, spread, scramble):  # type: ignore[no-untyped-def]
    """One path, of whose ray nothing is known; parameters and what it returns are :func:`trace_on`'s."""
    set_ray(ray, ray_bits, ox, oy, oz, dx, dy, dz, INFINITE)
    ask_nearest(t, ray)
    return trace_on(t, ray, ray_bits, ox, oy, oz, dx, dy, dz, reversed_index, index, key, camera, spread, scramble)


@kernel
def trace_on(t, ray, ray_bits, ox, oy, oz, dx, dy, dz, reversed_index, index, key, camera, spread, scramble):  # type: ignore[no-untyped-def]
    """One path, of whose ray it is known what it meets.

    Parameters
    ----------
    t : Tables
    ray, ray_bits : (24,) float32, the same as uint32
        An aligned RTCRayHit with the ray's hit, to work in.
    ox … dz : float
        The ray, local frame; unit direction.
    reversed_index, index, key
        Sample point: its index within its scramble, with bits reversed and plain, and what picks the scramble.
    camera : bool
        Whether the ray itself passes through back faces of single-sided materials, as a rasteriser's does that culls them.
    spread : float
        Width of what the ray stands for, radians: the square root of its solid angle. Textures are averaged over it.
    scramble : int
        Whose cache to read, where there is one.

    Returns
    -------
    emitted : 3 float64
        Radiance of what the ray itself meets: an emitter, the environment.
    direct : 3 float64
        Reflected at the first surface straight from punctual and directional lights.
    indirect : 3 float64
        Reflected at the first surface, all the rest.
    hit : bool
        Whether the ray met a surface.
    light_pdf : float64
        With which density :func:`sample_emitter` or :func:`bake_core.environment.sample_sky` would have found what the ray met; 0 where
        neither could.
    """
    emitted_r = emitted_g = emitted_b = 0.0
    direct_r = direct_g = direct_b = 0.0
    indirect_r = indirect_g = indirect_b = 0.0
    # Throughput of the materials alone, and what roulette has left of survival: their quotient is the path's weight.
    beta_r = beta_g = beta_b = 1.0
    survival = 1.0
    by_throughput = 1.0
    dark = 0
    pdf = 0.0
    width = 0.0
    hit_any = False
    light_pdf = 0.0
    passed = 0
    depth = 0
    has_emitters = t.emitters.cdf.shape[0] > 0
    has_lights = t.lights.cdf.shape[0] > 0
    shines = has_sky(t) or t.environment[0] + t.environment[1] + t.environment[2] > 0
    look = no_gloss(t)
    needs_choice = t.emitters.cdf.shape[0] > 1 or t.lights.cdf.shape[0] > 1
    while True:
        if ray_bits[18] == INVALID:
            # No light is drawn from a constant environment: cosine sampling is already its importance sampling.
            radiance, sky_pdf = environment_radiance(t, dx, dy, dz)
            if depth == 0:
                emitted_r, emitted_g, emitted_b = radiance
                light_pdf = sky_pdf
            else:
                # Along the surface itself both may be 0.
                gain = pdf / (pdf + sky_pdf) if sky_pdf > 0 else 1.0
                indirect_r += beta_r / survival * (gain * radiance[0])
                indirect_g += beta_g / survival * (gain * radiance[1])
                indirect_b += beta_b / survival * (gain * radiance[2])
            break
        s = surface(t, ray_bits, ray, dx, dy, dz)
        p, n, epsilon, _, material, front, triangle, b1, b2, _ = s
        two_sided = t.materials.double_sided[material]
        behind = not front and not two_sided
        if passed < MAX_PASSED and ((behind and camera and depth == 0) or lets_through(t, material, triangle, b1, b2, ray_bits)):
            # Go on from the far side: the normal looks back at us.
            x, y, z = p[0] - epsilon * n[0], p[1] - epsilon * n[1], p[2] - epsilon * n[2]
            set_ray(ray, ray_bits, x, y, z, dx, dy, dz, INFINITE)
            ask_nearest(t, ray)
            passed += 1
            continue
        hit_any = hit_any or depth == 0
        if behind:
            break
        dark += 1
        le_r, le_g, le_b = emission_at(t, material, triangle, b1, b2, 0.0)
        hx, hy, hz = p[0] - ox, p[1] - oy, p[2] - oz
        facing = abs(dx * n[0] + dy * n[1] + dz * n[2])
        if le_r + le_g + le_b > 0:
            dark = 0
            strength = emitter_strength(t, material, triangle)
            share = emitter_share(t, hit_item(ray_bits), triangle, (ox, oy, oz))
            if depth == 0:
                emitted_r, emitted_g, emitted_b = le_r, le_g, le_b
                light_pdf = pdf_emitter(share, strength, two_sided, hx * hx + hy * hy + hz * hz, facing)
            else:
                gain = pdf / (pdf + pdf_emitter(share, strength, two_sided, hx * hx + hy * hy + hz * hz, facing)) / survival
                indirect_r += beta_r * gain * le_r
                indirect_g += beta_g * gain * le_g
                indirect_b += beta_b * gain * le_b
        if depth >= t.max_bounces:
            break
        width = widened(t, width, spread, math.sqrt(hx * hx + hy * hy + hz * hz))
        base_r, base_g, base_b, metallic, roughness = reflectance(t, s, width, facing)
        glossy = is_glossy(t, metallic, roughness)
        if glossy:
            look = gloss(t, (base_r, base_g, base_b), metallic, roughness, dx, dy, dz, n)
        else:
            beta_r *= base_r
            beta_g *= base_g
            beta_b *= base_b
        most = max(beta_r, beta_g, beta_b)
        if most <= 0:
            break
        depth += 1
        vertex = key + uint64(depth) * uint64(0xD1B54A32D192ED03)
        choice = np.float32(0)
        if needs_choice:
            choice, _ = sample_pair(reversed_index, index, depth, vertex + uint64(1))
        if has_emitters:
            light_u, light_v = sample_pair(reversed_index, index, depth, vertex + uint64(2))
            r, g, b = from_emitters(t, ray, ray_bits, p, n, epsilon, glossy, look, light_u, light_v, choice)
            if r + g + b > 0:
                dark = 0
                indirect_r += beta_r / survival * r
                indirect_g += beta_g / survival * g
                indirect_b += beta_b / survival * b
        if has_sky(t):
            light_u, light_v = sample_pair(reversed_index, index, depth, vertex + uint64(4))
            r, g, b = from_sky(t, ray, ray_bits, p, n, epsilon, glossy, look, light_u, light_v)
            if r + g + b > 0:
                dark = 0
                indirect_r += beta_r / survival * r
                indirect_g += beta_g / survival * g
                indirect_b += beta_b / survival * b
        if has_lights:
            # Emitters and punctual lights may share a number: each sum stays unbiased, and no product of the two is taken.
            r, g, b = from_lights(t, ray, ray_bits, p, n, epsilon, glossy, look, choice)
            if r + g + b > 0:
                dark = 0
                if depth == 1:
                    direct_r, direct_g, direct_b = beta_r * r, beta_g * g, beta_b * b
                else:
                    indirect_r += beta_r / survival * r
                    indirect_g += beta_g / survival * g
                    indirect_b += beta_b / survival * b
        if not glossy:
            known, r, g, b = cached_light(t, ray, ray_bits, scramble, depth, p, n, epsilon, hx * hx + hy * hy + hz * hz)
            if known:
                indirect_r += beta_r / survival * r
                indirect_g += beta_g / survival * g
                indirect_b += beta_b / survival * b
                break
        bsdf_u, bsdf_v = sample_pair(reversed_index, index, depth, vertex)
        if glossy:
            dx, dy, dz = sample_gloss(t, look, np.float64(bsdf_u), np.float64(bsdf_v), n)
            fr, fg, fb, pdf = scattered(t, glossy, look, dx, dy, dz, n)
            if pdf <= 0 or fr + fg + fb <= 0:
                break
            beta_r *= fr / pdf
            beta_g *= fg / pdf
            beta_b *= fb / pdf
            most = max(beta_r, beta_g, beta_b)
        go_on = 1.0
        # A gloss may weigh more than 1 in a direction that is seldom drawn: what roulette took away it does not give back.
        if most < ROULETTE_THROUGHPUT * by_throughput:
            go_on = most / ROULETTE_THROUGHPUT / by_throughput
            by_throughput = most / ROULETTE_THROUGHPUT
        if dark > ROULETTE_DARK_VERTICES:
            go_on *= ((dark - 1.0) / dark) ** 2
        if depth > ROULETTE_LAST_VERTICES:
            go_on *= ((depth - 1.0) / depth) ** 2
        if go_on < 1:
            roulette, _ = random_pair(index, vertex + uint64(3))
            if roulette >= go_on:
                break
            survival *= go_on
        if not glossy:
            dx, dy, dz = sample_lambert(float(bsdf_u), float(bsdf_v), n)
            pdf = lambert_cosine(dx, dy, dz, n) * INV_PI
        spread = scattered_spread(t, spread, pdf)
        ox, oy, oz = p[0] + epsilon * n[0], p[1] + epsilon * n[1], p[2] + epsilon * n[2]
        passed = 0
        if depth >= t.max_bounces and not has_emitters:
            # The last ray can only find the environment: whether anything is in the way is a cheaper question than what.
            if not shines or blocked(t, ray, ray_bits, ox, oy, oz, dx, dy, dz, INFINITE):
                break
            ray_bits[18] = INVALID
        else:
            set_ray(ray, ray_bits, ox, oy, oz, dx, dy, dz, INFINITE)
            ask_nearest(t, ray)
    return (emitted_r, emitted_g, emitted_b), (direct_r, direct_g, direct_b), (indirect_r, indirect_g, indirect_b), hit_any, light_pdf


@kernel
def trace_by_cosine(t, ray, ray_bits, p, n, epsilon, u, v, reversed_index, index, key, wide, scramble):  # type: ignore[no-untyped-def]
    """One path that leaves a matt surface: what the next ray brings beside :mod:`bake_core.next_event`, an estimate of ∫ L cosθ dω / π.

    Parameters
    ----------
    p : 3 float64
    n : 6 float64
        Geometric and shading normal.
    u, v : float32
        What its direction is drawn by.
    wide : bool
        Whether the ray stands for as much as its density says, as one does that was scattered here; else textures are as fine as can be.

    Other parameters are :func:`trace_path`'s; what the ray meets has the share that the balance heuristic gives it.
    """
    dx, dy, dz = sample_lambert(u, v, n)
    pdf = lambert_cosine(dx, dy, dz, n) * INV_PI
    spread = scattered_spread(t, 0.0, pdf) if wide else 0.0
    x, y, z = p[0] + epsilon * n[0], p[1] + epsilon * n[1], p[2] + epsilon * n[2]
    emitted, direct, indirect, _, light_pdf = trace_path(
        t, ray, ray_bits, x, y, z, dx, dy, dz, reversed_index, index, key, False, spread, scramble
    )
    share = pdf / (pdf + light_pdf) if light_pdf > 0 else 1.0
    return (
        share * emitted[0] + direct[0] + indirect[0],
        share * emitted[1] + direct[1] + indirect[1],
        share * emitted[2] + direct[2] + indirect[2],
    )
