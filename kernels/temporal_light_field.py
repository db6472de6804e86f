"""Temporal light field reconstruction (Lehtinen et al. 2011): samples moved along their screen-space trajectories.

A sample seen at film position p_i through lens point (u_i, v_i) at time t_i is seen through (u, v) at t at
p_i + c_i (u - u_i, v_i - v) + m_i (t - t_i), c_i being its circle of confusion and m_i its motion over the screen.
Lens and time are counted from the lens's centre and from 1/2. A tree of eight children a node bounds these lines.
"""

import warp as wp

from warpgi.kernels.lanes import LANES_HEAD
from warpgi.kernels.lens import Lens, LensSums, lens_ray

wp.set_module_options({"enable_backward": False})

LANES = wp.constant(8)
ROWS = wp.constant(10)
STRIDE = wp.constant(80)  # of a node: least x, y, c, motion x, y, then largest; of a block: see `fill_lines`
EMPTY = wp.constant(1.0e30)

vec8 = wp.types.vector(length=8, dtype=wp.float32)


@wp.struct
class LineTree:
    nodes: wp.array[float]
    first: wp.array[int]  # a node's first child: a node, or -1 - block; its others follow
    blocks: wp.array[float]


@wp.struct
class Lines:
    """Trajectories of the samples, in their own order."""

    place: wp.array[wp.vec3]  # x, y at the lens's centre and time 1/2 [pixels]; circle of confusion [pixels]
    motion: wp.array[wp.vec3]  # of x, y [pixels] and of depth while the shutter is open
    depth: wp.array[float]  # at time 1/2
    radiance: wp.array[wp.vec3]


