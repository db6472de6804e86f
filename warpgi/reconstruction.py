"""Light-field reconstruction on a device: from a sample buffer to the light at its primary hits.

Lehtinen et al. 2012, "Reconstructing the Indirect Light Field for Global Illumination", sections 2 and 4. It never
sees the scene.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import warp as wp

from warpgi.device import Device
from warpgi.kernels import light_field as kernels
from warpgi.kernels.hemisphere import Hemispheres
from warpgi.samples import NO_HIT, SampleBuffer
from warpgi.splat_tree import SIZING_KERNELS, TREE_KERNELS, SplatTree

# Position rounding in units of float32's spacing at the largest coordinate: positions come from a few operations.
NOISE_ULPS = 4.0 * 2.0**-24

# Escaped rays for each texel of the map that answers for the sky, and the map's largest side.
SKY_RAYS_PER_TEXEL = 8
SKY_MAX_SIZE = 64

# Device bytes a sample: five vectors, the splat in its block with nodes, order and sort keys, sums and counts.
BYTES_PER_SAMPLE = 5 * 12 + 48 + 36 + 40
# And a primary hit of its own: three vectors, its number, its sums and counts.
BYTES_PER_HIT = 3 * 12 + 4 + 32


@dataclass(frozen=True)
class Preprocessing:
    """How splats are sized and read; the sections are of Lehtinen et al. 2012."""

    neighbours: int
    """k of the k-NN search, the sample counted (2.2)."""
    alpha: float
    """Stretch of distances along the normal (2.2)."""
    margin: float
    """Part of an input ray's length, at either end, in which a crossed splat is not shrunk (2.3.1)."""
    lone_radius: float
    """Part of its radius that a splat keeps where it is alone in the first surface (2.5)."""
    shrink: bool = True
    """Whether splats that input rays cross shrink (2.3.1)."""


@dataclass(frozen=True)
class PrimaryHits:
    """Where light is gathered, in pixel order; rows without a primary hit have coordinates of 1e10 and more."""

    origin: np.ndarray
    """Positions, shape (M, 3), float32."""
    normal: np.ndarray
    """Unit normals, shape (M, 3), float32."""
    albedo: np.ndarray
    """What they reflect, shape (M, 3), float32."""
    per_pixel: int
    """Rows of a pixel."""
    material: np.ndarray | None = None
    """Number of the scene's shape, whose material it is, shape (M,), int32; with the next two where glossy surfaces
    are recorded."""
    wo: np.ndarray | None = None
    """Unit vectors towards what sees them, shape (M, 3), float32."""
    reflectance: np.ndarray | None = None
    """Albedo of the material there, shape (M, 3), float32; `albedo` then multiplies the BSDF of what is not diffuse."""
    face: np.ndarray | None = None
    """Triangle, shape (M,), int32, -1: none; with the next one where it was asked for."""
    bary: np.ndarray | None = None
    """Barycentric coordinates of its first two corners, shape (M, 2), float32."""


