"""Defocus and motion from a buffer of primary rays: the light field of lens and shutter, reconstructed.

Lehtinen et al. 2012, section 3.4; no scene is needed.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import warp as wp

from warpgi.device import Device
from warpgi.kernels import bvh, lens
from warpgi.kernels import light_field as still_kernels
from warpgi.kernels import moving_splats as moving_kernels
from warpgi.reconstruction import NOISE_ULPS, Preprocessing, make_sky
from warpgi.samples import SampleBuffer
from warpgi.splat_tree import LANES, SIZING_KERNELS, TREE_KERNELS, SplatTree

#: What it launches for still and for moving buffers, to be compiled first: a kernel of each module.
STILL_KERNELS = (lens.reconstruct_still_lens, *TREE_KERNELS, *SIZING_KERNELS)
MOVING_KERNELS = (*STILL_KERNELS, moving_kernels.reconstruct_moving_lens)

# Squared part of the distance to the nearest ray that passed it within which a sample covers by itself: with it a
# straight rim neither grows nor shrinks in the mean.
COVERED_PART2 = 0.35

# Sine of the angle by which samples of one surface may lie off each other's planes: the still hierarchy's, and more
# where a sample's normal is that of another time.
STILL_SLOPE, MOVING_SLOPE = 0.01, 0.15

# Device bytes a sample: the splat in its block with nodes, order and sort keys, vectors and motion; and a pixel.
BYTES_PER_SAMPLE = 4 * 12 + 48 + 36 + 24 + 28
BYTES_PER_PIXEL = 32
#: Device bytes of a sample as it is traced.
PRIMARY_SAMPLE_BYTES = 4 * 12 + 24


class LensSampling:
    """Rays through the pixels, the lens and the shutter of a picture, and sums of what they find.

    Args:
        samples: primary rays, in camera space.
        device: where it computes.
        seed: which rays.

    Raises:
        ValueError: the samples hold no rays, are no primary rays, or do not fit into the device's memory limit.
    """

    def __init__(self, samples: SampleBuffer, device: Device, seed: int) -> None:
        if not samples.has_secondary_rays:
            raise ValueError("samples hold no secondary rays, expected a sample buffer of format 2.0 or newer")
        pixels = samples.width * samples.height
        need = len(samples) * BYTES_PER_SAMPLE + pixels * BYTES_PER_PIXEL
        if need > device.memory_limit:
            raise ValueError(f"memory_limit is {device.memory_limit} bytes, expected {need} for {len(samples)} samples")
        self.samples, self.device, self.seed = samples, device, seed
        matrix = samples.pixel_to_camera
        step = float(np.linalg.norm(matrix[:3, 1]))
        if np.array_equal(matrix, np.eye(4)) or matrix[3, :3].any() or step == 0.0:
            raise ValueError("samples lack the camera of primary rays, expected those of sample(..., primary=True)")
        self.moving = samples.hit_motion is not None and samples.time is not None
        self.lens = lens.Lens()
        self.lens.width, self.lens.moving, self.lens.stop = samples.width, int(self.moving), 1.0
        self.lens.radius = abs(samples.coc[1]) * step
        columns = (wp.vec3(*(matrix[:3, i] / matrix[3, 3])) for i in (3, 0, 1))
        self.lens.corner, self.lens.right, self.lens.down = columns
        self.pixel_count = pixels
        self.sums = lens.LensSums()
        self.sums.radiance = device.zeros(pixels, wp.vec3)
        self.sums.counts = device.zeros(pixels, wp.vec4i)
        self.rays_done = 0
        state = samples.checked
        self.counts = {name: count for name, count in state.counts.items() if name != "primary_missed"}

    def image(self) -> np.ndarray:
        """The picture so far, shape (H, W, 3), float32; pixels whose rays found nothing keep the mean of the input."""
        samples = self.samples
        starts = np.searchsorted(samples.pixel_of_sample, np.arange(self.pixel_count + 1)).astype(np.int32)
        usable = np.where(np.isfinite(samples.radiance).all(axis=1)[:, None], samples.radiance, np.float32(0.0))
        image = self.device.zeros(self.pixel_count, wp.vec3)
        arrays = [self.device.array(starts, int), self.device.array(usable, wp.vec3)]
        self.device.launch(lens.lens_means, self.pixel_count, [self.sums, self.rays_done, *arrays], [image])
        return image.numpy().reshape(samples.height, samples.width, 3).copy()

    def all_counts(self) -> dict[str, int]:
        """Rays so far, what was dropped, and rays and whole pixels without support."""
        found = self.sums.counts.numpy()
        names = ("missing_support", "sky_rays", "cut_gathers", "undersampled_surfaces")
        totals = dict(zip(names, found.sum(axis=0, dtype=np.int64).tolist(), strict=True))
        filled = int(np.count_nonzero(found[:, 0] == self.rays_done)) if self.rays_done else 0
        rays = self.pixel_count * self.rays_done
        return self.counts | totals | {"reconstruction_rays": rays, "filled_pixels": filled}


class LensReconstruction(LensSampling):
    """Splats of what primary rays met, at the ray's time, and the first surface along rays through the lens."""

    def __init__(self, samples: SampleBuffer, device: Device, preprocessing: Preprocessing, seed: int) -> None:
        super().__init__(samples, device, seed)
        device.load(MOVING_KERNELS if self.moving else STILL_KERNELS)
        state = samples.checked
        splats = np.flatnonzero(state.is_splat).astype(np.int32)
        escaped = np.flatnonzero(state.is_escaped).astype(np.int32)
        used = samples.hit[splats] if len(splats) else np.zeros((1, 3), np.float32)
        low, high = used.min(axis=0), used.max(axis=0)
        self.noise = NOISE_ULPS * max(float(np.abs(used).max()), 1e-30)
        self.preprocessing = preprocessing
        origins, hits = device.array(samples.origin, wp.vec3), device.array(samples.hit, wp.vec3)
        normals = device.array(samples.unit_hit_normal, wp.vec3)
        radiance = device.array(samples.radiance, wp.vec3)
        arguments = (device, normals, radiance, splats, self.noise)
        self.tree = _MovingSplatTree(samples, *arguments) if self.moving else SplatTree(device, hits, *arguments[1:])
        rays = still_kernels.Rays()
        rays.origins, rays.hits, rays.order = origins, hits, self.tree.order
        self.rays = rays
        self.tree.size_by_neighbours(rays, preprocessing.neighbours, preprocessing.alpha)
        sizes = self._radius2()
        self.tree.shrink(rays, preprocessing.margin, escaped, float((high - low).max()))
        self.free2 = self._radius2()
        self.tree.set_radius2(sizes)
        self.sky = make_sky(samples, escaped, device)
        self.counts |= {"splats": len(splats)}

    def _radius2(self) -> wp.array:
        radius2 = self.device.zeros(self.tree.count, float)
        self.device.launch(bvh.read_radii, self.tree.count, [self.tree.struct.blocks], [radius2])
        return radius2

    def gather(self, first: int, count: int, each: int) -> None:
        """Sends rays `first` to `first + count - 1` through every pixel, and adds up what they find."""
        kernel, trees, slope = lens.reconstruct_still_lens, [self.tree.struct], STILL_SLOPE
        if isinstance(self.tree, _MovingSplatTree):
            kernel, slope = moving_kernels.reconstruct_moving_lens, MOVING_SLOPE
            trees = [self.tree.struct, self.tree.motion]
        inputs = [self.free2, self.sky, self.lens, first, count, self.seed, self.noise, COVERED_PART2, slope**2]
        self.device.launch(kernel, self.pixel_count, [*trees, *inputs], [self.sums])
        self.rays_done += count


