"""A tree of eight children a node over points in an order of neighbours, built and refit level by level.

Blocks of eight neighbouring points are its leaves; every node above covers eight of the level below, so that the
shape follows from the number of points alone and only boxes need computing.
"""

import warp as wp

wp.set_module_options({"enable_backward": False})

LANES = wp.constant(8)
NODE_STRIDE = wp.constant(48)  # smallest x, y, z of the eight children, then largest
BLOCK_STRIDE = wp.constant(80)  # x, y, z, normal x, y, z, radius squared, radiance r, g, b of eight splats
RADIUS_ROW = wp.constant(48)
UNUSED = wp.constant(-1.0)  # radius squared of an empty lane

EMPTY = wp.constant(1.0e30)


@wp.kernel
def fill_blocks(
    offset: int,
    points: wp.array[wp.vec3],
    normals: wp.array[wp.vec3],
    radiance: wp.array[wp.vec3],
    order: wp.array[int],
    count: int,
    blocks: wp.array[float],
):
    """One thread writes one lane: the splat at that place of the order, radius 0, or an unused one past the end."""
    i = offset + wp.tid()
    place = (i // LANES) * BLOCK_STRIDE + i % LANES
    if i < count:
        j = order[i]
        p = points[j]
        n = normals[j]
        light = radiance[j]
        for axis in range(3):
            blocks[place + axis * LANES] = p[axis]
            blocks[place + (3 + axis) * LANES] = n[axis]
            blocks[place + (7 + axis) * LANES] = light[axis]
        blocks[place + RADIUS_ROW] = 0.0
    else:
        for row in range(10):
            blocks[place + row * LANES] = 0.0
        blocks[place + RADIUS_ROW] = UNUSED


@wp.kernel
def fill_radiance(offset: int, radiance: wp.array[wp.vec3], order: wp.array[int], blocks: wp.array[float]):
    """One thread writes the radiance of one splat."""
    i = offset + wp.tid()
    place = (i // LANES) * BLOCK_STRIDE + i % LANES
    value = radiance[order[i]]
    for axis in range(3):
        blocks[place + (7 + axis) * LANES] = value[axis]


@wp.kernel
def fill_radii(offset: int, radius2: wp.array[float], slots: int, count: int, blocks: wp.array[float]):
    """One thread writes the squared radius of one splat, the least of its slots."""
    i = offset + wp.tid()
    r2 = radius2[i]
    for slot in range(1, slots):
        r2 = wp.min(r2, radius2[slot * count + i])
    blocks[(i // LANES) * BLOCK_STRIDE + i % LANES + RADIUS_ROW] = r2


@wp.kernel
def read_radii(offset: int, blocks: wp.array[float], radius2: wp.array[float]):
    """One thread copies the squared radius of one splat."""
    i = offset + wp.tid()
    radius2[i] = blocks[(i // LANES) * BLOCK_STRIDE + i % LANES + RADIUS_ROW]


@wp.func
def write_box(nodes: wp.array[float], node: int, child: int, low: wp.vec3, high: wp.vec3):
    for axis in range(3):
        nodes[node * NODE_STRIDE + axis * LANES + child] = low[axis]
        nodes[node * NODE_STRIDE + (3 + axis) * LANES + child] = high[axis]


@wp.kernel
def fit_leaves(
    offset: int,
    blocks: wp.array[float],
    block_count: int,
    first_node: int,
    margin: float,
    flat: float,
    nodes: wp.array[float],
):
    """One thread owns a node of the lowest level: the boxes of its eight blocks' discs, or balls where `flat` is 0,
    grown by `margin`."""
    i = offset + wp.tid()
    for child in range(LANES):
        low = wp.vec3(EMPTY)
        high = wp.vec3(-EMPTY)
        block = i * LANES + child
        if block < block_count:
            for lane in range(LANES):
                place = block * BLOCK_STRIDE + lane
                r2 = blocks[place + RADIUS_ROW]
                if r2 >= 0.0:
                    p = wp.vec3(blocks[place], blocks[place + 8], blocks[place + 16])
                    n = wp.vec3(blocks[place + 24], blocks[place + 32], blocks[place + 40])
                    # a disc reaches r sqrt(1 - n^2) along an axis, a ball r
                    e = wp.vec3(
                        wp.sqrt(r2 * wp.max(0.0, 1.0 - flat * n[0] * n[0])) + margin,
                        wp.sqrt(r2 * wp.max(0.0, 1.0 - flat * n[1] * n[1])) + margin,
                        wp.sqrt(r2 * wp.max(0.0, 1.0 - flat * n[2] * n[2])) + margin,
                    )
                    low = wp.min(low, p - e)
                    high = wp.max(high, p + e)
        write_box(nodes, first_node + i, child, low, high)


@wp.kernel
def fit_level(offset: int, first_node: int, first_below: int, count_below: int, nodes: wp.array[float]):
    """One thread owns a node: the boxes of its eight children are the unions of theirs."""
    i = offset + wp.tid()
    for child in range(LANES):
        low = wp.vec3(EMPTY)
        high = wp.vec3(-EMPTY)
        below = i * LANES + child
        if below < count_below:
            p = (first_below + below) * NODE_STRIDE
            for k in range(LANES):
                low = wp.min(low, wp.vec3(nodes[p + k], nodes[p + 8 + k], nodes[p + 16 + k]))
                high = wp.max(high, wp.vec3(nodes[p + 24 + k], nodes[p + 32 + k], nodes[p + 40 + k]))
        write_box(nodes, first_node + i, child, low, high)
