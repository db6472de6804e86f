"""Irradiance filtering (Kontkanen, Räsänen, Keller 2004): device side, for any values on the pixels of a picture."""

import warp as wp

wp.set_module_options({"enable_backward": False})


@wp.struct
class Surfaces:
    """What the pixels of a picture show, row by row."""

    width: int
    height: int
    normal: wp.array[wp.vec3]  # unit length; 0: not part of the filter
    position: wp.array[wp.vec3]


@wp.func
def kernel_weight(surfaces: Surfaces, i: int, j: int, radius: float, spread: float):
    """Falls linearly to 0 at distance `radius`, and to 0 where normals differ by the angle that `spread` stands for."""
    dn = surfaces.normal[j] - surfaces.normal[i]
    dx = surfaces.position[j] - surfaces.position[i]
    # for unit normals |dn|^2 / 2 is 1 - cos, without its rounding
    return wp.max(0.0, 1.0 - wp.length(dx) / radius) * wp.max(0.0, 1.0 - wp.sqrt(0.5 * wp.dot(dn, dn) / spread))


@wp.kernel
def filter_pixels(
    offset: int,
    first: int,
    surfaces: Surfaces,
    radius: wp.array[float],
    reach: int,
    spread: float,
    value: wp.array[wp.vec3],
    known: wp.array[wp.vec3],
    filtered: wp.array[wp.vec3],
    filled: wp.array[wp.vec3],
):
    """One thread writes one pixel, counted from `first`: the weighted mean of what lies within `radius` around it.

    It looks at squares of pixels, larger and larger, until none of their pixels counts or `reach` pixels are behind;
    so the cost follows the support, and no camera is needed. `radius` is above 0. `known` is 1 where a channel of
    `value` counts and 0 where it does not; `filled` says whether any counted. Equal values stay equal.
    """
    i = first + offset + wp.tid()
    here = known[i]
    center = wp.cw_mul(value[i], here)
    filtered[i] = center
    filled[i] = here
    if wp.length_sq(surfaces.normal[i]) == 0.0:
        return
    px = i % surfaces.width
    py = i // surfaces.width
    total = wp.vec3(0.0)
    weight = wp.vec3(0.0)
    ring = int(0)
    met = int(1)
    while met > 0 and ring <= reach:
        met = int(0)
        for y in range(wp.max(py - ring, 0), wp.min(py + ring, surfaces.height - 1) + 1):
            # the first and the last row of the square whole, of the others both ends
            stride = wp.where(wp.abs(y - py) == ring, 1, 2 * ring)
            for x in range(px - ring, px + ring + 1, stride):
                if x < 0 or x >= surfaces.width:
                    continue
                j = y * surfaces.width + x
                if wp.length_sq(surfaces.normal[j]) == 0.0:
                    continue
                w = kernel_weight(surfaces, i, j, radius[i], spread)
                if w > 0.0:
                    met = met + 1
                    wk = known[j] * w
                    total = total + wp.cw_mul(wk, value[j] - center)
                    weight = weight + wk
        ring = ring + 1
    result = center
    found = wp.vec3(0.0)
    for c in range(3):
        if weight[c] > 0.0:
            result[c] = center[c] + total[c] / weight[c]
            found[c] = 1.0
    filtered[i] = result
    filled[i] = found