class _MovingSplatTree(SplatTree):
    """The splat hierarchy at time 1/2, with boxes at both ends of the shutter."""

    def __init__(
        self,
        samples: SampleBuffer,
        device: Device,
        normals: wp.array,
        radiance: wp.array,
        splats: np.ndarray,
        noise: float,
    ) -> None:
        time = np.zeros(len(samples), np.float32) if samples.time is None else samples.time
        way = np.zeros_like(samples.hit) if samples.hit_motion is None else samples.hit_motion
        middle = samples.hit + (np.float32(0.5) - time)[:, None] * way
        self.motion = moving_kernels.Motion()
        self.motion.times = device.array(time, float)
        self._way = device.array(way, wp.vec3)
        super().__init__(device, device.array(middle, wp.vec3), normals, radiance, splats, noise)

    def refit(self) -> None:
        """Boxes at times 0 and 1 from the splats' present sizes, level by level."""
        device, motion = self.device, self.motion
        if motion.ways is None:
            motion.ways = device.zeros(self.block_count * int(moving_kernels.MOTION_STRIDE), float)
            motion.node_ends = device.zeros(self.node_count * int(bvh.NODE_STRIDE), float)
            inputs = [self._way, self.order, self.count]
            device.launch(moving_kernels.fill_ways, self.block_count * LANES, inputs, [motion.ways])
        for time, nodes in ((0.0, self.struct.nodes), (1.0, motion.node_ends)):
            start, size = self.levels[0]
            inputs = [self.struct.blocks, motion.ways, time, self.block_count, start, self.noise]
            device.launch(moving_kernels.fit_moving_leaves, size, inputs, [nodes])
            self.fit_levels(nodes)

    _shrink_kernels = (moving_kernels.shrink_moving, moving_kernels.shrink_moving_by_escaped)

    def _walked(self) -> list[Any]:
        return [self.struct, self.motion]