@wp.kernel
def fill_lines(offset: int, lines: Lines, order: wp.array[int], count: int, blocks: wp.array[float]):
    """One thread writes one lane: x, y, c, motion x, y, depth, its motion, r, g, b; unused ones lie far outside."""
    i = offset + wp.tid()
    place = (i // LANES) * STRIDE + i % LANES
    if i < count:
        j = order[i]
        for axis in range(3):
            blocks[place + axis * LANES] = lines.place[j][axis]
            blocks[place + (7 + axis) * LANES] = lines.radiance[j][axis]
        blocks[place + 3 * LANES] = lines.motion[j][0]
        blocks[place + 4 * LANES] = lines.motion[j][1]
        blocks[place + 5 * LANES] = lines.depth[j]
        blocks[place + 6 * LANES] = lines.motion[j][2]
    else:
        for row in range(ROWS):
            blocks[place + row * LANES] = 0.0
        blocks[place] = EMPTY


@wp.kernel
def bound_blocks(offset: int, blocks: wp.array[float], block_count: int, first_node: int, nodes: wp.array[float]):
    """One thread owns a node of the lowest level: the bounds of its eight blocks' lines."""
    i = offset + wp.tid()
    for child in range(LANES):
        block = i * LANES + child
        for row in range(5):
            low = float(EMPTY)
            high = float(-EMPTY)
            if block < block_count:
                for lane in range(LANES):
                    place = block * STRIDE + lane
                    if blocks[place] < EMPTY:
                        low = wp.min(low, blocks[place + row * LANES])
                        high = wp.max(high, blocks[place + row * LANES])
            place = (first_node + i) * STRIDE + child
            nodes[place + row * LANES] = low
            nodes[place + (5 + row) * LANES] = high


@wp.kernel
def bound_level(offset: int, first_node: int, first_below: int, count_below: int, nodes: wp.array[float]):
    """One thread owns a node: the bounds of its eight children are those of theirs."""
    i = offset + wp.tid()
    for child in range(LANES):
        below = i * LANES + child
        for row in range(5):
            low = float(EMPTY)
            high = float(-EMPTY)
            if below < count_below:
                place = (first_below + below) * STRIDE
                for lane in range(LANES):
                    low = wp.min(low, nodes[place + row * LANES + lane])
                    high = wp.max(high, nodes[place + (5 + row) * LANES + lane])
            place = (first_node + i) * STRIDE + child
            nodes[place + row * LANES] = low
            nodes[place + (5 + row) * LANES] = high


# Gathers the samples within `radius` of (x, y), seen through (u, v) at `time` from 1/2, sorts them by depth and groups
# them into apparent surfaces: a sample that crosses one of the open surface somewhere on the lens and in the shutter's
# time starts the next. The first surface with the place inside the hull of its samples answers, else the last.
# Returns radiance times weight (3), weight, samples in the surface, and whether the gather was cut short.
GATHER = (
    LANES_HEAD
    + """
    const int most = 96;
    float px[96], py[96], away[96];
    int who[96];
    float depth[96];
    int size = 0, cut = 0;
    int stack[128];
    int top = 1;
    stack[0] = 0;
    const float r2 = radius * radius;
    while (top > 0) {
        const int current = stack[--top];
        if (current >= 0) {
            const float* p = tree.nodes.data + (size_t)current * 80;
            int met[8];
            for (int k = 0; k < 8; ++k) {
                const float c0 = p[16 + k], c1 = p[56 + k];
                const float x0 = p[k] + smaller(c0 * u, c1 * u) + smaller(p[24 + k] * time, p[64 + k] * time);
                const float x1 = p[40 + k] + larger(c0 * u, c1 * u) + larger(p[24 + k] * time, p[64 + k] * time);
                const float y0 = p[8 + k] - larger(c0 * v, c1 * v) + smaller(p[32 + k] * time, p[72 + k] * time);
                const float y1 = p[48 + k] - smaller(c0 * v, c1 * v) + larger(p[32 + k] * time, p[72 + k] * time);
                met[k] = (int)((p[k] <= p[40 + k]) & (x0 - radius <= x) & (x <= x1 + radius) & (y0 - radius <= y) &
                               (y <= y1 + radius));
            }
            const int first = tree.first.data[current];
            unsigned mask = lane_mask(met);
            while (mask) {
                const int k = next_lane(mask);
                stack[top++] = first >= 0 ? first + k : first - k;
            }
        } else {
            const int block = -1 - current;
            const float* p = tree.blocks.data + (size_t)block * 80;
            float dx[8], dy[8], d2[8];
            int met[8];
            for (int k = 0; k < 8; ++k) {
                dx[k] = p[k] + p[16 + k] * u + p[24 + k] * time - x;
                dy[k] = p[8 + k] - p[16 + k] * v + p[32 + k] * time - y;
                d2[k] = dx[k] * dx[k] + dy[k] * dy[k];
                met[k] = (int)(d2[k] < r2);
            }
            unsigned mask = lane_mask(met);
            while (mask) {
                const int k = next_lane(mask);
                if (size == most) {
                    cut = 1;
                    continue;
                }
                const float z = p[40 + k] + p[48 + k] * time;
                int slot = size++;
                while (slot > 0 && depth[slot - 1] > z) {
                    depth[slot] = depth[slot - 1]; px[slot] = px[slot - 1]; py[slot] = py[slot - 1];
                    away[slot] = away[slot - 1]; who[slot] = who[slot - 1];
                    --slot;
                }
                depth[slot] = z; px[slot] = dx[k]; py[slot] = dy[k]; away[slot] = d2[k];
                who[slot] = block * 8 + k;
            }
        }
    }
    int begin = 0, end = 0;
    while (begin < size) {
        for (end = begin + 1; end < size; ++end) {
            const float* q = tree.blocks.data + (size_t)(who[end] / 8) * 80 + who[end] % 8;
            bool crosses = false;
            for (int j = begin; j < end && !crosses; ++j) {
                const float* p = tree.blocks.data + (size_t)(who[j] / 8) * 80 + who[j] % 8;
                const float ax = p[0] - q[0], ay = p[8] - q[8], c = p[16] - q[16];
                const float mx = p[24] - q[24], my = p[32] - q[32];
                // nearest approach at the lens's centre while the shutter is open
                const float m2 = mx * mx + my * my;
                float t = m2 > 0.0f ? -(ax * mx + ay * my) / m2 : 0.0f;
                t = t < -0.5f ? -0.5f : (t > 0.5f ? 0.5f : t);
                const float ex = ax + t * mx, ey = ay + t * my;
                const float near = wp::abs(c) * lens + 0.1f * wp::sqrt(m2);
                crosses = ex * ex + ey * ey < near * near;
            }
            if (crosses)
                break;
        }
        if (end == size)
            break;
        // inside the hull unless some sample has all others on one side of its direction
        bool covered = true;
        for (int i = begin; i < end && covered; ++i) {
            bool left = true;
            for (int j = begin; j < end; ++j)
                left = left & (px[i] * py[j] - py[i] * px[j] >= 0.0f);
            covered = !left;
        }
        if (covered)
            break;
        begin = end;
    }
    float r = 0.0f, g = 0.0f, b = 0.0f, weight = 0.0f;
    for (int j = begin; j < end; ++j) {
        const float* p = tree.blocks.data + (size_t)(who[j] / 8) * 80 + who[j] % 8;
        const float w = 1.0f - wp::sqrt(away[j]) / radius;
        r += w * p[56];
        g += w * p[64];
        b += w * p[72];
        weight += w;
    }
    wp::vec_t<8, wp::float32> result;
    result[0] = r; result[1] = g; result[2] = b; result[3] = weight; result[4] = (float)(end - begin);
    result[5] = (float)cut; result[6] = 0.0f; result[7] = 0.0f;
    return result;
"""
)


@wp.func_native(GATHER)
def apparent_surface(
    tree: LineTree, x: float, y: float, u: float, v: float, time: float, lens: float, radius: float
) -> vec8: ...


@wp.kernel
def reconstruct_lines(
    offset: int,
    tree: LineTree,
    lens: Lens,
    radius: float,
    first_ray: int,
    ray_count: int,
    seed: int,
    sums: LensSums,
):
    """One thread owns a pixel and reconstructs at `ray_count` of its film, lens and time coordinates."""
    i = offset + wp.tid()
    total = sums.radiance[i]
    counts = sums.counts[i]
    has_lens = wp.where(lens.radius > 0.0, 1.0, 0.0)
    for ray in range(first_ray, first_ray + ray_count):
        r = lens_ray(lens, seed, i, ray)
        time = wp.where(lens.moving != 0, r.time - 0.5, 0.0)
        s = apparent_surface(tree, r.x, r.y, r.uv[0], r.uv[1], time, has_lens, radius)
        if s[3] > 0.0:
            total = total + wp.vec3(s[0], s[1], s[2]) / s[3]
        else:
            counts[0] = counts[0] + 1
        counts[2] = counts[2] + int(s[5])
    sums.radiance[i] = total
    sums.counts[i] = counts


@wp.kernel
def largest_holes(
    offset: int,
    points: wp.array[wp.vec2],
    starts: wp.array[int],
    width: int,
    height: int,
    corner: wp.vec2,
    step: float,
    count: int,
    holes: wp.array[float],
):
    """One thread searches one row of places for the one farthest from all points, which stand in cells of a pixel."""
    i = offset + wp.tid()
    worst = float(0.0)
    y = corner[1] + (float(i) + 0.5) * step
    row = int(y)
    for k in range(count):
        x = corner[0] + (float(k) + 0.5) * step
        column = int(x)
        near = float(EMPTY)
        ring = int(0)
        # what lies in the rings of cells still to come is `ring` pixels away or more
        while ring < width + height and near > float(ring - 1) * float(ring - 1):
            for cy in range(wp.max(row - ring, 0), wp.min(row + ring, height - 1) + 1):
                for cx in range(wp.max(column - ring, 0), wp.min(column + ring, width - 1) + 1):
                    if wp.max(wp.abs(cy - row), wp.abs(cx - column)) == ring:
                        for j in range(starts[cy * width + cx], starts[cy * width + cx + 1]):
                            q = points[j]
                            near = wp.min(near, (q[0] - x) * (q[0] - x) + (q[1] - y) * (q[1] - y))
            ring += 1
        worst = wp.max(worst, near)
    holes[i] = wp.sqrt(worst)
