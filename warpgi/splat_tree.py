"""The splat hierarchy: order, levels and boxes of `kernels.bvh`, sizes of `kernels.light_field`."""

from __future__ import annotations

from typing import Any

import numpy as np
import warp as wp

from warpgi.device import Device
from warpgi.kernels import bvh, neighbours, point_order
from warpgi.kernels import light_field as kernels
from warpgi.kernels.splats import SplatTree as SplatTreeStruct

LANES = int(bvh.LANES)

#: What builds a tree, and what sizes its splats: a kernel of each module.
TREE_KERNELS = (point_order.split_segments, bvh.fill_blocks)
SIZING_KERNELS = (neighbours.nearest_distances, kernels.size_lone_splats)

#: First place and step of the input rays that each pass of shrinking retraces: 1/16 of them, 3/16, and 3/4.
SHRINK_PASSES = (((0, 16),), ((8, 16), (4, 8)), ((2, 4), (1, 2)))

# Points above which a device with many threads halves all segments of the order at once, by sorting.
SORTED_ABOVE = 1024
# Segments enough for every thread of a CPU; a constant, so that no order depends on their number.
PIECES = 64


class SplatTree:
    """Splats in a tree of eight children a node.

    Args:
        device: where it lives.
        hits, normals, radiance: of all samples, vec3 arrays on the device.
        splats: which samples are splats, int array on the host.
        noise: rounding of the positions.
        order: what `order` shall be; None: that of a balanced k-d tree.

    Attributes:
        struct: what kernels see.
        order: place in the tree -> sample, on the device.
    """

    def __init__(
        self,
        device: Device,
        hits: wp.array,
        normals: wp.array,
        radiance: wp.array,
        splats: np.ndarray,
        noise: float,
        order: wp.array | None = None,
    ) -> None:
        self.device = device
        self.noise = noise
        self.count = len(splats)
        self.block_count = max(1, -(-self.count // LANES))  # of an empty tree all lanes are unused
        self.order = compact_order(device, hits, splats) if order is None else order
        self.levels, first = tree_levels(self.block_count)
        self.node_count = len(first)
        struct = SplatTreeStruct()
        struct.nodes = device.zeros(self.node_count * int(bvh.NODE_STRIDE), float)
        struct.first = device.array(first, int)
        struct.blocks = device.zeros(self.block_count * int(bvh.BLOCK_STRIDE), float)
        struct.count, struct.block_count = self.count, self.block_count
        self.struct = struct
        inputs = [hits, normals, radiance, self.order, self.count]
        device.launch(bvh.fill_blocks, self.block_count * LANES, inputs, [struct.blocks])
        self.refit()

    @property
    def nbytes(self) -> int:
        """Bytes on the device."""
        arrays = (self.struct.nodes, self.struct.first, self.struct.blocks, self.order)
        return sum(array.capacity for array in arrays)

    def refit(self) -> None:
        """Boxes from the splats' present sizes, as discs."""
        self._refit(flat=1.0)

    def refit_as_balls(self) -> None:
        """The same as balls."""
        self._refit(flat=0.0)

    def with_present_boxes(self) -> SplatTreeStruct:
        """The same splats in the boxes that they have now, which no later refit changes."""
        struct, own = SplatTreeStruct(), self.struct
        struct.first, struct.blocks, struct.count, struct.block_count = (
            own.first,
            own.blocks,
            own.count,
            own.block_count,
        )
        struct.nodes = wp.clone(own.nodes)
        return struct

    def _refit(self, flat: float) -> None:
        start, size = self.levels[0]
        blocks, nodes = self.struct.blocks, self.struct.nodes
        self.device.launch(bvh.fit_leaves, size, [blocks, self.block_count, start, self.noise, flat], [nodes])
        self.fit_levels(nodes)

    def fit_levels(self, nodes: wp.array) -> None:
        """Boxes of all levels above the lowest, level by level."""
        for (start, size), (below, count_below) in zip(self.levels[1:], self.levels, strict=False):
            self.device.launch(bvh.fit_level, size, [start, below, count_below], [nodes])

    def size_by_neighbours(self, rays: kernels.Rays, k: int, alpha: float) -> None:
        """Radii from the k-th nearest neighbour (Lehtinen et al. 2012, section 2.2)."""
        if self.count == 0:
            return
        # |d + (alpha - 1) (d.n) n|^2 = |d|^2 + (alpha^2 - 1) (d.n)^2
        radius2 = self.nearest_distances(k, alpha * alpha - 1.0)
        self.device.launch(kernels.size_lone_splats, self.count, [rays], [radius2])
        self.set_radius2(radius2)

    def nearest_distances(self, k: int, stretch: float) -> wp.array:
        """Squared distance of each splat's k-th neighbour by |d|^2 + stretch (d.n)^2, itself counted; -1: none."""
        distance2 = self.device.zeros(self.count, float)
        self.device.launch(neighbours.nearest_distances, self.block_count, [self.struct, k, stretch], [distance2])
        return distance2

    def shrink(self, rays: kernels.Rays, margin: float, escaped: np.ndarray, extent: float) -> None:
        """Shrinks what input rays cross (section 2.3.1); the same for any number of threads.

        A splat ends as the least of its own radius and all crossings, so that each ray may as well meet it shrunk by
        others: a few rays go first, and what they leave is met by fewer of the rest.
        Rays that left the scene are known visibility too: `escaped` are their samples, `extent` stands for a length.
        """
        if self.count == 0:
            return
        device, slots = self.device, self.device.slots
        by_splats, by_escaped = self._shrink_kernels
        radius2 = wp.full(slots * self.count, 3.0e38, dtype=float, device=device.warp)
        device.launch(bvh.read_radii, self.count, [self.struct.blocks], [radius2[: self.count]])
        for rays_of_pass in SHRINK_PASSES:
            for first, step in rays_of_pass:
                inputs = [*self._walked(), rays, margin, self.noise, first, step]
                device.launch(by_splats, -(-(self.count - first) // step), inputs, [radius2], with_slot=True)
            if rays_of_pass is SHRINK_PASSES[-1]:
                inputs = [*self._walked(), rays, device.array(escaped, int), max(margin * extent, self.noise)]
                device.launch(by_escaped, len(escaped), inputs, [radius2], with_slot=True)
            self.set_radius2(radius2, slots)

    #: What retraces one input ray: of a splat, and one that left the scene.
    _shrink_kernels = (kernels.shrink_splats, kernels.shrink_by_escaped)

    def _walked(self) -> list[Any]:
        """What those kernels walk through."""
        return [self.struct]

    def count_crossed(self, rays: kernels.Rays, margin: float) -> int:
        """Splats that input rays cross before their ends, over all rays: 0 after shrinking."""
        crossed, none = self.device.zeros(self.count, int), self.device.zeros(1, float)
        inputs = [self.struct, rays, margin, self.noise, none]
        self.device.launch(kernels.count_crossed, self.count, inputs, [crossed])
        return int(crossed.numpy().sum(dtype=np.int64))

    def radii(self) -> np.ndarray:
        """Radius of each splat in tree order, shape (count,)."""
        radius2 = self.device.zeros(self.count, float)
        self.device.launch(bvh.read_radii, self.count, [self.struct.blocks], [radius2])
        return np.sqrt(radius2.numpy())

    def set_radiance(self, radiance: wp.array) -> None:
        """Takes the splats' radiance anew from that of all samples."""
        self.device.launch(bvh.fill_radiance, self.count, [radiance, self.order], [self.struct.blocks])

    def set_radius2(self, radius2: wp.array, slots: int = 1) -> None:
        """Gives splats new squared radii, the least of the slots, and fits the boxes to them."""
        self.device.launch(bvh.fill_radii, self.count, [radius2, slots, self.count], [self.struct.blocks])
        self.refit()


def compact_order(device: Device, points: wp.array, chosen: np.ndarray, sorted_above: int | None = None) -> wp.array:
    """The chosen points' numbers in the order of a balanced k-d tree with eight points a leaf, on the device.

    Segments of more points than `sorted_above` are split by sorting; None: as it suits the device.
    """
    count = len(chosen)
    order = device.array(chosen, int)
    if count <= LANES:
        return order
    records = device.zeros(count, wp.vec4)
    device.launch(point_order.fill_records, count, [points, order], [records])
    size = LANES << (-(-count // LANES) - 1).bit_length()
    if sorted_above is None:
        sorted_above = SORTED_ABOVE if device.is_cuda else size
    while size > max(sorted_above, int(point_order.RUN)):
        records = _split_by_sorting(device, records, size)
        size //= 2
    # one launch a level until there is a piece for every thread, then all the rest at once
    pieces = -(-count // size)
    while pieces < PIECES and size > LANES:
        device.launch(point_order.split_segments, pieces, [count, size, size // 2], [records])
        size //= 2
        pieces = -(-count // size)
    device.launch(point_order.split_segments, pieces, [count, size, LANES], [records])
    device.launch(point_order.read_order, count, [records], [order])
    return order


def _split_by_sorting(device: Device, records: wp.array, size: int) -> wp.array:
    """Halves all segments of that size, which is a multiple of a run."""
    count, run = len(records), int(point_order.RUN)
    run_count, segments = -(-count // run), -(-count // size)
    low, high = device.zeros(run_count, wp.vec3), device.zeros(run_count, wp.vec3)
    device.launch(point_order.bound_runs, run_count, [records], [low, high])
    sides = device.zeros(segments, wp.vec3)
    device.launch(point_order.bound_segments, segments, [low, high, size // run], [sides])
    keys, values = device.zeros(2 * count, int), device.zeros(2 * count, int)
    # float32 tells no more steps apart
    steps = min(1 << 24, (1 << int(point_order.KEY_BITS)) // segments)
    device.launch(point_order.segment_keys, count, [records, sides, size, steps], [keys, values])
    wp.utils.radix_sort_pairs(keys, values, count)
    moved = device.zeros(count, wp.vec4)
    device.launch(point_order.move_records, count, [records, values], [moved])
    return moved


def tree_levels(block_count: int) -> tuple[list[tuple[int, int]], np.ndarray]:
    """(first node, nodes) of each level from the lowest up, and each node's first child, below 0 a block.

    Nodes are numbered from the root down; a level has an eighth of the nodes of the one below.
    """
    sizes = [-(-block_count // LANES)]
    while sizes[-1] > 1:
        sizes.append(-(-sizes[-1] // LANES))
    starts = np.zeros(len(sizes), dtype=np.int64)
    for level in reversed(range(len(sizes) - 1)):
        starts[level] = starts[level + 1] + sizes[level + 1]
    levels = [(int(start), size) for start, size in zip(starts, sizes, strict=True)]
    first = np.empty(sum(sizes), np.int32)
    for level, (start, size) in enumerate(levels):
        child = LANES * np.arange(size, dtype=np.int32)
        first[start : start + size] = -1 - child if level == 0 else levels[level - 1][0] + child
    return levels, first
