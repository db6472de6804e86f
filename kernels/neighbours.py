"""Sizes of splats by their nearest neighbours (Lehtinen et al. 2012, section 2.2).

The eight splats of a block search together: they want much the same part of the tree, and each candidate is held
against all eight at once.
"""

import warp as wp

from warpgi.kernels.lanes import LANES_HEAD
from warpgi.kernels.splats import SEARCH_TURNS, SplatTree

wp.set_module_options({"enable_backward": False})

MAX_NEIGHBOURS = 32  # one more than the rows in NEAREST

# Squared distance to the k-th neighbour in the metric |d|^2 + stretch (d.n)^2, the sample itself counted, and in
# Euclid's; samples at the very same place are not neighbours, or they would vanish, nor are those that face elsewhere:
# they are of another surface, or of the other side of something thin.
NEAREST = (
    LANES_HEAD
    + """
    const float* q = tree.blocks.data + (size_t)block0 * 80;
    const int want = k - 1;
    // row j holds the j-th neighbour of each splat so far, row 0 stands before the first
    float metric[8 * 32], plain[8 * 32];
    for (int j = 0; j <= want; ++j) {
        for (int c = 0; c < 8; ++c) {
            metric[8 * j + c] = j == 0 || q[48 + c] < 0.0f ? -1.0f : 1.0e30f;
            plain[8 * j + c] = -1.0f;
        }
    }
    const float* kth = metric + 8 * want;
    float worst = 1.0e30f;
    float from[3], to[3]; // bounds of the eight
    for (int axis = 0; axis < 3; ++axis) {
        from[axis] = to[axis] = q[8 * axis];
        for (int c = 1; c < 8; ++c) {
            const float x = q[8 * axis + (q[48 + c] < 0.0f ? 0 : c)];
            from[axis] = smaller(from[axis], x);
            to[axis] = larger(to[axis], x);
        }
    }
"""
    + SEARCH_TURNS
    + """
            for (int j = 0; j < 8 && p[48 + j] >= 0.0f; ++j) {
                float d2[8], m2[8];
                int met[8];
                for (int c = 0; c < 8; ++c) {
                    const float dx = p[j] - q[c], dy = p[8 + j] - q[8 + c], dz = p[16 + j] - q[16 + c];
                    const float along = dx * q[24 + c] + dy * q[32 + c] + dz * q[40 + c];
                    const float facing = p[24 + j] * q[24 + c] + p[32 + j] * q[32 + c] + p[40 + j] * q[40 + c];
                    d2[c] = dx * dx + dy * dy + dz * dz;
                    m2[c] = d2[c] + stretch * along * along;
                    met[c] = (int)((d2[c] > 0.0f) & (m2[c] < kth[c]) & (facing > 0.1f));
                }
                if (lane_mask(met) == 0u)
                    continue;
                for (int c = 0; c < 8; ++c)
                    m2[c] = met[c] ? m2[c] : 1.0e30f;
                // into its row; what lies beyond moves on by one
                for (int row = want; row > 0; --row) {
                    float at[8], of[8], at_before[8], of_before[8];
                    for (int c = 0; c < 8; ++c) {
                        at[c] = metric[8 * row + c];
                        of[c] = plain[8 * row + c];
                        at_before[c] = metric[8 * row - 8 + c];
                        of_before[c] = plain[8 * row - 8 + c];
                    }
                    for (int c = 0; c < 8; ++c) {
                        const float moved = at_before[c] > m2[c] ? of_before[c] : d2[c];
                        plain[8 * row + c] = at[c] > m2[c] ? moved : of[c];
                        metric[8 * row + c] = smaller(at[c], larger(at_before[c], m2[c]));
                    }
                }
            }
            worst = kth[0];
            for (int c = 1; c < 8; ++c)
                worst = larger(worst, kth[c]);
        } else {
            const float* p = tree.nodes.data + (size_t)current * 48;
            const int first = tree.first.data[current];
            int met[8];
            for (int j = 0; j < 8; ++j) {
                const float dx = larger(larger(p[j] - to[0], from[0] - p[24 + j]), 0.0f);
                const float dy = larger(larger(p[8 + j] - to[1], from[1] - p[32 + j]), 0.0f);
                const float dz = larger(larger(p[16 + j] - to[2], from[2] - p[40 + j]), 0.0f);
                met[j] = (int)(dx * dx + dy * dy + dz * dz < worst);
            }
            const int base = top;
            unsigned mask = lane_mask(met);
            while (mask) {
                const int j = next_lane(mask);
                float bound[8];
                for (int c = 0; c < 8; ++c) {
                    const float ax = p[j] - q[c], ay = p[8 + j] - q[8 + c], az = p[16 + j] - q[16 + c];
                    const float bx = p[24 + j] - q[c], by = p[32 + j] - q[8 + c], bz = p[40 + j] - q[16 + c];
                    const float dx = larger(larger(ax, -bx), 0.0f);
                    const float dy = larger(larger(ay, -by), 0.0f);
                    const float dz = larger(larger(az, -bz), 0.0f);
                    // no corner of the box lies deeper below the splat's plane, or higher above it
                    const float nx = q[24 + c], ny = q[32 + c], nz = q[40 + c];
                    const float low =
                        smaller(ax * nx, bx * nx) + smaller(ay * ny, by * ny) + smaller(az * nz, bz * nz);
                    const float high =
                        larger(ax * nx, bx * nx) + larger(ay * ny, by * ny) + larger(az * nz, bz * nz);
                    const float along = larger(larger(low, -high), 0.0f);
                    const float least = dx * dx + dy * dy + dz * dz + stretch * along * along;
                    bound[c] = least < kth[c] ? least : 1.0e30f;
                }
                float nearest = bound[0];
                for (int c = 1; c < 8; ++c)
                    nearest = smaller(nearest, bound[c]);
                if (nearest >= 1.0e30f)
                    continue;
                int slot = top++;
                while (slot > base && entry[slot - 1] < nearest) {
                    entry[slot] = entry[slot - 1];
                    stack[slot] = stack[slot - 1];
                    --slot;
                }
                entry[slot] = nearest;
                stack[slot] = first >= 0 ? first + j : first - j;
            }
        }
    }
    for (int c = 0; c < 8 && q[48 + c] >= 0.0f; ++c) {
        int row = want;
        while (row > 0 && metric[8 * row + c] >= 1.0e30f)
            --row;
        distance2.data[8 * block0 + c] = plain[8 * row + c];
    }
"""
)


@wp.func_native(NEAREST)
def find_nearest(tree: SplatTree, block0: int, k: int, stretch: float, distance2: wp.array[float]): ...


@wp.kernel
def nearest_distances(offset: int, tree: SplatTree, k: int, stretch: float, distance2: wp.array[float]):
    """One thread owns a block and finds each splat's squared distance to its k-th neighbour, itself counted; -1: none.

    The fewer there are the nearer the last of them.
    """
    find_nearest(tree, offset + wp.tid(), k, stretch, distance2)
