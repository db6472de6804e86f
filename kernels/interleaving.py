"""Interleaved sampling (Keller, Heidrich 2001): each pixel of a square has its own lights, and a filter joins them."""

import warp as wp

from warpgi.kernels.film import Film, PathSample, add_sample, is_finite

wp.set_module_options({"enable_backward": False})

TINY = wp.constant(1.0e-37)  # keeps 0 / 0 away where a surface has no size


@wp.struct
class Interleaving:
    """Light of diffuse first hits, by pixel of the picture; arrays are empty where `side` is 1."""

    side: int  # pixels of the side of a square that share out the lights
    width: int  # of the picture
    height: int
    light: wp.array[wp.vec3]  # mean of what such hits reflect of indirect light
    albedo: wp.array[wp.vec3]  # mean of their albedo


@wp.func
def subset_of(interleaving: Interleaving, pixel: int, index: int):
    """Number of the first light of a sample's subset: with as many samples as subsets a pixel has them all."""
    x = pixel % interleaving.width % interleaving.side
    y = pixel // interleaving.width % interleaving.side
    return (y * interleaving.side + x + index) % (interleaving.side * interleaving.side)


@wp.func
def add_shared(interleaving: Interleaving, film: Film, i: int, pixel: int, path: PathSample):
    """Folds a sample into pixel i of `film`, but for the indirect light of a diffuse first hit."""
    rest = path
    light = wp.vec3(0.0)
    albedo = wp.vec3(0.0)
    if path.depth >= 0.0 and path.bandwidth == 0.0 and is_finite(path.indirect):
        light = path.indirect
        albedo = path.albedo
        rest.indirect = wp.vec3(0.0)
    before = film.count[i]
    add_sample(film, i, rest)
    if film.count[i] > before:
        part = 1.0 / float(film.count[i])
        mean = interleaving.light[pixel]
        interleaving.light[pixel] = mean + (light - mean) * part
        mean_albedo = interleaving.albedo[pixel]
        interleaving.albedo[pixel] = mean_albedo + (albedo - mean_albedo) * part


@wp.struct
class Surfaces:
    """What the pixels of a picture show."""

    normal: wp.array[wp.vec3]  # 0: nothing
    position: wp.array[wp.vec3]
    footprint: wp.array[float]  # distance of the positions of neighbouring pixels
    normal_falloff: float  # one over the square of the difference at which a weight falls to 1/e
    plane_falloff: float  # likewise, of the distance from the tangent plane, in footprints


@wp.func
def likeness(surfaces: Surfaces, i: int, j: int):
    """1 on a plane, down to 0 over edges."""
    if wp.length_sq(surfaces.normal[j]) == 0.0:
        return 0.0
    dn = surfaces.normal[j] - surfaces.normal[i]
    off = wp.dot(surfaces.normal[i], surfaces.position[j] - surfaces.position[i])
    footprint = surfaces.footprint[i]
    e = wp.dot(dn, dn) * surfaces.normal_falloff + off * off * surfaces.plane_falloff / (footprint * footprint + TINY)
    return wp.exp(-e)


@wp.kernel
def join_subsets(
    offset: int,
    interleaving: Interleaving,
    surfaces: Surfaces,
    value: wp.array[wp.vec3],
    known: wp.array[wp.vec3],
    joined: wp.array[wp.vec3],
):
    """One thread writes one pixel: the mean over all subsets of what each would show there.

    The pixels of a subset are the corners of a grid of `side` pixels, between which its light is interpolated
    bilinearly, as far as they are of the pixel's surface. A subset of which no such corner is there counts less.
    """
    i = offset + wp.tid()
    if wp.length_sq(surfaces.normal[i]) == 0.0:
        return
    side = interleaving.side
    x = i % interleaving.width
    y = i // interleaving.width
    total = wp.vec3(0.0)
    weight = wp.vec3(0.0)
    for subset in range(side * side):
        light = wp.vec3(0.0)
        share = wp.vec3(0.0)
        alike = wp.vec3(0.0)
        for corner in range(4):
            dx = subset % side - side * (corner % 2)
            dy = subset // side - side * (corner // 2)
            near = float((side - wp.abs(dx)) * (side - wp.abs(dy)))
            qx = x + dx
            qy = y + dy
            if near == 0.0 or qx < 0 or qx >= interleaving.width or qy < 0 or qy >= interleaving.height:
                continue
            j = qy * interleaving.width + qx
            w = known[j] * likeness(surfaces, i, j)
            light = light + wp.cw_mul(w, value[j]) * near
            share = share + w * near
            alike = wp.max(alike, w)
        for c in range(3):
            if share[c] > 0.0:
                total[c] = total[c] + alike[c] * light[c] / share[c]
                weight[c] = weight[c] + alike[c]
    result = wp.vec3(0.0)
    for c in range(3):
        if weight[c] > 0.0:
            result[c] = total[c] / weight[c]
    joined[i] = result
