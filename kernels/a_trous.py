"""Edge-avoiding À-Trous wavelet transform (Dammertz et al. 2010): device side."""

import warp as wp

from warpgi.kernels.rng import mix64

wp.set_module_options({"enable_backward": False})

# Up to this step a receiver looks at all samples of a tap, from there on at one: the pictures are as good, for a
# fraction of the time. The narrow passes must see all, or thin things stay noisy.
DENSE_STEP = wp.constant(2)

TINY = wp.constant(1.0e-37)  # keeps 0 / 0 away where nothing differs and nothing has a size


@wp.struct
class Rows:
    """What is filtered: a row a pixel, or a row a sample."""

    width: int
    height: int
    first: wp.array[int]  # a pixel's first row; one entry more than pixels
    pixel: wp.array[int]  # of each row
    normal: wp.array[wp.vec3]  # 0: not part of the filter
    position: wp.array[wp.vec3]
    footprint: wp.array[float]  # distance of the positions of neighbouring pixels
    hit_normal: wp.array[wp.vec3]  # empty where it is not looked at


@wp.struct
class Falloff:
    """One over the squared sigmas of a pass; 0 switches a term off."""

    color: float
    normal: float
    position: float  # in squared footprints
    hit_normal: float


@wp.func
def b3_spline(k: int):
    """(1, 4, 6, 4, 1) / 16 at -2 to 2."""
    return wp.where(k == 0, 0.375, wp.where(wp.abs(k) == 1, 0.25, 0.0625))


@wp.func
def range_weight(rows: Rows, falloff: Falloff, i: int, j: int, footprint2: float):
    """Product of the edge-stopping functions but for colour (Dammertz et al. 2010, eq. 5)."""
    dn = rows.normal[j] - rows.normal[i]
    dx = rows.position[j] - rows.position[i]
    e = wp.dot(dn, dn) * falloff.normal
    e = e + wp.dot(dx, dx) * falloff.position / (footprint2 + TINY)
    if rows.hit_normal.shape[0] > 0:
        dh = rows.hit_normal[j] - rows.hit_normal[i]
        e = e + wp.dot(dh, dh) * falloff.hit_normal
    return e


@wp.kernel
def filter_rows(
    offset: int,
    rows: Rows,
    falloff: Falloff,
    step: int,
    value: wp.array[wp.vec3],
    known: wp.array[wp.vec3],
    filtered: wp.array[wp.vec3],
    filled: wp.array[wp.vec3],
):
    """One thread writes one row: the weighted mean of 5 x 5 taps, `step` pixels apart.

    `known` is 1 where a channel of `value` counts, 0 where it does not; such a channel takes what the others say, and
    `filled` says whether any did. The mean is that of differences from the row itself: equal values stay equal.
    """
    i = offset + wp.tid()
    here = known[i]
    center = wp.cw_mul(value[i], here)
    if wp.length_sq(rows.normal[i]) == 0.0:
        filtered[i] = center
        filled[i] = here
        return
    pixel = rows.pixel[i]
    place = i - rows.first[pixel]
    footprint2 = rows.footprint[i] * rows.footprint[i]
    has_color = falloff.color > 0.0 and here[0] + here[1] + here[2] > 0.0
    total = wp.vec3(0.0)
    weight = wp.vec3(0.0)
    for dy in range(-2, 3):
        y = pixel // rows.width + dy * step
        if y < 0 or y >= rows.height:
            continue
        for dx in range(-2, 3):
            x = pixel % rows.width + dx * step
            if x < 0 or x >= rows.width:
                continue
            q = y * rows.width + x
            begin = rows.first[q]
            count = rows.first[q + 1] - begin
            looks = count
            if step > DENSE_STEP and count > 1:
                # another pairing of samples in every tap and pass, in which each is used once
                tap = wp.uint64(q) * wp.uint64(512) + wp.uint64((dy + 2) * 5 + dx + 2)
                shift = int(mix64(tap + (wp.uint64(step) << wp.uint64(48))) % wp.uint64(count))
                if dx == 0 and dy == 0:
                    shift = 0
                begin = begin + (place + shift) % count
                looks = 1
            for j in range(begin, begin + looks):
                if wp.length_sq(rows.normal[j]) == 0.0:
                    continue
                e = range_weight(rows, falloff, i, j, footprint2)
                there = known[j]
                difference = wp.cw_mul(value[j], there) - center
                if has_color:
                    seen = wp.cw_mul(wp.cw_mul(difference, here), there)
                    e = e + wp.dot(seen, seen) * falloff.color
                w = there * (b3_spline(dx) * b3_spline(dy) * wp.exp(-e))
                total = total + wp.cw_mul(w, difference)
                weight = weight + w
    result = center
    found = wp.vec3(0.0)
    for c in range(3):
        if weight[c] > 0.0:
            result[c] = center[c] + total[c] / weight[c]
            found[c] = 1.0
    filtered[i] = result
    filled[i] = found
