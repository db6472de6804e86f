"""Irradiance caching (Ward, Rubinstein, Clear 1988): which records serve a point, and what they say of it.

Records lie in a tree of balls, each as large as the record may be used. Weights fall to zero there (after Tabellion,
Lamorlette 2004), so that no seam shows where a record begins to count.
"""

import warp as wp

from warpgi.kernels.lanes import LANES_HEAD, POINT_WALK
from warpgi.kernels.sampling import INV_PI
from warpgi.kernels.splats import SplatTree, search

wp.set_module_options({"enable_backward": False})

RECORD_STRIDE = wp.constant(24)  # radius R, irradiance, dE/dw by channel, dE/dx by channel
MET = wp.constant(1.0e10)  # coordinates from here on say that nothing was met
MASK_BITS = wp.constant(31)  # primary hits that are looked at together
SAME_NORMAL = wp.constant(0.995)  # of one piece of surface

vec6 = wp.types.vector(length=6, dtype=wp.float32)

# The records whose error |x - x_i| / R_i + sqrt(1 - n.n_i) (Ward et al. 1988) is below `most`, but those in front of
# which the point lies not: their hemisphere does not see what the point's does. Each is extrapolated with its gradients
# (Ward, Heckbert 1992). Returns weighted irradiance (3), weight, the least error and the weighted squared mean of the
# channels.
LOOK_UP = (
    "    float sum[3] = {0.0f, 0.0f, 0.0f};\n"
    "    float weight = 0.0f, least = 1.0e30f, squares = 0.0f;\n"
    + POINT_WALK
    + """
            float d2[8], turn[8];
            int met[8];
            for (int k = 0; k < 8; ++k) {
                const float dx = x[0] - p[k], dy = x[1] - p[8 + k], dz = x[2] - p[16 + k];
                const float nx = p[24 + k], ny = p[32 + k], nz = p[40 + k];
                d2[k] = dx * dx + dy * dy + dz * dz;
                turn[k] = larger(1.0f - (nx * n[0] + ny * n[1] + nz * n[2]), 0.0f);
                const float above = 0.5f * (dx * (nx + n[0]) + dy * (ny + n[1]) + dz * (nz + n[2]));
                met[k] = (int)((d2[k] < p[48 + k]) & (turn[k] < most * most) &
                               (above * wp::abs(above) >= front * p[48 + k]));
            }
            unsigned mask = lane_mask(met);
            while (mask) {
                const int k = next_lane(mask);
                const float* q = records.data + (size_t)(block * 8 + k) * 24;
                const float error = wp::sqrt(d2[k]) / q[0] + wp::sqrt(turn[k]);
                if (error >= most)
                    continue;
                const float dx = x[0] - p[k], dy = x[1] - p[8 + k], dz = x[2] - p[16 + k];
                const float nx = p[24 + k], ny = p[32 + k], nz = p[40 + k];
                const float wx = ny * n[2] - nz * n[1], wy = nz * n[0] - nx * n[2], wz = nx * n[1] - ny * n[0];
                const float w = 1.0f - error / most;
                float all = 0.0f;
                for (int c = 0; c < 3; ++c) {
                    const float* g = q + 4 + 3 * c;
                    const float e = larger(0.0f, q[1 + c] + wx * g[0] + wy * g[1] + wz * g[2] +
                                                     dx * g[9] + dy * g[10] + dz * g[11]);
                    sum[c] += w * e;
                    all += e;
                }
                weight += w;
                squares += w * all * all * (1.0f / 9.0f);
                least = smaller(least, error);
            }
        }
    }
    wp::vec_t<6, wp::float32> result;
    result[0] = sum[0]; result[1] = sum[1]; result[2] = sum[2];
    result[3] = weight; result[4] = least; result[5] = squares;
    return result;
"""
)


@wp.func_native(LOOK_UP)
def look_up(tree: SplatTree, records: wp.array[float], x: wp.vec3, n: wp.vec3, most: float, front: float) -> vec6: ...


@wp.struct
class Records:
    tree: SplatTree  # of balls in which a record may be used
    values: wp.array[float]  # RECORD_STRIDE numbers each, in the tree's order
    most: float  # error from which on a record is not used
    front: float  # below 0: how far a point may lie behind a record, squared, in its ball's radii


@wp.struct
class Hits:
    """Primary hits in the order of pixels."""

    origins: wp.array[wp.vec3]
    normals: wp.array[wp.vec3]
    per_pixel: int
    width: int
    height: int


@wp.func
def is_hit(hits: Hits, h: int):
    p = hits.origins[h]
    return wp.abs(p[0]) < MET and wp.abs(p[1]) < MET and wp.abs(p[2]) < MET


@wp.func
def first_hit(hits: Hits, x: int, y: int):
    """The first primary hit of a pixel, -1: none, or outside the picture."""
    if x < 0 or y < 0 or x >= hits.width or y >= hits.height:
        return -1
    start = (y * hits.width + x) * hits.per_pixel
    for k in range(hits.per_pixel):
        if is_hit(hits, start + k):
            return start + k
    return -1


@wp.func
def coplanar(p: wp.vec3, n: wp.vec3, q: wp.vec3, m: wp.vec3):
    """Whether two hits lie on one piece of surface, as far as their normals tell."""
    d = q - p
    return wp.dot(n, m) > SAME_NORMAL and wp.abs(wp.dot(d, n)) <= 0.1 * wp.length(d)


