"""Flux per area from photons nearby (Jensen 1996): k nearest or within a radius, one search for all (`splats`)."""

import warp as wp

from warpgi.kernels.lanes import LANES_HEAD
from warpgi.kernels.rng import SOBOL, make_sampler, sample_2d
from warpgi.kernels.sampling import PI, make_frame, square_to_disc
from warpgi.kernels.scene import Scene, closest_hit
from warpgi.kernels.splats import SplatTree, search

wp.set_module_options({"enable_backward": False})

vec8 = wp.types.vector(length=8, dtype=wp.float32)

MAX_PHOTONS = 256  # half the length of the arrays in NEAREST_PHOTONS

# Shapes of the kernel K(v) / (pi h^2), v = d^2 / h^2 in [0, 1), each of integral 1 over the disc.
CONSTANT = wp.constant(0)
EPANECHNIKOV = wp.constant(1)
CONE = wp.constant(2)
GAUSSIAN = wp.constant(3)

# Jensen 1996's cone reaches this many radii.
CONE_REACH = 1.1
# The Gaussian has a standard deviation of half the radius, and is cut there.
KERNEL = """
    auto weight_of = [=](float v) {
        if (shape == 1)
            return 2.0f * (1.0f - v);
        if (shape == 2)
            return (1.0f - wp::sqrt(v) * (1.0f / 1.1f)) * (1.0f / (1.0f - 2.0f / 3.3f));
        if (shape == 3)
            return wp::exp(-2.0f * v) * 2.313035285f;
        return 1.0f;
    };
    auto flux_of = [&](int at, float w, float* sum) {
        const float* q = tree.blocks.data + (size_t)(at / 8) * 80 + at % 8;
        sum[0] += w * q[56];
        sum[1] += w * q[64];
        sum[2] += w * q[72];
    };
"""


@wp.func_native("""
    if (shape == 1)
        return 2.0f * (1.0f - v);
    if (shape == 2)
        return (1.0f - wp::sqrt(v) * (1.0f / 1.1f)) * (1.0f / (1.0f - 2.0f / 3.3f));
    if (shape == 3)
        return wp::exp(-2.0f * v) * 2.313035285f;
    return 1.0f;
""")
def kernel_weight(v: float, shape: int) -> float: ...


FACING = " & (nx * p[24 + j] + ny * p[32 + j] + nz * p[40 + j] > facing)"
AT_POINT = """
    const float cx = x[0], cy = x[1], cz = x[2], nx = n[0], ny = n[1], nz = n[2];
    const int block0 = -1;
"""

