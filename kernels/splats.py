"""The splat hierarchy at work: nearest neighbours, shrinking, and the first apparent surface along a ray.

Lehtinen et al. 2012, sections 2.2 to 2.5. Eight splats or boxes are tested together in plain loops that a CPU's
compiler turns into vector instructions and a GPU runs as they are.
"""

import warp as wp

from warpgi.kernels.lanes import LANES_HEAD

wp.set_module_options({"enable_backward": False})

vec10 = wp.types.vector(length=10, dtype=wp.float32)


@wp.struct
class SplatTree:
    nodes: wp.array[float]
    first: wp.array[int]  # a node's first child: a node, or -1 - block; its others follow
    blocks: wp.array[float]
    count: int  # splats
    block_count: int


# Whose turn it is in a search: the blocks about `block0` (-1: none), which bound it, then what the stack holds that
# may be nearer than `worst`. What follows is for a block.
SEARCH_TURNS = """
    int stack[128];
    float entry[128];
    stack[0] = 0;
    entry[0] = 0.0f;
    int top = 1;
    const int begin = block0 > 0 ? block0 - 1 : 0;
    const int end = block0 < 0 ? -1 : (block0 + 1 < tree.block_count ? block0 + 1 : block0);
    int next = begin;
    while (true) {
        int block = -1, current = 0;
        if (next <= end) {
            block = next++;
        } else {
            if (top == 0)
                break;
            --top;
            if (entry[top] >= worst)
                continue;
            current = stack[top];
            if (current < 0) {
                block = -1 - current;
                if (block >= begin && block <= end)
                    continue;
            }
        }
        if (block >= 0) {
            const float* p = tree.blocks.data + (size_t)block * 80;
"""

# The search for what is nearest to (cx, cy, cz) in the metric |d|^2 + stretch (d.n)^2: every lane that ACCEPT takes and
# that is nearer than `worst` is handed to KEEP, which lowers `worst`. `block0` is where to begin, -1: at the root. NODE
# sees each node (`p`, and its `first` child) before its children, of which it enters those that ENTER takes; BLOCK sees
# each block before its lanes.
SEARCH_HEAD = (
    """
    // rows of a box's corners that lie lowest and highest along n
    const int lx = nx < 0.0f ? 24 : 0, ly = ny < 0.0f ? 32 : 8, lz = nz < 0.0f ? 40 : 16;
    const int hx = 24 - lx, hy = 40 - ly, hz = 56 - lz;
"""
    + SEARCH_TURNS
    + """            BLOCK
            float d2[8], m2[8];
            int met[8];
            for (int j = 0; j < 8; ++j) {
                const float dx = p[j] - cx, dy = p[8 + j] - cy, dz = p[16 + j] - cz;
                const float along = dx * nx + dy * ny + dz * nz;
                d2[j] = dx * dx + dy * dy + dz * dz;
                m2[j] = d2[j] + stretch * along * along;
                met[j] = (int)((p[48 + j] >= 0.0f)APART & (m2[j] < worst)ACCEPT);
            }
            unsigned mask = lane_mask(met);
            while (mask) {
                const int j = next_lane(mask);
                if (m2[j] < worst) {
"""
)
SEARCH_TAIL = """
                }
            }
        } else {
            const float* p = tree.nodes.data + (size_t)current * 48;
            const int first = tree.first.data[current];
            NODE
            float d2[8], m2[8];
            int met[8];
            for (int j = 0; j < 8; ++j) {
                const float dx = larger(larger(p[j] - cx, cx - p[24 + j]), 0.0f);
                const float dy = larger(larger(p[8 + j] - cy, cy - p[32 + j]), 0.0f);
                const float dz = larger(larger(p[16 + j] - cz, cz - p[40 + j]), 0.0f);
                d2[j] = dx * dx + dy * dy + dz * dz;
                // no corner of the box lies deeper below the plane, or higher above it, than these
                const float low = (p[lx + j] - cx) * nx + (p[ly + j] - cy) * ny + (p[lz + j] - cz) * nz;
                const float high = (p[hx + j] - cx) * nx + (p[hy + j] - cy) * ny + (p[hz + j] - cz) * nz;
                const float along = larger(larger(low, -high), 0.0f);
                m2[j] = d2[j] + stretch * along * along;
                met[j] = (int)((m2[j] < worst)ENTER);
            }
            const int base = top;
            unsigned mask = lane_mask(met);
            while (mask) {
                const int j = next_lane(mask);
                int slot = top++;
                while (slot > base && entry[slot - 1] < m2[j]) {
                    entry[slot] = entry[slot - 1];
                    stack[slot] = stack[slot - 1];
                    --slot;
                }
                entry[slot] = m2[j];
                stack[slot] = first >= 0 ? first + j : first - j;
            }
        }
    }
"""