class Reconstruction:
    """Splats made from samples, and sums of what reconstruction rays found for each receiver.

    Args:
        samples: the input; its unusable samples are left out and counted.
        device: where it computes.
        preprocessing: how splats are sized.
        seed: which reconstruction rays.
        hits: where light is gathered; None: at the samples' own primary hits.
        reach: distance within which a surface counts as near, for ambient occlusion.
        with_distance: keep what `inverse_distance` needs.

    Raises:
        ValueError: the samples hold no secondary rays, or do not fit into the device's memory limit.
    """

    def __init__(
        self,
        samples: SampleBuffer,
        device: Device,
        preprocessing: Preprocessing,
        seed: int,
        hits: PrimaryHits | None = None,
        reach: float = np.inf,
        recursions: int = 0,
        recursive_rays: int = 16,
        with_distance: bool = False,
    ) -> None:
        if not samples.has_secondary_rays:
            raise ValueError("samples hold no secondary rays, expected a sample buffer of format 2.0 or newer")
        if recursions and (samples.throughput is None or samples.hit_direct is None):
            raise ValueError("samples lack throughput or hit_direct, expected both for recursive filtering")
        need = len(samples) * BYTES_PER_SAMPLE
        if need > device.memory_limit:
            raise ValueError(f"memory_limit is {device.memory_limit} bytes, expected {need} for {len(samples)} samples")
        self.samples, self.device, self.seed = samples, device, seed
        self.reach = min(float(reach), 1e30)
        self.caustics: wp.array | None = None  # of the primary hits, where they come from elsewhere
        state = samples.checked
        splats = np.flatnonzero(state.is_splat).astype(np.int32)
        self._upload(splats, hits)
        is_primary = state.is_primary if hits is None else np.abs(hits.origin).max(axis=1) < NO_HIT
        self.primary = np.flatnonzero(is_primary).astype(np.int32)
        self.preprocessing = preprocessing
        self.escaped = np.flatnonzero(state.is_escaped).astype(np.int32)
        self._make_tree(splats)
        self.sky = make_sky(samples, self.escaped, device)
        self.counts = {name: count for name, count in state.counts.items() if name != "primary_missed"}
        self.counts |= {"splats": len(splats), "reconstruction_rays": 0}
        for _ in range(recursions):
            self._relight(splats, recursive_rays)
        per_pixel = self._per_pixel = samples.spp if hits is None else hits.per_pixel
        self._receivers = self._make_receivers(self.primary, self._receiver_origins, self._receiver_normals, per_pixel)
        self._found = np.zeros(4, np.int64)  # beside what `_gathered` counts
        self._gathered = self._make_gathered(len(self.primary))
        self._gathered.inverse_distance = device.zeros(len(self.primary) if with_distance else 0, float)
        self.rays_done = 0

    def gather(self, first: int, count: int, each: int) -> None:
        """Sends rays `first` to `first + count - 1` out of `each` from every receiver, and adds up what they find."""
        self._trace(self._receivers, self._gathered, len(self.primary), first, count, each)
        self.rays_done += count

    def reflected(self) -> wp.array:
        """Indirect light that each primary hit reflects, vec3 on the device; 0 for rows without one."""
        result = self.device.zeros(self._receiver_albedo.size, wp.vec3)
        inputs = [self._receivers, self._gathered, self.rays_done, self._receiver_albedo]
        self.device.launch(kernels.reflect, len(self.primary), inputs, [result])
        return result

    def fill_strata(self, hemispheres: Hemispheres, strata: wp.array, count: int) -> None:
        """Sends a ray into each stratum of `count` hemispheres, whose points are relative to `centre`."""
        counts = self.device.zeros(count, wp.vec4i)
        self._send(hemispheres, count, [strata, counts])
        self.counts["reconstruction_rays"] += len(strata)
        self._found += counts.numpy().sum(axis=0, dtype=np.int64)

    def irradiance_at(self, hits: np.ndarray, rays: int) -> wp.array:
        """Irradiance at some of the primary hits from `rays` rays each, vec3 on the device."""
        receivers = self._make_receivers(hits, self._receiver_origins, self._receiver_normals, self._per_pixel)
        gathered = self._make_gathered(len(hits))
        self._trace(receivers, gathered, len(hits), 0, rays, rays)
        result = self.device.zeros(len(hits), wp.vec3)
        self.device.launch(kernels.gathered_irradiance, len(hits), [gathered, rays], [result])
        self._found += gathered.counts.numpy().sum(axis=0, dtype=np.int64)
        return result

    def incident(self) -> np.ndarray:
        """Light that falls on each primary hit, irradiance over pi, shape (M, 3); 0 for rows without one."""
        result = np.zeros((self._receiver_albedo.size, 3), np.float32)
        known = self.rays_done - self._gathered.counts.numpy()[:, 0]
        result[self.primary] = self._gathered.radiance.numpy() / np.maximum(known, 1)[:, None]
        return result

    def inverse_distance(self) -> np.ndarray:
        """Mean over each primary hit's rays of one over their length, shape (M,); the sky's counts as 0."""
        result = np.zeros(self._receiver_albedo.size, np.float32)
        known = self.rays_done - self._gathered.counts.numpy()[:, 0]
        result[self.primary] = self._gathered.inverse_distance.numpy() / np.maximum(known, 1)
        return result

    def near(self) -> np.ndarray:
        """Share of each sample's rays that met a surface within reach, shape (N,); 0 without a primary hit."""
        result = np.zeros(len(self.samples), np.float32)
        known = self.rays_done - self._gathered.counts.numpy()[:, 0]
        result[self.primary] = self._gathered.near.numpy() / np.maximum(known, 1)
        return result

    def all_counts(self) -> dict[str, int]:
        """Rays so far, and what was dropped, cut short or without support."""
        found = self._found + self._gathered.counts.numpy().sum(axis=0, dtype=np.int64)
        names = ("missing_support", "sky_rays", "cut_gathers", "undersampled_surfaces")
        return self.counts | dict(zip(names, found.tolist(), strict=True))

    def _middle(self, low: np.ndarray, high: np.ndarray) -> np.ndarray:
        """The origin of positions, by the splats' bounds."""
        return 0.5 * (low + high)

    def _fit(self) -> None:
        """Makes splats ready for rays, once they are sized."""
        if self.preprocessing.shrink:
            self.tree.shrink(self.rays, self.preprocessing.margin, self.escaped, self.extent)

    def _send(self, hemispheres: Hemispheres, count: int, outputs: list[wp.array]) -> None:
        inputs = [self.tree.struct, self.sky, hemispheres, self.seed, self.noise, *self._kept_parts()]
        self.device.launch(kernels.reconstruct_strata, count, inputs, outputs)

    def _upload(self, splats: np.ndarray, receivers: PrimaryHits | None) -> None:
        """Positions relative to the splats' centre, so that float32 serves samples far away."""
        samples, device = self.samples, self.device
        used = samples.hit[splats] if len(splats) else np.zeros((1, 3), np.float32)
        low, high = used.min(axis=0), used.max(axis=0)
        self.centre = centre = self._middle(low, high)
        self.extent = float((high - low).max())  # of the splats
        self.noise = NOISE_ULPS * max(float(np.abs(low).max()), float(np.abs(high).max()), 1e-30)
        with np.errstate(invalid="ignore", over="ignore"):
            self._origins = device.array(samples.origin - centre, wp.vec3)
            self._hits = device.array(samples.hit - centre, wp.vec3)
        self._hit_normals = device.array(samples.unit_hit_normal, wp.vec3)
        self._radiance = device.array(samples.radiance, wp.vec3)
        if receivers is None:
            receivers = PrimaryHits(samples.origin, samples.unit_origin_normal, samples.albedo, samples.spp)
            self._receiver_origins = self._origins
        else:
            self._receiver_origins = device.array(receivers.origin - centre, wp.vec3)
        self._receiver_normals = device.array(receivers.normal, wp.vec3)
        self._receiver_albedo = device.array(receivers.albedo, wp.vec3)

    def _make_tree(self, splats: np.ndarray) -> None:
        """Splats of the size that their neighbours and the input rays leave them."""
        self.tree = SplatTree(self.device, self._hits, self._hit_normals, self._radiance, splats, self.noise)
        rays = kernels.Rays()
        rays.origins, rays.hits, rays.order = self._origins, self._hits, self.tree.order
        self.rays = rays
        self.tree.size_by_neighbours(rays, self.preprocessing.neighbours, self.preprocessing.alpha)
        self._fit()

    def _make_receivers(
        self, sample: np.ndarray, origins: wp.array, normals: wp.array, per_pixel: int
    ) -> kernels.Receivers:
        receivers = kernels.Receivers()
        receivers.sample = self.device.array(sample, int)
        receivers.origins, receivers.normals, receivers.spp = origins, normals, per_pixel
        pixels = places = np.zeros(0, np.int32)
        if self.samples.pixel is not None:
            pixels = self.samples.pixel
            first = np.searchsorted(pixels, pixels, side="left")
            places = (np.arange(len(pixels)) - first).astype(np.int32)
        receivers.pixels, receivers.places = self.device.array(pixels, int), self.device.array(places, int)
        return receivers

    def _make_gathered(self, count: int) -> kernels.Gathered:
        gathered = kernels.Gathered()
        gathered.radiance = self.device.zeros(count, wp.vec3)
        gathered.near = self.device.zeros(count, float)
        gathered.counts = self.device.zeros(count, wp.vec4i)
        return gathered

    def _trace(
        self, receivers: kernels.Receivers, gathered: kernels.Gathered, size: int, first: int, count: int, each: int
    ) -> None:
        inputs = [self.tree.struct, self.sky, receivers, each, first, count, self.seed, self.noise, self.reach]
        inputs += self._kept_parts()
        self.device.launch(kernels.reconstruct, size, inputs, [gathered])
        self.counts["reconstruction_rays"] += size * count

    def _kept_parts(self) -> list[float]:
        """Squared parts of their radius that one splat alone, and two, keep in the first surface."""
        lone = self.preprocessing.lone_radius
        # half the radius for one means two thirds for two
        return [lone**2, (1.0 - (1.0 - lone) * 2.0 / 3.0) ** 2]

    def _relight(self, splats: np.ndarray, rays: int) -> None:
        """Recursive filtering (section 4): the splats' own light, reconstructed, replaces what one path brought."""
        device, samples = self.device, self.samples
        receivers = self._make_receivers(splats, self._hits, self._hit_normals, samples.spp)
        gathered = self._make_gathered(len(splats))
        self._trace(receivers, gathered, len(splats), 0, rays, rays)
        parts = [device.array(part, wp.vec3) for part in (samples.hit_direct, samples.throughput)]
        device.launch(kernels.relight_splats, len(splats), [receivers, gathered, rays, *parts], [self._radiance])
        self.tree.set_radiance(self._radiance)