# Sum of kernel times flux over the k nearest photons, of which the last sets the radius and is not counted, so that the
# mean is right where photons lie evenly; times pi h^2. Photons at the very same place are the asking one itself.
# No farther than the root of `limit2`, which is the radius where fewer are found. The radius is then scaled.
# `guess2` bounds the search at first; 0: a bound from how large the boxes of the nearest photons are. Where it was too
# small the search begins anew. What is found does not depend on it, but the order of the sum does.
# Returns the sum, h^2, the photons in it, and the squared distance of the k-th.
NEAREST_PHOTONS = (
    LANES_HEAD
    + KERNEL
    + AT_POINT
    + """
    float distance[512];
    int place[512];
    const int room = 2 * k;
    int found = 0;
    float guess = guess2;
    float worst = guess > 0.0f ? smaller(guess, limit2) : limit2;
    auto swap = [&](int i, int j) {
        const float d = distance[i];
        const int at = place[i];
        distance[i] = distance[j];
        place[i] = place[j];
        distance[j] = d;
        place[j] = at;
    };
    // the k nearest to the front, the farthest of them last (Hoare 1961)
    auto select = [&]() {
        int low = 0, high = found - 1;
        while (low < high) {
            const float pivot = distance[k - 1];
            int i = low, j = high;
            do {
                while (distance[i] < pivot)
                    ++i;
                while (pivot < distance[j])
                    --j;
                if (i <= j)
                    swap(i++, j--);
            } while (i <= j);
            if (j < k - 1)
                low = i;
            if (k - 1 < i)
                high = j;
        }
        found = k;
        worst = distance[k - 1];
    };
    while (true) {
"""
    + search(
        """
                    distance[found] = m2[j];
                    place[found] = block * 8 + j;
                    ++found;
                    if (found == k) {
                        float farthest = 0.0f;
                        for (int i = 0; i < k; ++i)
                            farthest = larger(farthest, distance[i]);
                        worst = smaller(worst, farthest);
                    } else if (found == room) {
                        select();
                    }
""",
        FACING,
        """
            if (guess == 0.0f && first < 0) {
                // 64 photons lie in these boxes, which are somewhat smaller than the photons' share of the surface
                float area = 0.0f;
                for (int j = 0; j < 8; ++j) {
                    const float ex = p[24 + j] - p[j], ey = p[32 + j] - p[8 + j], ez = p[40 + j] - p[16 + j];
                    area += larger(larger(ex * ey, ey * ez), larger(ex * ez, 0.0f));
                }
                guess = (2.5f / (64.0f * 3.14159265f)) * area * (float)k;
                worst = smaller(worst, guess);
            }
""",
    )
    + """
        if (found >= k || guess <= 0.0f || guess >= limit2)
            break;
        guess = 1.0e38f;
        worst = limit2;
        found = 0;
    }
    if (found > k)
        select();
    float kth = limit2;
    if (found == k || limit2 >= 1.0e30f) {
        kth = 0.0f;
        for (int j = 0; j < found; ++j)
            kth = larger(kth, distance[j]);
    }
    const float h2 = kth * scale2, inverse = 1.0f / h2;
    float sum[3] = {0.0f, 0.0f, 0.0f};
    int inside = 0;
    for (int j = 0; j < found; ++j) {
        if (distance[j] < h2) {
            flux_of(place[j], weight_of(distance[j] * inverse), sum);
            ++inside;
        }
    }
    wp::vec_t<8, wp::float32> result;
    result[0] = sum[0]; result[1] = sum[1]; result[2] = sum[2]; result[3] = h2; result[4] = (float)inside;
    result[5] = kth;
    return result;
"""
)


@wp.func_native(NEAREST_PHOTONS)
def nearest_photons(
    tree: SplatTree,
    x: wp.vec3,
    n: wp.vec3,
    k: int,
    guess2: float,
    limit2: float,
    scale2: float,
    stretch: float,
    facing: float,
    shape: int,
) -> vec8: ...


# The same over all photons within the root of `limit2`.
NEAR_PHOTONS = (
    LANES_HEAD
    + KERNEL
    + AT_POINT
    + """
    const float worst = limit2, inverse = 1.0f / limit2;
    float sum[3] = {0.0f, 0.0f, 0.0f};
    int inside = 0;
"""
    + search(
        """
                    flux_of(block * 8 + j, weight_of(m2[j] * inverse), sum);
                    ++inside;
""",
        FACING,
    )
    + """
    wp::vec_t<8, wp::float32> result;
    result[0] = sum[0]; result[1] = sum[1]; result[2] = sum[2]; result[3] = limit2; result[4] = (float)inside;
    return result;
"""
)


@wp.func_native(NEAR_PHOTONS)
def near_photons(
    tree: SplatTree, x: wp.vec3, n: wp.vec3, limit2: float, stretch: float, facing: float, shape: int
) -> vec8: ...


# Place of the nearest lane if its own radius covers the point, no farther than the root of `limit2`; else -1.
NEAREST_IF_COVERING = (
    LANES_HEAD
    + AT_POINT
    + "    float worst = limit2;\n    int found = -1;\n"
    + search(
        """
                    worst = m2[j];
                    found = block * 8 + j;
""",
        FACING,
        at_centre=True,
    )
    + """
    const float* q = tree.blocks.data + (size_t)(found / 8) * 80 + found % 8 + 48;
    return found >= 0 && worst <= *q ? found : -1;
"""
)


@wp.func_native(NEAREST_IF_COVERING)
def nearest_if_covering(
    tree: SplatTree, x: wp.vec3, n: wp.vec3, limit2: float, stretch: float, facing: float
) -> int: ...


# Place of the nearest lane whose own radius covers the point; -1: none. Boxes hold the lanes' balls, so that the point
# is in the boxes of all that cover it.
NEAREST_COVERING = (
    LANES_HEAD
    + AT_POINT
    + "    float worst = 1.0e30f;\n    int found = -1;\n"
    + search(
        """
                    worst = m2[j];
                    found = block * 8 + j;
""",
        FACING + " & (m2[j] <= p[48 + j])",
        enter=" & (d2[j] == 0.0f)",
        at_centre=True,
    )
    + "    return found;\n"
)


