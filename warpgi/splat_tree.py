"""The splat hierarchy: order, levels and boxes of `kernels.bvh`, sizes of `kernels.light_field`."""

from __future__ import annotations

import numpy as np
import warp as wp

from warpgi.device import Device
from warpgi.kernels import bvh
from warpgi.kernels import light_field as kernels
from warpgi.kernels.splats import SplatTree as SplatTreeStruct

LANES = int(bvh.LANES)


class SplatTree:
    """Splats in a tree of eight children a node.

    Args:
        device: where it lives.
        hits, normals, radiance: of all samples, vec3 arrays on the device.
        splats: which samples are splats, int array on the host.
        noise: rounding of the positions.
        order: what `order` shall be; None: along a Hilbert curve.

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
        self.order = hilbert_order(device, hits, splats) if order is None else order
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
        radius2 = self.device.zeros(self.count, float)
        # |d + (alpha - 1) (d.n) n|^2 = |d|^2 + (alpha^2 - 1) (d.n)^2
        self.device.launch(kernels.size_splats, self.count, [self.struct, rays, k, alpha * alpha - 1.0], [radius2])
        self.set_radius2(radius2)

    def shrink(self, rays: kernels.Rays, margin: float, escaped: np.ndarray, extent: float) -> None:
        """Shrinks what input rays cross (section 2.3.1); the same for any number of threads.

        Rays that left the scene are known visibility too: `escaped` are their samples, `extent` stands for a length.
        """
        if self.count == 0:
            return
        slots = self.device.slots
        radius2 = wp.full(slots * self.count, 3.0e38, dtype=float, device=self.device.warp)
        own = radius2[: self.count]
        self.device.launch(bvh.read_radii, self.count, [self.struct.blocks], [own])
        inputs = [self.struct, rays, margin, self.noise]
        self.device.launch(kernels.shrink_splats, self.count, inputs, [radius2], with_slot=True)
        inputs = [self.struct, rays, self.device.array(escaped, int), max(margin * extent, self.noise)]
        self.device.launch(kernels.shrink_by_escaped, len(escaped), inputs, [radius2], with_slot=True)
        self.set_radius2(radius2, slots)

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


def hilbert_order(device: Device, points: wp.array, chosen: np.ndarray) -> wp.array:
    """The chosen points' numbers along a Hilbert curve through the smallest cube about them, on the device."""
    count = len(chosen)
    source = device.array(chosen, int)
    if count == 0:
        return source
    # the bounds of what is chosen, found on the host: the samples came from there
    places = points.numpy()[chosen]
    low, high = places.min(axis=0), places.max(axis=0)
    size = max(float((high - low).max()), 1e-30)
    keys, values = device.zeros(2 * count, int), device.zeros(2 * count, int)
    inputs = [points, source, wp.vec3(*low.tolist()), 1.0 / size]
    device.launch(bvh.order_keys, count, inputs, [keys, values])
    wp.utils.radix_sort_pairs(keys, values, count)
    return values[:count].contiguous()


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