def make_sky(samples: SampleBuffer, escaped: np.ndarray, device: Device) -> kernels.Sky:
    """Mean radiance of escaped rays by direction; texels that no ray met take the mean of all."""
    sky = kernels.Sky()
    size = 0
    texels = np.zeros((0, 3), np.float32)
    if len(escaped):
        radiance = samples.radiance[escaped].astype(np.float64)
        varies = bool(np.ptp(radiance, axis=0).any())
        size = int(np.clip(np.sqrt(len(escaped) / SKY_RAYS_PER_TEXEL), 1, SKY_MAX_SIZE)) if varies else 1
        place = _octahedral(samples.direction[escaped], size)
        count = np.bincount(place, minlength=size * size)
        sums = [np.bincount(place, radiance[:, c], size * size) for c in range(3)]
        mean = radiance.mean(axis=0)
        filled = np.stack(sums, axis=-1) / np.maximum(count, 1)[:, None]
        texels = np.where(count[:, None] > 0, filled, mean).astype(np.float32)
    sky.size, sky.radiance = size, device.array(texels, wp.vec3)
    return sky


#: What a reconstruction launches, to be compiled first: a kernel of each module.
KERNELS = (kernels.reconstruct, *TREE_KERNELS, *SIZING_KERNELS)


def pixel_means(samples: SampleBuffer, values: np.ndarray) -> np.ndarray:
    """Mean of each pixel's samples, (N, 3) -> (H, W, 3) float32; 0 where a pixel has none."""
    shape = (samples.height, samples.width)
    if samples.pixel is None:
        return values.reshape(*shape, samples.spp, 3).mean(axis=2, dtype=np.float64).astype(np.float32)
    size = shape[0] * shape[1]
    count = np.maximum(np.bincount(samples.pixel, minlength=size), 1)
    sums = [np.bincount(samples.pixel, values[:, channel].astype(np.float64), size) for channel in range(3)]
    return (np.stack(sums, axis=-1) / count[:, None]).astype(np.float32).reshape(*shape, 3)


def _octahedral(direction: np.ndarray, size: int) -> np.ndarray:
    """Texel of each direction on the map that `kernels.light_field` reads, shape (N,)."""
    d = direction / np.abs(direction).sum(axis=1, keepdims=True)
    u, v = d[:, 0], d[:, 1]
    below = d[:, 2] < 0.0
    fold = [(1.0 - np.abs(b)) * np.where(a >= 0.0, 1.0, -1.0) for a, b in ((u, v), (v, u))]
    u, v = np.where(below, fold[0], u), np.where(below, fold[1], v)
    x, y = (np.clip(((0.5 * a + 0.5) * size).astype(np.int64), 0, size - 1) for a in (u, v))
    return y * size + x