def search(
    keep: str, accept: str = "", node: str = "", enter: str = "", block: str = "", at_centre: bool = False
) -> str:
    """Native code of the search: what to do with a lane and a further test of lanes; what to do at a node and a further
    test of its children; what to do at a block; whether what lies at the very centre is found too."""
    head, tail = SEARCH_HEAD, SEARCH_TAIL
    apart = "" if at_centre else " & (d2[j] > 0.0f)"
    for name, code in (("ACCEPT", accept), ("BLOCK", block), ("NODE", node), ("ENTER", enter), ("APART", apart)):
        head, tail = head.replace(name, code), tail.replace(name, code)
    return head + keep + tail


# Walks the boxes along a ray and hands each block that it meets beyond `start` and before `limit` on, nearest first.
WALK_HEAD = (
    LANES_HEAD
    + """
    const float rx = 1.0f / (wp::abs(d[0]) < 1.0e-30f ? 1.0e-30f : d[0]);
    const float ry = 1.0f / (wp::abs(d[1]) < 1.0e-30f ? 1.0e-30f : d[1]);
    const float rz = 1.0f / (wp::abs(d[2]) < 1.0e-30f ? 1.0e-30f : d[2]);
    const float ox = o[0] * rx, oy = o[1] * ry, oz = o[2] * rz;
    const int ax = rx < 0.0f ? 24 : 0, ay = ry < 0.0f ? 32 : 8, az = rz < 0.0f ? 40 : 16;
    const int bx = 24 - ax, by = 40 - ay, bz = 56 - az;
    int stack[128];
    float entry[128];
"""
)
WALK_LOOP = """
    int top = 1;
    stack[0] = 0;
    entry[0] = 0.0f;
    while (top > 0) {
        --top;
        if (entry[top] >= limit)
            continue;
        const int current = stack[top];
        if (current >= 0) {
            const float* p = tree.nodes.data + (size_t)current * 48;
            float near[8];
            int met[8];
            for (int k = 0; k < 8; ++k) {
                const float enter = larger(
                    larger(p[ax + k] * rx - ox, p[ay + k] * ry - oy), larger(p[az + k] * rz - oz, start));
                const float leave = smaller(
                    smaller(p[bx + k] * rx - ox, p[by + k] * ry - oy), smaller(p[bz + k] * rz - oz, limit));
                near[k] = enter;
                met[k] = enter <= leave * 1.0000004f ? 1 : 0;
            }
            const int first = tree.first.data[current];
            const int base = top;
            unsigned mask = lane_mask(met);
            while (mask) {
                const int k = next_lane(mask);
                int slot = top++;
                while (slot > base && entry[slot - 1] < near[k]) {
                    entry[slot] = entry[slot - 1];
                    stack[slot] = stack[slot - 1];
                    --slot;
                }
                entry[slot] = near[k];
                stack[slot] = first >= 0 ? first + k : first - k;
                // it waits for its turn on the stack, which hides some of the latency of memory
                if (first < 0)
                    prefetch(tree.blocks.data + (size_t)(k - 1 - first) * 80);
                else
                    prefetch(tree.nodes.data + (size_t)(first + k) * 48);
            }
        } else {
            const int block = -1 - current;
            const float* p = tree.blocks.data + (size_t)block * 80;
"""
WALK_TAIL = """
        }
    }
"""

