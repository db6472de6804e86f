"""Rays against triangles: a tree of eight children a node and eight triangles a leaf, walked nearest first.

Both tests run over eight lanes in plain loops that a CPU's compiler turns into vector instructions and a GPU runs as
they are. The triangle test is watertight (Woop, Benthin, Wald 2013) and the box test is conservative (Ize 2013), so
that no ray slips through the edge between two triangles. Where something moves, boxes and corners are those at the
ray's time, linear between their places at both ends of the shutter (Glassner 1988); a still scene has its own walk.
"""

import warp as wp

from warpgi.kernels.lanes import LANES_HEAD

wp.set_module_options({"enable_backward": False})

WIDTH = 8
NODE_FLOATS = 6 * WIDTH  # smallest x, y, z of the children, then largest
BLOCK_FLOATS = 9 * WIDTH  # x, y, z of the triangles' first corner, second, third

# A node leaves at most seven of its children behind on the stack.
STACK_SIZE = 192
MAX_TREE_DEPTH = (STACK_SIZE - 1) // (WIDTH - 1)


@wp.struct
class TriangleTree:
    nodes: wp.array[float]  # NODE_FLOATS a node; an unused child has an empty box
    children: wp.array[int]  # WIDTH a node: a node, or -1 - block
    blocks: wp.array[float]  # BLOCK_FLOATS a leaf; an unused triangle has no area
    faces: wp.array[int]  # WIDTH a leaf: number of the triangle, -1 where unused
    node_motion: wp.array[float]  # of `nodes` and `blocks` from time 0 to 1; both empty where all is still
    block_motion: wp.array[float]


STILL_NODE = "const float* p = tree.nodes.data + (size_t)current * 48;"
STILL_BLOCK = "const float* p = tree.blocks.data + (size_t)block * 72;"
MOVING = """float p[{count}];
            {{
                const float* from = tree.{name}s.data + (size_t){index} * {count};
                const float* shift = tree.{name}_motion.data + (size_t){index} * {count};
                for (int k = 0; k < {count}; ++k)
                    p[k] = from[k] + time * shift[k];
            }}"""

