"""Splats whose light depends on direction: nearest neighbours of like direction, and the largest 4D filter at a ray.

Lehtinen et al. 2012, sections 2.2 and 2.4, as the specialised hierarchies of section 4: the splats' own tree resolves
visibility; another one, of lobes, knows bandwidths and finds radiance. A lobe's axis is its input ray mirrored at the
surface. On a plane mirrored rays differ as the rays themselves do; on a curved surface they say which rays meet its
highlights alike.
"""

import warp as wp

from warpgi.kernels.lanes import LANES_HEAD
from warpgi.kernels.splats import FIND_SURFACE, TENT_MEAN, SplatTree, search

wp.set_module_options({"enable_backward": False})

AXIS_STRIDE = wp.constant(32)  # axis x, y, z, kappa of eight lobes
CONE_STRIDE = wp.constant(56)  # smallest axis x, y, z of the eight children, largest, smallest kappa

vec13 = wp.types.vector(length=13, dtype=wp.float32)


# Squared distance to the k-th neighbour whose direction a lobe accepts: exp(kappa (cos - 1)) at least 0.5, and 0.75 of
# that again and again, down to 0.01, where fewer lie within `farthest2` in the metric; what the last try found counts.
# Below 0 where it found none.
NEAREST_ALIKE = (
    LANES_HEAD
    + """
    const int block0 = i / 8;
    const float* q = tree.blocks.data + (size_t)block0 * 80 + i % 8;
    const float cx = q[0], cy = q[8], cz = q[16], nx = q[24], ny = q[32], nz = q[40];
    const float* axis = axes.data + (size_t)block0 * 32 + i % 8;
    const float ax = axis[0], ay = axis[8], az = axis[16], kappa = axis[24];
    const int want = k - 1;
    float metric[32], plain[32];
    int found = 0;
    float threshold = 0.5f;
    while (true) {
        const float least = 1.0f + wp::log(threshold) / kappa;
        found = 0;
        float worst = farthest2;
"""
    + search(
        """
                    int slot = found < want ? found++ : want - 1;
                    while (slot > 0 && metric[slot - 1] > m2[j]) {
                        metric[slot] = metric[slot - 1];
                        plain[slot] = plain[slot - 1];
                        --slot;
                    }
                    metric[slot] = m2[j];
                    plain[slot] = d2[j];
                    if (found == want)
                        worst = metric[want - 1];
""",
        accept=" & (p[24 + j] * nx + p[32 + j] * ny + p[40 + j] * nz > 0.1f)"
        " & (a[j] * ax + a[8 + j] * ay + a[16 + j] * az >= least)",
        block="const float* a = axes.data + (size_t)block * 32;",
        node="const float* c = cones.data + (size_t)current * 56;",
        enter=" & (larger(ax * c[j], ax * c[24 + j]) + larger(ay * c[8 + j], ay * c[32 + j])"
        " + larger(az * c[16 + j], az * c[40 + j]) >= least)",
    )
    + """
        if (found == want || threshold <= 0.01f)
            break;
        threshold = larger(0.75f * threshold, 0.01f);
    }
    return found > 0 ? plain[found - 1] : -1.0f;
"""
)


@wp.func_native(NEAREST_ALIKE)
def nearest_alike_distance2(
    tree: SplatTree, axes: wp.array[float], cones: wp.array[float], i: int, k: int, stretch: float, farthest2: float
) -> float: ...


# The first apparent surface as `first_surface` finds it, with what glossy splats in it say of the place that the ray
# meets. Returns radiance times weight (3) and weight, of all splats; whether the gather was cut short, how many
# undersampled surfaces were passed through, the distance of a surface whose splats all face away, else 0; and of the
# glossy splats alone weight, distance times weight, normal times weight (3), and the heaviest one's place, as bits.
GLOSSY_SURFACE = (
    "    const float reach = 0.0f;\n"
    + FIND_SURFACE
    + TENT_MEAN
    + """
    float glossy = 0.0f, reached = 0.0f, x = 0.0f, y = 0.0f, z = 0.0f, heaviest = 0.0f;
    int heaviest_splat = -1;
    for (int j = 0; j < size; ++j) {
        if (t_of[j] < limit && (place[j] >= 0) == any_front) {
            const int splat = place[j] >= 0 ? place[j] : -1 - place[j];
            if (kappa.data[splat] > 0.0f) {
                const float w = 1.0f - wp::sqrt(e_of[j]);
                glossy += w;
                reached += w * t_of[j];
                x += w * gx[j];
                y += w * gy[j];
                z += w * gz[j];
                if (w >= heaviest) {
                    heaviest = w;
                    heaviest_splat = splat;
                }
            }
        }
    }
    wp::vec_t<13, wp::float32> result;
    result[0] = r; result[1] = g; result[2] = b; result[3] = weight;
    result[4] = (float)cut; result[5] = (float)surfaces_passed; result[6] = seen_behind;
    result[7] = glossy; result[8] = reached; result[9] = x; result[10] = y; result[11] = z;
    float bits;
    memcpy(&bits, &heaviest_splat, 4);
    result[12] = bits;
    return result;
"""
)