# Shrinking, section 2.3.1: a splat that an input ray crosses between its ends is no larger than the crossing's
# distance. Radii are read from the tree and the new ones go to a slot of their own, where only the least counts, so
# that neither the order of rays nor the number of threads matters.
SHRINK = (
    WALK_HEAD
    + "    const float start = margin, limit = length - margin;\n    int crossed = 0;\n"
    + WALK_LOOP
    + """
            float e2[8];
            int met[8];
            for (int k = 0; k < 8; ++k) {
                const float dx = p[k] - o[0], dy = p[8 + k] - o[1], dz = p[16 + k] - o[2];
                const float nx = p[24 + k], ny = p[32 + k], nz = p[40 + k];
                const float t = (dx * nx + dy * ny + dz * nz) / (nx * d[0] + ny * d[1] + nz * d[2]);
                const float ex = t * d[0] - dx, ey = t * d[1] - dy, ez = t * d[2] - dz;
                e2[k] = ex * ex + ey * ey + ez * ez;
                met[k] = (int)((e2[k] < p[48 + k]) & (t > margin) & (t < limit));
            }
            unsigned mask = lane_mask(met);
            while (mask) {
                const int k = next_lane(mask);
                if (block * 8 + k != own) {
                    ++crossed;
                    if (slot >= 0)
                        wp::atomic_min(radius2, slot * tree.count + block * 8 + k, e2[k]);
                }
            }
"""
    + WALK_TAIL
    + "    return crossed;\n"
)


@wp.func_native(SHRINK)
def shrink_crossed(
    tree: SplatTree,
    o: wp.vec3,
    d: wp.vec3,
    length: float,
    margin: float,
    own: int,
    slot: int,
    radius2: wp.array[float],
) -> int: ...


