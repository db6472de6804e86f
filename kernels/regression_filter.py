"""Filtering what few rays gathered at each primary hit: irradiance as a linear function of the normal, pixel by pixel.

First-order regression over a window (Moon et al. 2014; Bitterli et al. 2016) with one feature alone, the normal: leaves
of one twig see much the same light, each by its own half. Pixels count by the means of their hits, and irradiance is
read at each hit's own normal; so the mean over a pixel stays sharp where leaves turn.
"""

import warp as wp

from warpgi.kernels.irradiance_cache import Hits, is_hit

wp.set_module_options({"enable_backward": False})

# Pulls the slope towards 0, as so much variance of normals beside their own: means over few hits have noise themselves.
RIDGE = wp.constant(0.1)
# Radius in the scene, in footprints of a pixel, for each pixel of the radius in the picture: slanted surfaces count.
SLANT = wp.constant(1.4)


@wp.struct
class Pixels:
    """Means over the primary hits of each pixel."""

    position: wp.array[wp.vec3]
    normal: wp.array[wp.vec3]
    irradiance: wp.array[wp.vec3]
    hits: wp.array[int]  # how many there are
    wanted: wp.array[int]  # 1: some of them are to be filtered


@wp.kernel
def average_hits(offset: int, hits: Hits, irradiance: wp.array[wp.vec3], uncovered: wp.array[int], pixels: Pixels):
    """One thread writes one pixel's means."""
    i = offset + wp.tid()
    position = wp.vec3(0.0)
    normal = wp.vec3(0.0)
    light = wp.vec3(0.0)
    count = int(0)
    wanted = int(0)
    for h in range(i * hits.per_pixel, (i + 1) * hits.per_pixel):
        if is_hit(hits, h):
            position = position + hits.origins[h]
            normal = normal + hits.normals[h]
            light = light + irradiance[h]
            count = count + 1
            wanted = wp.max(wanted, uncovered[h])
    share = 1.0 / float(wp.max(count, 1))
    pixels.position[i] = position * share
    pixels.normal[i] = normal * share
    pixels.irradiance[i] = light * share
    pixels.hits[i] = count
    pixels.wanted[i] = wanted


@wp.func
def half_distance(hits: Hits, pixels: Pixels, i: int, x: int, y: int, least: float):
    """Half the distance to a pixel two away, or `least` where that is less or nothing is there."""
    if x < 0 or y < 0 or x >= hits.width or y >= hits.height:
        return least
    j = y * hits.width + x
    if pixels.hits[j] == 0:
        return least
    return wp.min(least, 0.5 * wp.length(pixels.position[j] - pixels.position[i]))


@wp.kernel
def regress(
    offset: int, hits: Hits, uncovered: wp.array[int], pixels: Pixels, radius: float, irradiance: wp.array[wp.vec3]
):
    """One thread owns one pixel and puts at its uncovered hits what a regression over `radius` pixels around says."""
    i = offset + wp.tid()
    if pixels.wanted[i] == 0:
        return
    px = i % hits.width
    py = i // hits.width
    here = pixels.position[i]
    n = pixels.normal[i]
    footprint = float(1.0e30)
    footprint = half_distance(hits, pixels, i, px - 2, py, footprint)
    footprint = half_distance(hits, pixels, i, px + 2, py, footprint)
    footprint = half_distance(hits, pixels, i, px, py - 2, footprint)
    footprint = half_distance(hits, pixels, i, px, py + 2, footprint)
    far = wp.max(SLANT * radius * footprint, 1.0e-30)
    reach = int(wp.ceil(radius))
    a = wp.mat44(0.0)
    red = wp.vec4(0.0)
    green = wp.vec4(0.0)
    blue = wp.vec4(0.0)
    for y in range(wp.max(py - reach, 0), wp.min(py + reach, hits.height - 1) + 1):
        for x in range(wp.max(px - reach, 0), wp.min(px + reach, hits.width - 1) + 1):
            j = y * hits.width + x
            if pixels.hits[j] == 0:
                continue
            beside = wp.length(wp.vec2(float(x - px), float(y - py)))
            w = wp.max(0.0, 1.0 - beside / (radius + 1.0))
            w = w * wp.max(0.0, 1.0 - wp.length(pixels.position[j] - here) / far) * float(pixels.hits[j])
            if w > 0.0:
                dn = pixels.normal[j] - n
                f = wp.vec4(1.0, dn[0], dn[1], dn[2])
                e = pixels.irradiance[j] * w
                a = a + wp.outer(f, f) * w
                red = red + f * e[0]
                green = green + f * e[1]
                blue = blue + f * e[2]
    for k in range(1, 4):
        a[k, k] = a[k, k] + RIDGE * a[0, 0]
    inverse = wp.inverse(a)
    red = inverse * red
    green = inverse * green
    blue = inverse * blue
    for h in range(i * hits.per_pixel, (i + 1) * hits.per_pixel):
        if uncovered[h] == 1:
            dn = hits.normals[h] - n
            f = wp.vec4(1.0, dn[0], dn[1], dn[2])
            # a hit in the shade of its neighbours' normals must not go below nothing
            irradiance[h] = wp.max(wp.vec3(wp.dot(red, f), wp.dot(green, f), wp.dot(blue, f)), wp.vec3(0.0))