@wp.func
def apart(hits: Hits, x: int, y: int, dx: int, dy: int):
    """Half the distance of the hits on either side, or that to the one which is there; 0 where none is."""
    a = first_hit(hits, x - dx, y - dy)
    b = first_hit(hits, x + dx, y + dy)
    c = first_hit(hits, x, y)
    if a >= 0 and b >= 0:
        return 0.5 * wp.length(hits.origins[a] - hits.origins[b])
    if a >= 0:
        return wp.length(hits.origins[a] - hits.origins[c])
    if b >= 0:
        return wp.length(hits.origins[b] - hits.origins[c])
    return 0.0


@wp.kernel
def find_uncovered(
    offset: int,
    records: Records,
    hits: Hits,
    candidates: wp.array[int],
    error: float,
    spread: float,
    support: int,
    wanted: wp.array[int],
    footprint: wp.array[float],
):
    """One thread owns one candidate pixel: its hit where a record is to be, or -1, and the width of a pixel there.

    No record is wanted where one is near enough and those that serve the point agree to within `spread`, nor where the
    surface is smaller than a few pixels: fewer than `support` of eight pixels around lie on it.
    """
    i = offset + wp.tid()
    pixel = candidates[i]
    x = pixel % hits.width
    y = pixel // hits.width
    wanted[i] = -1
    h = first_hit(hits, x, y)
    if h < 0:
        return
    p = hits.origins[h]
    n = hits.normals[h]
    found = look_up(records.tree, records.values, p, n, records.most, records.front)
    if found[4] < error and found[3] > 0.0:
        mean = (found[0] + found[1] + found[2]) / (3.0 * found[3])
        variance = found[5] / found[3] - mean * mean
        if variance <= spread * spread * mean * mean:
            return
    around = int(0)
    for dy in range(-1, 2):
        for dx in range(-1, 2):
            if dx != 0 or dy != 0:
                other = first_hit(hits, x + 2 * dx, y + 2 * dy)
                if other >= 0:
                    if coplanar(p, n, hits.origins[other], hits.normals[other]):
                        around = around + 1
    if around < support:
        return
    across = apart(hits, x, y, 1, 0)
    down = apart(hits, x, y, 0, 1)
    size = wp.min(across, down)
    if size <= 0.0:
        size = wp.max(across, down)
    footprint[i] = size
    wanted[i] = h


# Radius of a record by its neighbours', R_i <= R_j + |x_i - x_j| (Krivanek et al. 2006). Those beyond its own radius,
# and then beyond what is left of it, cannot make it smaller. Boxes are those of points.
CLAMPED = (
    LANES_HEAD
    + """
    const int block0 = i / 8;
    const float* q = tree.blocks.data + (size_t)block0 * 80 + i % 8;
    const float cx = q[0], cy = q[8], cz = q[16], nx = 0.0f, ny = 0.0f, nz = 0.0f, stretch = 0.0f;
    float radius = radii.data[i];
    float worst = radius * radius;
"""
    + search(
        """
                    radius = smaller(radius, radii.data[block * 8 + j] + wp::sqrt(d2[j]));
                    worst = radius * radius;
"""
    )
    + "    return radius;\n"
)


@wp.func_native(CLAMPED)
def clamped_radius(tree: SplatTree, radii: wp.array[float], i: int) -> float: ...


@wp.kernel
def clamp_radii(offset: int, tree: SplatTree, radii: wp.array[float], result: wp.array[float]):
    """One thread owns one record in the tree's order and clamps its radius by its neighbours'."""
    i = offset + wp.tid()
    result[i] = clamped_radius(tree, radii, i)


@wp.kernel
def interpolate(
    offset: int,
    records: Records,
    hits: Hits,
    first_pixel: int,
    irradiance: wp.array[wp.vec3],
    uncovered: wp.array[int],
):
    """One thread owns one pixel: irradiance at its hits, or a mark where no record serves.

    Hits on one piece of surface are looked up together, at their mean, for there irradiance is as good as linear.
    """
    pixel = first_pixel + offset + wp.tid()
    for chunk in range(0, hits.per_pixel, MASK_BITS):
        start = pixel * hits.per_pixel + chunk
        count = wp.min(hits.per_pixel - chunk, MASK_BITS)
        done = int(0)
        for j in range(count):
            if (done >> j) & 1 == 0 and is_hit(hits, start + j):
                p = hits.origins[start + j]
                n = hits.normals[start + j]
                group = int(1) << j
                middle = p
                lean = n
                for k in range(j + 1, count):
                    if (done >> k) & 1 == 0 and is_hit(hits, start + k):
                        if coplanar(p, n, hits.origins[start + k], hits.normals[start + k]):
                            group = group | (int(1) << k)
                            middle = middle + hits.origins[start + k]
                            lean = lean + hits.normals[start + k]
                size = float(0.0)
                for k in range(j, count):
                    size = size + float((group >> k) & 1)
                done = done | group
                found = look_up(
                    records.tree, records.values, middle / size, wp.normalize(lean), records.most, records.front
                )
                value = wp.vec3(found[0], found[1], found[2]) / wp.max(found[3], 1.0e-20)
                for k in range(j, count):
                    if (group >> k) & 1 == 1:
                        irradiance[start + k] = value
                        uncovered[start + k] = wp.where(found[3] > 0.0, 0, 1)


@wp.kernel
def reflect_irradiance(
    offset: int, irradiance: wp.array[wp.vec3], albedo: wp.array[wp.vec3], reflected: wp.array[wp.vec3]
):
    """One thread writes the radiance that a diffuse hit reflects."""
    i = offset + wp.tid()
    reflected[i] = wp.cw_mul(albedo[i], irradiance[i]) * INV_PI


@wp.kernel
def place_irradiance(offset: int, values: wp.array[wp.vec3], hits: wp.array[int], irradiance: wp.array[wp.vec3]):
    """One thread puts one value where it belongs."""
    i = offset + wp.tid()
    irradiance[hits[i]] = values[i]