# The first apparent surface along a ray, section 2.3.2: the gathered splats in front of the nearest conflict. A pair
# conflicts where its event line meets the st plane in the positive, or in the negative, half-spaces of both (with the
# authors' erratum); that is a b depth_i depth_j > 0 for a = (h_j - h_i).n_i and b = (h_j - h_i).n_j. Of two that face
# to opposite sides one normal is turned, or no back would hide what lies beyond it. They do not conflict where either
# is nearer to the other's plane than the smaller radius, as the two sides of something thin are, nor where the back is
# met in the outer half of its radius, which juts out over the edges of closed bodies.
# `keep_one` and `keep_two` are squared parts of their radius that splats keep which are alone, or two, in the surface.
# What follows finds `size` splats, of which those with t_of < limit, `inside` of them, are the surface.
FIND_SURFACE = (
    WALK_HEAD
    + """
    float hx[72], hy[72], hz[72], gx[72], gy[72], gz[72], depth[72], side[72], t_of[72], e_of[72];
    for (int j = 0; j < 72; ++j)
        hx[j] = hy[j] = hz[j] = gx[j] = gy[j] = gz[j] = depth[j] = side[j] = e_of[j] = 0.0f;
    const float start = 0.0f, slack_noise2 = 16.0f * noise * noise;
    int place[64];
    int passed[16];
    int passed_count = 0, surfaces_passed = 0, cut = 0;
    int size = 0, inside = 0;
    float limit = 1.0e30f;
    while (true) {
        size = 0;
        limit = 1.0e30f;
"""
    + WALK_LOOP
    + """
            float t[8], e2[8], along[8], facing[8];
            int met[8];
            for (int k = 0; k < 8; ++k) {
                const float dx = p[k] - o[0], dy = p[8 + k] - o[1], dz = p[16 + k] - o[2];
                const float nx = p[24 + k], ny = p[32 + k], nz = p[40 + k], r2 = p[48 + k];
                const float plane = dx * nx + dy * ny + dz * nz;
                facing[k] = nx * d[0] + ny * d[1] + nz * d[2];
                along[k] = dx * d[0] + dy * d[1] + dz * d[2];
                t[k] = plane / facing[k];
                const float ex = t[k] * d[0] - dx, ey = t[k] * d[1] - dy, ez = t[k] * d[2] - dz;
                e2[k] = ex * ex + ey * ey + ez * ez;
                // a splat in whose plane the ray starts is the receiver's own surface; one seen from behind and
                // nearer than its radius is the same surface where it bends away
                const bool own = plane * plane <= 1.0e-6f * r2 + noise * noise;
                const bool bent = (facing[k] > 0.0f) & (along[k] * wp::abs(along[k]) < r2);
                met[k] = (int)((e2[k] < r2) & (t[k] > 0.0f) & (t[k] < limit) & !own & !bent);
            }
            unsigned mask = lane_mask(met);
            while (mask) {
                const int k = next_lane(mask);
                if (t[k] >= limit)
                    continue;
                const int splat = block * 8 + k;
                bool skip = false;
                for (int j = 0; j < passed_count; ++j)
                    skip = skip | (passed[j] == splat);
                if (skip)
                    continue;
                if (size == 64) {
                    // forget what lies behind the limit
                    int kept = 0, farthest = 0;
                    for (int j = 0; j < 64; ++j) {
                        if (t_of[j] < limit) {
                            hx[kept] = hx[j]; hy[kept] = hy[j]; hz[kept] = hz[j];
                            gx[kept] = gx[j]; gy[kept] = gy[j]; gz[kept] = gz[j];
                            depth[kept] = depth[j]; side[kept] = side[j]; t_of[kept] = t_of[j];
                            e_of[kept] = e_of[j]; place[kept] = place[j];
                            farthest = t_of[kept] > t_of[farthest] ? kept : farthest;
                            ++kept;
                        }
                    }
                    size = kept;
                    if (size == 64) {
                        // nothing does: the nearest 64 stand for the surface
                        cut = 1;
                        if (t[k] >= t_of[farthest])
                            continue;
                        --size;
                        hx[farthest] = hx[size]; hy[farthest] = hy[size]; hz[farthest] = hz[size];
                        gx[farthest] = gx[size]; gy[farthest] = gy[size]; gz[farthest] = gz[size];
                        depth[farthest] = depth[size]; side[farthest] = side[size]; t_of[farthest] = t_of[size];
                        e_of[farthest] = e_of[size]; place[farthest] = place[size];
                    }
                }
                const float px = p[k], py = p[8 + k], pz = p[16 + k];
                const float nx = p[24 + k], ny = p[32 + k], nz = p[40 + k];
                const float far = along[k], e = e2[k] / p[48 + k];
                const float turned = facing[k] < 0.0f ? p[48 + k] : -p[48 + k];
                // eight at a time; lanes past the end hold old samples whose t is put beyond any limit
                float first_conflict[8];
                for (int c = 0; c < 8; ++c)
                    first_conflict[c] = limit;
                if (size % 8 == 0) {
                    for (int c = 0; c < 8; ++c)
                        t_of[size + c] = 1.0e30f;
                }
                for (int j = 0; j < size; j += 8) {
                    for (int c = 0; c < 8; ++c) {
                        const float dx = px - hx[j + c], dy = py - hy[j + c], dz = pz - hz[j + c];
                        const float a = dx * gx[j + c] + dy * gy[j + c] + dz * gz[j + c];
                        const float b = dx * nx + dy * ny + dz * nz;
                        const float slack2 = 1.0e-4f * (dx * dx + dy * dy + dz * dz) + slack_noise2;
                        const bool same_side = (side[j + c] > 0.0f) == (turned > 0.0f);
                        const float thick2 = smaller(wp::abs(side[j + c]), wp::abs(turned));
                        const float least2 = same_side ? slack2 : larger(slack2, thick2);
                        const bool inner = same_side | ((turned > 0.0f ? e_of[j + c] : e) < 0.25f);
                        const bool conflict = ((a * b * (depth[j + c] * far) > 0.0f) == same_side) & (a * a > least2) &
                            (b * b > least2) & inner;
                        const float both = larger(t_of[j + c], t[k]);
                        first_conflict[c] = smaller(first_conflict[c], conflict ? both : 1.0e30f);
                    }
                }
                for (int c = 0; c < 8; ++c)
                    limit = smaller(limit, first_conflict[c]);
                hx[size] = px; hy[size] = py; hz[size] = pz;
                gx[size] = nx; gy[size] = ny; gz[size] = nz;
                depth[size] = far; side[size] = turned; t_of[size] = t[k];
                e_of[size] = e;
                place[size] = facing[k] < 0.0f ? splat : -1 - splat;
                ++size;
            }
"""
    + WALK_TAIL
    + """
        // one or two splats before something else may be too few to trust their size (section 2.5)
        inside = 0;
        float closest = 1.0f;
        for (int j = 0; j < size; ++j) {
            if (t_of[j] < limit) {
                ++inside;
                closest = smaller(closest, e_of[j]);
            }
        }
        if (keep_one >= 1.0f || inside == 0 || inside > 2 || limit >= 1.0e30f || passed_count + inside > 16)
            break;
        if (closest <= (inside == 1 ? keep_one : keep_two))
            break;
        for (int j = 0; j < size; ++j) {
            if (t_of[j] < limit)
                passed[passed_count++] = place[j] >= 0 ? place[j] : -1 - place[j];
        }
        ++surfaces_passed;
    }
"""
)
# The tent-weighted mean of the surface's radiance.
TENT_MEAN = """
    bool any_front = false;
    for (int j = 0; j < size; ++j)
        any_front = any_front | ((t_of[j] < limit) & (place[j] >= 0));
    float r = 0.0f, g = 0.0f, b = 0.0f, weight = 0.0f, within = 0.0f, distance = 0.0f;
    for (int j = 0; j < size; ++j) {
        // splats seen from behind give radiance only where all of the surface is (section 2.5)
        if (t_of[j] < limit && (place[j] >= 0) == any_front) {
            const int splat = place[j] >= 0 ? place[j] : -1 - place[j];
            const float* q = tree.blocks.data + (size_t)(splat / 8) * 80 + splat % 8;
            const float w = 1.0f - wp::sqrt(e_of[j]);
            r += w * q[56];
            g += w * q[64];
            b += w * q[72];
            weight += w;
            within += t_of[j] < reach ? w : 0.0f;
            distance += w * t_of[j];
        }
    }
    float seen_behind = 0.0f;
    if (!any_front && inside > 0) {
        seen_behind = 1.0e30f;
        for (int j = 0; j < size; ++j)
            seen_behind = smaller(seen_behind, t_of[j]);
    }
"""
# Returns radiance times weight (3), weight, weight of splats nearer than `reach`, splats in the surface, whether
# the gather was cut short, how many undersampled surfaces were passed through, the distance of a surface whose
# splats all face away, else 0, and the surface's weighted distance times weight.
SURFACE = (
    FIND_SURFACE
    + TENT_MEAN
    + """
    wp::vec_t<10, wp::float32> result;
    result[0] = r; result[1] = g; result[2] = b; result[3] = weight; result[4] = within;
    result[5] = (float)inside; result[6] = (float)cut; result[7] = (float)surfaces_passed;
    result[8] = seen_behind; result[9] = distance;
    return result;
"""
)


@wp.func_native(SURFACE)
def first_surface(
    tree: SplatTree, o: wp.vec3, d: wp.vec3, noise: float, reach: float, keep_one: float, keep_two: float
) -> vec10: ...


# The splat nearest to x among those that face a ray along d; -1 if none does.
NEAREST_FACING = (
    LANES_HEAD
    + """
    const int block0 = -1;
    const float cx = x[0], cy = x[1], cz = x[2], nx = 0.0f, ny = 0.0f, nz = 0.0f, stretch = 0.0f;
    float worst = 1.0e30f;
    int nearest = -1;
"""
    + search(
        """
                    worst = m2[j];
                    nearest = block * 8 + j;
""",
        accept=" & (p[24 + j] * d[0] + p[32 + j] * d[1] + p[40 + j] * d[2] < 0.0f)",
    )
    + "    return nearest;\n"
)


@wp.func_native(NEAREST_FACING)
def nearest_facing(tree: SplatTree, x: wp.vec3, d: wp.vec3) -> int: ...


@wp.func
def splat_radiance(tree: SplatTree, splat: int):
    at = (splat // 8) * 80 + splat % 8 + 56
    return wp.vec3(tree.blocks[at], tree.blocks[at + 8], tree.blocks[at + 16])