@wp.func_native(GLOSSY_SURFACE)
def glossy_surface(
    tree: SplatTree,
    kappa: wp.array[float],
    o: wp.vec3,
    d: wp.vec3,
    noise: float,
    keep_one: float,
    keep_two: float,
) -> vec13: ...


# The lobe whose 4D filter is largest at x for a ray along d that came `distance` far and is mirrored to `axis`: the
# anisotropic nearest neighbour of section 2.4; -1 where no lobe reaches. Its filter is exp(kappa (cos - 1)) times the
# spatial part min(1, tent / min(1, radius / distance)), as the authors' program has it; the tent's distance stretches
# along the lobe's normal like that of its neighbours. Boxes of axes bound the filters of what lies below a node, and
# the largest bound goes first.
LARGEST_LOBE = (
    LANES_HEAD
    + """
    int stack[128];
    float bound[128];
    int top = 1;
    stack[0] = 0;
    bound[0] = 1.0f;
    float best = -1.0e30f;  // of the filters' logarithms
    int largest = -1;
    while (top > 0) {
        --top;
        if (bound[top] <= best)
            continue;
        const int current = stack[top];
        if (current >= 0) {
            const float* p = tree.nodes.data + (size_t)current * 48;
            const float* c = cones.data + (size_t)current * 56;
            float most[8];
            int met[8];
            for (int k = 0; k < 8; ++k) {
                const float cosine = larger(axis[0] * c[k], axis[0] * c[24 + k])
                    + larger(axis[1] * c[8 + k], axis[1] * c[32 + k])
                    + larger(axis[2] * c[16 + k], axis[2] * c[40 + k]);
                most[k] = c[48 + k] * smaller(cosine - 1.0f, 0.0f);
                met[k] = (int)((x[0] >= p[k]) & (x[1] >= p[8 + k]) & (x[2] >= p[16 + k]) & (x[0] <= p[24 + k])
                    & (x[1] <= p[32 + k]) & (x[2] <= p[40 + k]) & (most[k] > best));
            }
            const int first = tree.first.data[current];
            const int base = top;
            unsigned mask = lane_mask(met);
            while (mask) {
                const int k = next_lane(mask);
                int slot = top++;
                while (slot > base && bound[slot - 1] > most[k]) {
                    bound[slot] = bound[slot - 1];
                    stack[slot] = stack[slot - 1];
                    --slot;
                }
                bound[slot] = most[k];
                stack[slot] = first >= 0 ? first + k : first - k;
                if (first < 0)
                    prefetch(tree.blocks.data + (size_t)(k - 1 - first) * 80);
                else
                    prefetch(tree.nodes.data + (size_t)(first + k) * 48);
            }
        } else {
            const int block = -1 - current;
            const float* p = tree.blocks.data + (size_t)block * 80;
            const float* a = axes.data + (size_t)block * 32;
            float part[8], angular[8];
            int met[8];
            for (int k = 0; k < 8; ++k) {
                const float dx = x[0] - p[k], dy = x[1] - p[8 + k], dz = x[2] - p[16 + k];
                const float nx = p[24 + k], ny = p[32 + k], nz = p[40 + k];
                const float along = dx * nx + dy * ny + dz * nz;
                const float m2 = dx * dx + dy * dy + dz * dz + stretch * along * along;
                const float facing = nx * d[0] + ny * d[1] + nz * d[2];
                const float alike = nx * n[0] + ny * n[1] + nz * n[2];
                const float cosine = a[k] * axis[0] + a[8 + k] * axis[1] + a[16 + k] * axis[2];
                angular[k] = a[24 + k] * smaller(cosine - 1.0f, 0.0f);
                part[k] = m2 / p[48 + k];
                met[k] = (int)((m2 < p[48 + k]) & (facing < 0.0f) & (alike > 0.5f) & (angular[k] > best));
            }
            unsigned mask = lane_mask(met);
            while (mask) {
                const int k = next_lane(mask);
                const float near = smaller(1.0f, wp::sqrt(p[48 + k]) / distance);
                const float spatial = smaller(1.0f, (1.0f - wp::sqrt(part[k])) / near);
                const float value = angular[k] + wp::log(larger(spatial, 1.0e-30f));
                if (value > best) {
                    best = value;
                    largest = block * 8 + k;
                }
            }
        }
    }
    return largest;
"""
)


@wp.func_native(LARGEST_LOBE)
def largest_lobe(
    tree: SplatTree,
    axes: wp.array[float],
    cones: wp.array[float],
    x: wp.vec3,
    n: wp.vec3,
    d: wp.vec3,
    axis: wp.vec3,
    distance: float,
    stretch: float,
) -> int: ...
