"""The earlier method for defocus and motion: samples on screen-space trajectories (Lehtinen et al. 2011)."""

from __future__ import annotations

import numpy as np
import warp as wp

from warpgi.device import Device
from warpgi.kernels import temporal_light_field as kernels
from warpgi.lens_reconstruction import LensSampling
from warpgi.samples import SampleBuffer
from warpgi.splat_tree import LANES, TREE_KERNELS, compact_order, tree_levels

#: What it launches, to be compiled first: a kernel of each module.
KERNELS = (kernels.reconstruct_lines, *TREE_KERNELS)

# Step of the search for the largest hole [pixels].
STEP = 0.25

# Distance of what has none: rays that left the scene.
FAR_DEPTH = 1e6


class TemporalReconstruction(LensSampling):
    """Trajectories of samples over the screen, and the first apparent surface at each place, lens point and time.

    Args:
        samples: primary rays, in camera space.
        device: where it computes.
        seed: which places are reconstructed.
        radius: within which samples are gathered [pixels]; None: the worst-case dispersion of the samples' pattern.
    """

    def __init__(self, samples: SampleBuffer, device: Device, seed: int, radius: float | None = None) -> None:
        super().__init__(samples, device, seed)
        place, motion, depth, used = _trajectories(samples)
        self.radius = dispersion(samples, place, motion, device) if radius is None else float(radius)
        lines = kernels.Lines()
        lines.place, lines.motion = device.array(place, wp.vec3), device.array(motion, wp.vec3)
        lines.depth, lines.radiance = device.array(depth, float), device.array(samples.radiance, wp.vec3)
        block_count = max(1, -(-len(used) // LANES))
        # blurred as much as they lie apart: what moves over the screen with the lens alike comes together
        order = compact_order(device, lines.place, used)
        levels, first = tree_levels(block_count)
        tree = kernels.LineTree()
        tree.first = device.array(first, int)
        stride = int(kernels.STRIDE)
        tree.nodes = device.zeros(len(first) * stride, float)
        tree.blocks = device.zeros(block_count * stride, float)
        device.launch(kernels.fill_lines, block_count * LANES, [lines, order, len(used)], [tree.blocks])
        start, size = levels[0]
        device.launch(kernels.bound_blocks, size, [tree.blocks, block_count, start], [tree.nodes])
        for (start, size), (below, count_below) in zip(levels[1:], levels, strict=False):
            device.launch(kernels.bound_level, size, [start, below, count_below], [tree.nodes])
        self.tree, self._order = tree, order

    def gather(self, first: int, count: int, each: int) -> None:
        """Reconstructs at places `first` to `first + count - 1` of every pixel, and adds up what is found."""
        inputs = [self.tree, self.lens, self.radius, first, count, self.seed]
        self.device.launch(kernels.reconstruct_lines, self.pixel_count, inputs, [self.sums])
        self.rays_done += count


def _trajectories(samples: SampleBuffer) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Place and circle of confusion, motion, depth of each sample, and which samples are usable.

    Film positions are those of a pinhole at the lens's centre; trajectories are straight between both ends of the
    shutter in place and depth, and go through the sample itself.
    """
    count = len(samples)
    state = samples.checked
    usable = state.is_splat | state.is_escaped
    time = np.zeros(count) if samples.time is None else samples.time.astype(np.float64)
    way = np.zeros((count, 3)) if samples.hit_motion is None else samples.hit_motion.astype(np.float64)
    hit = np.where(usable[:, None], samples.hit, [0.0, 0.0, -1.0]).astype(np.float64)
    far = state.is_escaped
    hit[far] = -hit[far] / np.minimum(hit[far, 2:], -1e-30) * FAR_DEPTH
    ends = [_project(samples, hit + (end - time)[:, None] * way) for end in (0.0, 1.0)]
    motion = ends[1] - ends[0]
    here = _project(samples, hit)
    place = here - (time - 0.5)[:, None] * motion
    coc = samples.coc[0] / here[:, 2] + samples.coc[1]
    result = np.stack([place[:, 0], place[:, 1], coc], axis=1)
    ahead = (here[:, 2] > 0.0) & (ends[0][:, 2] > 0.0) & (ends[1][:, 2] > 0.0)
    used = np.flatnonzero(usable & ahead & np.isfinite(result).all(axis=1) & np.isfinite(motion).all(axis=1))
    floats = [array.astype(np.float32) for array in (result, motion, place[:, 2])]
    return floats[0], floats[1], floats[2], used.astype(np.int32)


def _project(samples: SampleBuffer, points: np.ndarray) -> np.ndarray:
    """Film position through the lens's centre [pixels] and depth, shape (N, 3)."""
    columns = (samples.pixel_to_camera[:3] / samples.pixel_to_camera[3, 3])[:, [0, 1, 3]]
    x, y, scale = np.linalg.solve(columns, points.T)
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.stack([x / scale, y / scale, -points[:, 2]], axis=1)


def dispersion(samples: SampleBuffer, place: np.ndarray, motion: np.ndarray, device: Device) -> float:
    """Radius of the largest hole of the sampling pattern, in the worst of its views through lens and shutter [pixels].

    A surface of one depth and motion, seen through one point of the lens at one time, shows the pattern sheared by its
    circle of confusion along the lens and by its motion along time. Those of the picture's own surfaces are tried, in
    the part of the picture that the sheared pattern fills.
    """
    if samples.image_xy is None:
        raise ValueError("samples lack image_xy, expected those of sample(..., primary=True)")
    count = len(samples)
    lens = np.zeros((count, 2)) if samples.lens is None else samples.lens.astype(np.float64) * [1.0, -1.0]
    time = np.zeros(count) if samples.time is None else samples.time - 0.5
    finite = np.isfinite(place).all(axis=1) & np.isfinite(motion).all(axis=1)
    blurs, ways = np.zeros(1), np.zeros((1, 2))
    if finite.any():
        blurs = np.unique(np.quantile(place[finite, 2], np.linspace(0.0, 1.0, 5)))
        ways = np.unique(np.quantile(motion[finite, :2], (0.0, 0.5, 1.0), axis=0), axis=0)
    size = np.array([samples.width, samples.height])
    worst = 0.0
    for blur in blurs:
        for way in ways:
            margin = np.minimum(np.abs(blur) + 0.5 * np.abs(way) + 1.0, 0.4 * size)
            steps = ((size - 2.0 * margin) / STEP).astype(int)
            seen = samples.image_xy - blur * lens - time[:, None] * way
            cell = np.floor(seen).astype(np.int64)
            inside = np.flatnonzero(((cell >= 0) & (cell < size)).all(axis=1))
            cell = cell[inside, 1] * size[0] + cell[inside, 0]
            order = np.argsort(cell, kind="stable")
            starts = np.searchsorted(cell[order], np.arange(size.prod() + 1)).astype(np.int32)
            points = device.array(seen[inside[order]].astype(np.float32), wp.vec2)
            holes = device.zeros(int(steps[1]), float)
            inputs = [points, device.array(starts, int), *size.tolist(), wp.vec2(*margin.tolist()), STEP, int(steps[0])]
            device.launch(kernels.largest_holes, int(steps[1]), inputs, [holes])
            worst = max(worst, float(holes.numpy().max(initial=0.0)))
    return worst or 1.0