# Returns (t, u, v, bits of the face's number); the face is -1 where nothing is hit. With `any_hit` the first hit found
# ends the walk, and t, u, v are not of the nearest.
WALK = (
    LANES_HEAD
    + """
    const int KX[3] = {1, 2, 0}, KY[3] = {2, 0, 1};
    const float ad0 = wp::abs(d[0]), ad1 = wp::abs(d[1]), ad2 = wp::abs(d[2]);
    const int kz = ad0 > ad1 ? (ad0 > ad2 ? 0 : 2) : (ad1 > ad2 ? 1 : 2);
    const bool turned = d[kz] < 0.0f;
    const int kx = turned ? KY[kz] : KX[kz];
    const int ky = turned ? KX[kz] : KY[kz];
    const float sz = 1.0f / d[kz], sx = d[kx] * sz, sy = d[ky] * sz;
    const float ox = o[kx], oy = o[ky], oz = o[kz];

    // a direction of 0 becomes one so small that its slab is left at once or never
    const float rx = 1.0f / (wp::abs(d[0]) < 1.0e-30f ? 1.0e-30f : d[0]);
    const float ry = 1.0f / (wp::abs(d[1]) < 1.0e-30f ? 1.0e-30f : d[1]);
    const float rz = 1.0f / (wp::abs(d[2]) < 1.0e-30f ? 1.0e-30f : d[2]);
    const int nx = rx < 0.0f ? 24 : 0, ny = ry < 0.0f ? 32 : 8, nz = rz < 0.0f ? 40 : 16;
    const int fx = 24 - nx, fy = 40 - ny, fz = 56 - nz;

    int stack[192];
    float entry[192];
    int top = 0;
    int current = 0;
    float best = t_max, best_u = 0.0f, best_v = 0.0f;
    int best_face = -1;
    while (true) {
        if (current >= 0) {
            """
    + STILL_NODE
    + """
            const int* kids = tree.children.data + (size_t)current * 8;
            float near[8];
            int met[8];
            for (int k = 0; k < 8; ++k) {
                const float a = (p[nx + k] - o[0]) * rx, b = (p[ny + k] - o[1]) * ry, c = (p[nz + k] - o[2]) * rz;
                const float e = (p[fx + k] - o[0]) * rx, f = (p[fy + k] - o[1]) * ry, g = (p[fz + k] - o[2]) * rz;
                const float enter = wp::max(wp::max(a, b), wp::max(c, 0.0f));
                const float leave = wp::min(wp::min(e, f), wp::min(g, best)) * 1.0000004f;
                near[k] = enter;
                met[k] = enter <= leave ? 1 : 0;
            }
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
                stack[slot] = kids[k];
            }
        } else {
            const int block = -1 - current;
            """
    + STILL_BLOCK
    + """
            const float *ax_ = p + kx * 8, *ay_ = p + ky * 8, *az_ = p + kz * 8;
            float t[8], u[8], v[8];
            int met[8];
            for (int k = 0; k < 8; ++k) {
                const float az = az_[k] - oz, bz = az_[24 + k] - oz, cz = az_[48 + k] - oz;
                const float ax = (ax_[k] - ox) - sx * az, ay = (ay_[k] - oy) - sy * az;
                const float bx = (ax_[24 + k] - ox) - sx * bz, by = (ay_[24 + k] - oy) - sy * bz;
                const float cx = (ax_[48 + k] - ox) - sx * cz, cy = (ay_[48 + k] - oy) - sy * cz;
                // differences of products with the rounding of one of them taken back (Kahan): their signs are right
                const float m0 = cy * bx, m1 = ay * cx, m2 = by * ax;
                const float w0 = fmaf(cx, by, -m0) + fmaf(-cy, bx, m0);
                const float w1 = fmaf(ax, cy, -m1) + fmaf(-ay, cx, m1);
                const float w2 = fmaf(bx, ay, -m2) + fmaf(-by, ax, m2);
                const float low = wp::min(wp::min(w0, w1), w2), high = wp::max(wp::max(w0, w1), w2);
                const float det = w0 + w1 + w2;
                const float inv = 1.0f / det;
                t[k] = (w0 * az + w1 * bz + w2 * cz) * (sz * inv);
                u[k] = w0 * inv;
                v[k] = w1 * inv;
                met[k] = (int)(((low >= 0.0f) | (high <= 0.0f)) & (det != 0.0f) & (t[k] > 0.0f) & (t[k] < best));
            }
            unsigned mask = lane_mask(met);
            while (mask) {
                const int k = next_lane(mask);
                if (t[k] < best) {
                    best = t[k];
                    best_u = u[k];
                    best_v = v[k];
                    best_face = tree.faces.data[(size_t)block * 8 + k];
                }
            }
            if (any_hit && best_face >= 0)
                break;
        }
        do {
            if (top == 0)
                goto done;
            --top;
        } while (entry[top] > best);
        current = stack[top];
    }
done:
    float bits;
    memcpy(&bits, &best_face, 4);
    return wp::vec4(best, best_u, best_v, bits);
"""
)


@wp.func_native(WALK)
def walk(tree: TriangleTree, o: wp.vec3, d: wp.vec3, t_max: float, any_hit: int) -> wp.vec4: ...


_IN_MOTION = WALK.replace(STILL_NODE, MOVING.format(name="node", index="current", count=48)).replace(
    STILL_BLOCK, MOVING.format(name="block", index="block", count=72)
)
# Kept out of line: where all is still, its code must not take room and registers in the loops about the other walk.
WALK_MOVING = f"""const auto moving = [&]() __attribute__((noinline)) -> wp::vec4 {{
{_IN_MOTION}
}};
return moving();
"""


@wp.func_native(WALK_MOVING)
def walk_moving(tree: TriangleTree, o: wp.vec3, d: wp.vec3, t_max: float, any_hit: int, time: float) -> wp.vec4: ...