@wp.func_native(NEAREST_COVERING)
def nearest_covering(tree: SplatTree, x: wp.vec3, n: wp.vec3, stretch: float, facing: float) -> int: ...


@wp.func
def nearest_place(
    places: SplatTree, balls: SplatTree, usual2: float, x: wp.vec3, n: wp.vec3, stretch: float, facing: float
):
    """Place of the nearest lane whose own radius covers the point; -1: none.

    That is nearly always the nearest lane, which is found faster than all that cover the point. `places` and `balls`
    are the same lanes in boxes of their centres and of their balls; beyond the root of `usual2` the second are asked.
    """
    place = nearest_if_covering(places, x, n, usual2, stretch, facing)
    if place < 0:
        place = nearest_covering(balls, x, n, stretch, facing)
    return place


# The k-th photon of a search nearby is rarely farther, by the squares.
GUESS_NEARBY = wp.constant(1.5)


# A few probes cannot tell a small part from a smaller one, and one near the rim weighs next to nothing.
LEAST_SHARE = wp.constant(0.125)


@wp.struct
class Lookup:
    """How the light at a point is made from photons."""

    neighbours: int  # k; 0: all within the radius
    limit2: float  # largest radius, or the only one, squared
    scale2: float  # of the squared radius, for maps that get finer
    stretch: float  # of the metric along the normal
    facing: float  # smallest cosine between normals
    shape: int  # of the kernel
    probes: int  # rays that find which part of the disc is on the surface; 0: all of it is taken to be
    lift: float  # where they start above the surface, in radii


@wp.struct
class Density:
    irradiance: wp.vec3  # [W/m^2]
    radius2: float
    guess2: float  # for a search nearby
    rays: int


@wp.func
def share_on_surface(scene: Scene, look: Lookup, x: wp.vec3, n: wp.vec3, radius: float, key: int, index: int):
    """Part of the kernel's disc that lies on the surface and in sight: beyond it no photon could have come to be."""
    frame = make_frame(n)
    # from some height, so that the rays meet curved surfaces, but under what hangs over x
    above = closest_hit(scene, x + n * (1.0e-3 * radius), n)
    lift = wp.min(look.lift * radius, 0.5 * above.t)
    o = x + n * lift
    inside = float(0.0)
    total = float(0.0)
    for j in range(look.probes):
        # -1 - index: another stream than the camera's
        sampler = make_sampler(-1 - index, key, j, SOBOL)
        disc = square_to_disc(sample_2d(sampler, 0))
        w = kernel_weight(wp.min(wp.dot(disc, disc), 0.999999), look.shape)
        total = total + w
        along = (frame.s * disc[0] + frame.t * disc[1]) * radius - n * lift
        length = wp.length(along)
        d = along / length
        hit = closest_hit(scene, o, d)
        if hit.face >= 0:
            height = lift * wp.abs(1.0 - hit.t / length)
            same = wp.abs(wp.dot(scene.face_normals[hit.face], n)) > look.facing
            if same and height * height * (1.0 + look.stretch) < radius * radius:
                inside = inside + w
    return inside / total


@wp.func
def density(tree: SplatTree, scene: Scene, look: Lookup, x: wp.vec3, n: wp.vec3, guess2: float, key: int, index: int):
    """Irradiance at x on the side of n; `key` and `index` choose the probes, `guess2` helps the search, 0: nothing."""
    result = Density()
    if tree.count == 0:
        return result
    found = vec8()
    if look.neighbours > 0:
        found = nearest_photons(
            tree, x, n, look.neighbours, guess2, look.limit2, look.scale2, look.stretch, look.facing, look.shape
        )
        result.guess2 = GUESS_NEARBY * found[5]
    else:
        found = near_photons(tree, x, n, look.limit2 * look.scale2, look.stretch, look.facing, look.shape)
    result.radius2 = found[3]
    if found[4] > 0.0 and found[3] > 0.0:
        share = float(1.0)
        if look.probes > 0:
            share = share_on_surface(scene, look, x, n, wp.sqrt(found[3]), key, index)
            result.rays = look.probes + 1
            if share <= 0.0:
                share = 1.0  # nothing is known
            share = wp.max(share, LEAST_SHARE)
        result.irradiance = wp.vec3(found[0], found[1], found[2]) / (PI * found[3] * share)
    return result
