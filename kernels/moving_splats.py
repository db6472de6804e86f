"""Splats in motion (Lehtinen et al. 2012, sections 2.3 and 3.4): boxes and centres at the time of each ray.

The walks are those of the still hierarchy; a node's boxes go from their places at time 0 to those at 1 (Glassner 1988),
a splat's centre from that at time 1/2.
"""

import warp as wp

from warpgi.kernels.bvh import BLOCK_STRIDE, EMPTY, LANES, RADIUS_ROW, write_box
from warpgi.kernels.lens import ANY_REACH, Lens, LensSums, lens_ray
from warpgi.kernels.lens_splats import LENS_SURFACE
from warpgi.kernels.light_field import FAR, Rays, Sky, sky_radiance
from warpgi.kernels.splats import SHRINK, SplatTree, vec10

wp.set_module_options({"enable_backward": False})

MOTION_STRIDE = wp.constant(24)  # x, y, z of eight splats

STILL_NODE = "const float* p = tree.nodes.data + (size_t)current * 48;"
STILL_BLOCK = "const float* p = tree.blocks.data + (size_t)block * 80;"
MOVING_NODE = """float p[48];
            {
                const float* begin = tree.nodes.data + (size_t)current * 48;
                const float* end = node_ends.data + (size_t)current * 48;
                for (int k = 0; k < 48; ++k)
                    p[k] = begin[k] + time * (end[k] - begin[k]);
            }"""
MOVING_BLOCK = """float p[56];
            {
                const float* middle = tree.blocks.data + (size_t)block * 80;
                const float* way = motion.data + (size_t)block * 24;
                for (int k = 0; k < 24; ++k)
                    p[k] = middle[k] + (time - 0.5f) * way[k];
                for (int k = 24; k < 56; ++k)
                    p[k] = middle[k];
            }"""


def _in_motion(walk: str) -> str:
    if walk.count(STILL_NODE) != 1 or walk.count(STILL_BLOCK) != 1:
        raise ImportError("a walk through still splats does not read its nodes and blocks as expected")
    return walk.replace(STILL_NODE, MOVING_NODE).replace(STILL_BLOCK, MOVING_BLOCK)


@wp.func_native(_in_motion(SHRINK))
def shrink_crossed_moving(
    tree: SplatTree,
    node_ends: wp.array[float],
    motion: wp.array[float],
    time: float,
    o: wp.vec3,
    d: wp.vec3,
    length: float,
    margin: float,
    own: int,
    slot: int,
    radius2: wp.array[float],
) -> int: ...


@wp.func_native(_in_motion(LENS_SURFACE))
def lens_surface_moving(
    tree: SplatTree,
    node_ends: wp.array[float],
    motion: wp.array[float],
    time: float,
    free2: wp.array[float],
    o: wp.vec3,
    d: wp.vec3,
    noise: float,
    reach: float,
    part2: float,
    slope2: float,
    open: int,
) -> vec10: ...


@wp.struct
class Motion:
    node_ends: wp.array[float]  # boxes at time 1, as the tree's at time 0
    ways: wp.array[float]  # MOTION_STRIDE a block: from time 0 to 1
    times: wp.array[float]  # of the samples, in their own order


@wp.kernel
def fill_ways(offset: int, motion: wp.array[wp.vec3], order: wp.array[int], count: int, ways: wp.array[float]):
    """One thread writes the way of one splat; lanes past the end stay 0."""
    i = offset + wp.tid()
    if i < count:
        way = motion[order[i]]
        for axis in range(3):
            ways[(i // LANES) * MOTION_STRIDE + axis * LANES + i % LANES] = way[axis]


@wp.kernel
def fit_moving_leaves(
    offset: int,
    blocks: wp.array[float],
    ways: wp.array[float],
    time: float,
    block_count: int,
    first_node: int,
    margin: float,
    nodes: wp.array[float],
):
    """One thread owns a node of the lowest level: the boxes of its eight blocks' discs at one time."""
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
                    q = block * MOTION_STRIDE + lane
                    p = wp.vec3(blocks[place], blocks[place + 8], blocks[place + 16])
                    p = p + wp.vec3(ways[q], ways[q + 8], ways[q + 16]) * (time - 0.5)
                    n = wp.vec3(blocks[place + 24], blocks[place + 32], blocks[place + 40])
                    e = wp.vec3(
                        wp.sqrt(r2 * wp.max(0.0, 1.0 - n[0] * n[0])) + margin,
                        wp.sqrt(r2 * wp.max(0.0, 1.0 - n[1] * n[1])) + margin,
                        wp.sqrt(r2 * wp.max(0.0, 1.0 - n[2] * n[2])) + margin,
                    )
                    low = wp.min(low, p - e)
                    high = wp.max(high, p + e)
        write_box(nodes, first_node + i, child, low, high)


@wp.kernel
def shrink_moving(
    offset: int,
    slot: int,
    tree: SplatTree,
    motion: Motion,
    rays: Rays,
    margin: float,
    noise: float,
    first: int,
    step: int,
    radius2: wp.array[float],
):
    """One thread retraces one input ray at its time and shrinks, in its slot, the splats that it crosses."""
    i = first + (offset + wp.tid()) * step
    j = rays.order[i]
    o = rays.origins[j]
    d = rays.hits[j] - o
    length = wp.length(d)
    end = wp.max(margin * length, noise)
    if length > 2.0 * end:
        shrink_crossed_moving(
            tree, motion.node_ends, motion.ways, motion.times[j], o, d / length, length, end, i, slot, radius2
        )


@wp.kernel
def shrink_moving_by_escaped(
    offset: int,
    slot: int,
    tree: SplatTree,
    motion: Motion,
    rays: Rays,
    escaped: wp.array[int],
    margin: float,
    radius2: wp.array[float],
):
    """One thread retraces one input ray that left the scene."""
    j = escaped[offset + wp.tid()]
    o = rays.origins[j]
    d = wp.normalize((rays.hits[j] - o) * 1.0e-11)  # the squares of its coordinates may be beyond float32
    shrink_crossed_moving(
        tree, motion.node_ends, motion.ways, motion.times[j], o, d, 0.1 * FAR, margin, -1, slot, radius2
    )


@wp.kernel
def reconstruct_moving_lens(
    offset: int,
    tree: SplatTree,
    motion: Motion,
    free2: wp.array[float],
    sky: Sky,
    lens: Lens,
    first_ray: int,
    ray_count: int,
    seed: int,
    noise: float,
    part2: float,
    slope2: float,
    sums: LensSums,
):
    """One thread owns a pixel and sends `ray_count` of its rays into splats that move."""
    i = offset + wp.tid()
    total = sums.radiance[i]
    counts = sums.counts[i]
    for ray in range(first_ray, first_ray + ray_count):
        r = lens_ray(lens, seed, i, ray)
        s = lens_surface_moving(
            tree,
            motion.node_ends,
            motion.ways,
            r.time,
            free2,
            r.o,
            r.d,
            noise,
            ANY_REACH,
            part2,
            slope2,
            wp.min(sky.size, 1),
        )
        if s[3] > 0.0:
            total = total + wp.vec3(s[0], s[1], s[2]) / s[3]
        elif sky.size > 0:
            total = total + sky_radiance(sky, r.d)
            counts[1] = counts[1] + 1
        else:
            counts[0] = counts[0] + 1
        counts[2] = counts[2] + int(s[6])
        counts[3] = counts[3] + int(s[7])
    sums.radiance[i] = total
    sums.counts[i] = counts
