"""Stratified hemispheres: irradiance and its gradients from radiance and distance in each stratum.

Ward, Heckbert 1992; Krivanek et al. 2008. Strata are rings of equal share of the cosine times sectors of azimuth; what
fills them, path tracing or reconstruction, is another file's affair.
"""

import warp as wp

from warpgi.kernels.rng import INDEPENDENT, make_sampler, sample_2d
from warpgi.kernels.sampling import PI, make_frame

wp.set_module_options({"enable_backward": False})

# Beside the pairs that paths use, which are 0 and up.
STRATUM_PAIR = wp.constant(-2)


@wp.struct
class Hemispheres:
    """Points at which irradiance is wanted."""

    points: wp.array[wp.vec3]
    normals: wp.array[wp.vec3]
    keys: wp.array[int]  # of their random numbers
    rings: int  # M
    sectors: int  # N


@wp.struct
class Irradiance:
    """What is known of the light at a point: values and derivatives for each channel."""

    value: wp.array[wp.vec3]  # [W/m^2]
    rotation: wp.array2d[wp.vec3]  # dE/dw of turning the normal about an axis, (points, channels)
    translation: wp.array2d[wp.vec3]  # dE/dx of moving the point, (points, channels)
    harmonic: wp.array[float]  # harmonic mean of the distances of what the rays met
    nearest: wp.array[float]  # the least of them


@wp.func
def stratum_direction(h: Hemispheres, i: int, stratum: int, seed: int):
    """A direction in a stratum about +z; `stratum` counts the rings of a sector, from the zenith, then the sectors."""
    u = sample_2d(make_sampler(seed, h.keys[i], stratum, INDEPENDENT), STRATUM_PAIR)
    s2 = (float(stratum % h.rings) + u[0]) / float(h.rings)  # sin^2 of theta
    phi = 2.0 * PI * (float(stratum // h.rings) + u[1]) / float(h.sectors)
    s = wp.sqrt(s2)
    return wp.vec3(s * wp.cos(phi), s * wp.sin(phi), wp.sqrt(wp.max(0.0, 1.0 - s2)))


@wp.func
def tangent_integral(s2: float):
    """Integral of tan(theta) over sin^2(theta) from 0 to s2."""
    return wp.asin(wp.sqrt(s2)) - wp.sqrt(wp.max(0.0, s2 * (1.0 - s2)))


@wp.func
def nearer(a: float, b: float):
    return wp.max(wp.min(a, b), 1.0e-20)


@wp.kernel
def sum_strata(offset: int, h: Hemispheres, strata: wp.array[wp.vec4], result: Irradiance):
    """One thread owns a point and writes all that is known of it.

    The derivatives are exact for radiance that is constant in each stratum: integrals over a stratum stand where the
    papers have values at its middle. Moving makes edges between strata move (Ward, Heckbert 1992): by the nearer of the
    two distances, as the nearer surface is the one that has the edge.
    """
    i = offset + wp.tid()
    frame = make_frame(h.normals[i])
    m = float(h.rings)
    step = 2.0 * PI / float(h.sectors)
    chord = 2.0 * wp.sin(0.5 * step)  # length of the integral of a unit vector over a sector
    total = wp.vec3(0.0)
    inverse = float(0.0)
    nearest = float(1.0e30)
    known = int(0)
    rotation_r = wp.vec3(0.0)
    rotation_g = wp.vec3(0.0)
    rotation_b = wp.vec3(0.0)
    translation_r = wp.vec3(0.0)
    translation_g = wp.vec3(0.0)
    translation_b = wp.vec3(0.0)
    for k in range(h.sectors):
        phi = (float(k) + 0.5) * step
        u = frame.s * wp.cos(phi) + frame.t * wp.sin(phi)
        v = frame.t * wp.cos(phi) - frame.s * wp.sin(phi)
        edge = frame.t * wp.cos(phi - 0.5 * step) - frame.s * wp.sin(phi - 0.5 * step)
        before = wp.where(k > 0, k - 1, h.sectors - 1)
        sum_rotation = wp.vec3(0.0)
        sum_ring = wp.vec3(0.0)
        sum_sector = wp.vec3(0.0)
        inner = float(0.0)  # sin of the stratum's lower edge
        for j in range(h.rings):
            at = (i * h.sectors + k) * h.rings + j
            s = strata[at]
            outer = wp.sqrt(float(j + 1) / m)
            if s[3] >= 0.0:
                light = wp.vec3(s[0], s[1], s[2])
                total = total + light
                inverse = inverse + 1.0 / wp.max(s[3], 1.0e-20)
                nearest = wp.min(nearest, s[3])
                known = known + 1
                lean = tangent_integral(float(j + 1) / m) - tangent_integral(float(j) / m)
                sum_rotation = sum_rotation + light * lean
                if j > 0:
                    low = strata[at - 1]
                    if low[3] >= 0.0:
                        part = (1.0 - inner * inner) * inner / nearer(s[3], low[3])
                        sum_ring = sum_ring + (light - wp.vec3(low[0], low[1], low[2])) * part
                side = strata[(i * h.sectors + before) * h.rings + j]
                if side[3] >= 0.0:
                    part = (outer - inner) / nearer(s[3], side[3])
                    sum_sector = sum_sector + (light - wp.vec3(side[0], side[1], side[2])) * part
            inner = outer
        # dE = integral of L (dn . w), and n x w is sin(theta) times v
        rotation_r = rotation_r + v * (0.5 * chord * sum_rotation[0])
        rotation_g = rotation_g + v * (0.5 * chord * sum_rotation[1])
        rotation_b = rotation_b + v * (0.5 * chord * sum_rotation[2])
        translation_r = translation_r + u * (chord * sum_ring[0]) + edge * sum_sector[0]
        translation_g = translation_g + u * (chord * sum_ring[1]) + edge * sum_sector[1]
        translation_b = translation_b + u * (chord * sum_ring[2]) + edge * sum_sector[2]
    share = float(h.rings * h.sectors) / float(wp.max(known, 1))  # strata without support are left out
    result.value[i] = total * (PI * share / float(h.rings * h.sectors))
    result.rotation[i, 0] = rotation_r * share
    result.rotation[i, 1] = rotation_g * share
    result.rotation[i, 2] = rotation_b * share
    result.translation[i, 0] = translation_r
    result.translation[i, 1] = translation_g
    result.translation[i, 2] = translation_b
    result.harmonic[i] = float(wp.max(known, 1)) / wp.max(inverse, 1.0e-30)
    result.nearest[i] = nearest
