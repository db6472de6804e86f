"""Irradiance filtering (Kontkanen, Räsänen, Keller 2004)."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
import warp as wp

from warpgi import checks
from warpgi.device import Device
from warpgi.filtering import Filtering, FilterInput, SampleFilter, check_memory, gathered_rows, layer_rows, pixel_rows
from warpgi.kernels import irradiance_filter as kernels
from warpgi.kernels.samples import trace_samples
from warpgi.methods.light_field import LightField
from warpgi.reconstruction import BYTES_PER_HIT, BYTES_PER_SAMPLE, KERNELS, PrimaryHits, Reconstruction
from warpgi.samples import SampleBuffer, unit
from warpgi.sampling import PRIMARY_BYTES, SECONDARY_BYTES

# Vectors and numbers of a pixel on the device.
PIXEL_BYTES = 12 * 9 + 4

# The work of a picture in as many parts, for the progress bar.
PARTS = 32


@dataclass(frozen=True, kw_only=True)
class IrradianceFilter(SampleFilter):
    """Irradiance filter (Kontkanen et al. 2004): averages more of a surface the farther away what it sees is.

    The support is a sphere in the scene, in proportion to the harmonic mean distance of the secondary hits; weights
    fall with distance and difference of normals. Filters what diffuse surfaces reflect; what others do keeps its
    path-traced light. With `rays` it filters light that few reconstruction rays gathered from the samples' light field
    (Lehtinen et al. 2012), guided by their lengths: less error than the same rays or the same samples alone.

    Raises:
        TypeError, ValueError: a setting is out of range, or they contradict each other.
    """

    rays: int = 0
    """Reconstruction rays per pixel, shared out over its primary hits, whose light is filtered; 0: that of the samples
    themselves is."""
    primary_hits: int | None = None
    """Primary hits per pixel at which light is gathered, `spp` or more; None is `spp`. Smooth edges need 4 or so, which
    one sample per pixel has not. Only with `rays`."""
    support: float = 0.4
    """Radius in times the harmonic mean distance, above 0; larger is smoother and blurs more."""
    min_radius: float = 8.0
    """Smallest radius, in distances of neighbouring pixels; the filter is as wide as that in corners."""
    max_radius: float = 16.0
    """Largest radius, likewise; time grows with its square."""
    angle: float = 50.0
    """Difference of normals at which weights reach 0, in (0, 180] degrees."""
    demodulate: bool = True
    """Divide layers by albedo first, so that textures stay sharp; samples come without it."""

    def __post_init__(self) -> None:
        super().__post_init__()
        checks.count("rays", self.rays, 0)
        if self.primary_hits is not None:
            checks.count("primary_hits", self.primary_hits, self.spp)
            if not self.rays:
                raise ValueError(f"primary_hits is {self.primary_hits}, expected None where rays is 0")
        checks.number("support", self.support, 0.0, open_lower=True)
        checks.number("min_radius", self.min_radius, 0.0, 1e4, open_lower=True)
        checks.number("max_radius", self.max_radius, self.min_radius, 1e4)
        checks.number("angle", self.angle, 0.0, 180.0, open_lower=True)

    @property
    def kernels(self) -> tuple[wp.Kernel, ...]:
        """What it launches."""
        return (trace_samples, *(KERNELS if self.rays else ()), *self.filter_kernels)

    @property
    def filter_kernels(self) -> tuple[wp.Kernel, ...]:
        """What it launches on an input that is there."""
        return (kernels.filter_pixels,)

    @property
    def hits(self) -> int:
        """Primary hits per pixel that are traced."""
        return self.primary_hits or self.spp

    def passes(self, spp: int | None = None) -> tuple[int, str]:
        """Rays for each primary hit, at `spp` of them in a pixel, and parts of the picture: the units of its work."""
        if not self.rays:
            return PARTS, "parts"
        return max(1, round(self.rays / (spp or self.hits))) + PARTS, "rays per hit and parts"

    def filter_bytes(self) -> int:
        """Device memory of the filter for a sample, of which every pixel has one or more."""
        return PIXEL_BYTES

    def device_bytes(self, size: tuple[int, int]) -> int:
        """Device memory it takes beside scene and film."""
        if not self.rays:
            return super().device_bytes(size)
        hit, ray = PRIMARY_BYTES + BYTES_PER_HIT + 4, SECONDARY_BYTES + BYTES_PER_SAMPLE
        return size[0] * size[1] * (self.hits * hit + self.spp * ray + PIXEL_BYTES)

    def reconstruction(self, samples: SampleBuffer, device: Device, seed: int) -> Filtering:
        """The filter on the means of each pixel's samples, or on what is gathered from them."""
        if self.rays:
            return SparseFiltering(samples, None, device, seed, self)
        return IrradianceFiltering(pixel_rows(samples), device, self)

    def filtering(self, samples: SampleBuffer, hits: PrimaryHits, device: Device, seed: int) -> Filtering:
        """The same, with light gathered at primary hits of its own."""
        if self.rays:
            return SparseFiltering(samples, hits, device, seed, self)
        return self.reconstruction(samples, device, seed)

    def on_layers(self, layers: Mapping[str, np.ndarray], name: str, device: Device) -> IrradianceFiltering:
        """The filter on the pixels of layer `name`."""
        for wanted in ("hit_distance", "normal"):
            if wanted not in layers:
                raise ValueError(f"layers hold {', '.join(layers)}, expected {wanted} too for IrradianceFilter")
        return IrradianceFiltering(layer_rows(layers, name, self.demodulate, True, True), device, self)


class IrradianceFiltering:
    """The filter over the pixels of a picture, part by part.

    Args:
        rows: the input, a row a pixel.
        device: where it computes.
        settings: the filter's.

    Raises:
        ValueError: it does not fit into the device's memory limit.
    """

    def __init__(self, rows: FilterInput, device: Device, settings: IrradianceFilter) -> None:
        check_memory(device, len(rows.pixel), PIXEL_BYTES)
        self.rows, self.device = rows, device
        footprint = rows.footprint().astype(np.float64)
        self.filter = SurfaceFilter(
            (rows.width, rows.height), unit(rows.normal), rows.position, device, settings.max_radius, settings.angle
        )
        assert rows.hit_distance is not None
        low, high = settings.min_radius * footprint, settings.max_radius * footprint
        radius = np.clip(settings.support * self._smooth(rows.hit_distance, low), low, high)
        self.radius = radius.astype(np.float32)
        self.value, self.known = device.array(rows.value, wp.vec3), device.array(rows.known, wp.vec3)
        # what is not done yet stays as it came
        self.filtered, self.filled = device.array(rows.value, wp.vec3), device.array(rows.known, wp.vec3)

    def _smooth(self, distance: np.ndarray, radius: np.ndarray) -> np.ndarray:
        """Harmonic mean distance of more than a pixel's few rays; infinite where none met anything."""
        known = np.isfinite(distance)
        with np.errstate(divide="ignore"):
            inverse = np.where(known & (distance > 0), 1.0 / np.where(distance > 0, distance, 1.0), 0.0)
        flags = known.astype(np.float32)
        inverse = self.filter.run(_triple(inverse), _triple(flags), radius.astype(np.float32))[:, 0]
        with np.errstate(divide="ignore"):
            return 1.0 / inverse.astype(np.float64)

    def gather(self, first: int, count: int, total: int) -> None:
        """Does parts `first` to `first + count - 1` of the picture."""
        pixels = len(self.rows.pixel)
        start, stop = (part * pixels // total for part in (first, first + count))
        self.filter.launch(self.value, self.known, self.radius, start, stop, [self.filtered, self.filled])

    def picture(self) -> np.ndarray:
        """Filtered light, shape (H, W, 3)."""
        return self.rows.picture(self.rows.light(self.filtered.numpy(), self.filled.numpy()))

    def all_counts(self) -> dict[str, int]:
        """What was left out."""
        return self.rows.counts


class SparseFiltering:
    """Reconstruction rays at every pixel, then the filter on what they brought.

    Args:
        samples: the light field.
        hits: where light is gathered; None: at the samples' own primary hits.
        device: where it computes.
        seed: which rays.
        settings: of both.
    """

    def __init__(
        self, samples: SampleBuffer, hits: PrimaryHits | None, device: Device, seed: int, settings: IrradianceFilter
    ) -> None:
        self.hits, self.device, self.settings = hits, device, settings
        sizing = LightField().preprocessing
        self.light = Reconstruction(samples, device, sizing, seed, hits, with_distance=True)
        self.filter: IrradianceFiltering | None = None

    def gather(self, first: int, count: int, total: int) -> None:
        """Does units `first` to `first + count - 1` of `total`, the last of which are the filter's."""
        rays = total - PARTS
        stop = first + count
        if first < rays:
            self.light.gather(first, min(stop, rays) - first, rays)
        if stop > rays:
            self.filter = self.filter or self._start()
            start = max(first, rays)
            self.filter.gather(start - rays, stop - start, PARTS)

    def picture(self) -> np.ndarray:
        """Filtered light, shape (H, W, 3); gathered light where the filter has not been yet."""
        return (self.filter or self._start()).picture()

    def all_counts(self) -> dict[str, int]:
        """Rays so far, and what was dropped or without support."""
        return self.light.all_counts()

    def _start(self) -> IrradianceFiltering:
        light = self.light
        rows = gathered_rows(light.samples, self.hits, light.incident(), light.inverse_distance())
        return IrradianceFiltering(rows, self.device, self.settings)


class SurfaceFilter:
    """Spatially varying filter of any three values on the surfaces that a picture shows.

    Args:
        size: (width, height) in pixels.
        normal: unit normals, shape (H W, 3); 0: not part of the filter.
        position: shape (H W, 3).
        device: where it computes.
        reach: pixels beyond which it does not look.
        angle: difference of normals at which weights reach 0 [degrees].
    """

    def __init__(
        self,
        size: tuple[int, int],
        normal: np.ndarray,
        position: np.ndarray,
        device: Device,
        reach: float,
        angle: float,
    ) -> None:
        self.device, self.reach = device, math.ceil(reach)
        self.spread = 1.0 - math.cos(math.radians(angle))
        surfaces = kernels.Surfaces()
        surfaces.width, surfaces.height = size
        surfaces.normal, surfaces.position = device.array(normal, wp.vec3), device.array(position, wp.vec3)
        self.surfaces = surfaces

    def run(self, values: np.ndarray, known: np.ndarray, radius: np.ndarray) -> np.ndarray:
        """Filtered `values`, shape (H W, 3); `known` is 1 where they count, `radius` shape (H W,), float32."""
        inputs = [self.device.array(array, wp.vec3) for array in (values, known)]
        outputs = [self.device.zeros(len(values), wp.vec3) for _ in range(2)]
        self.launch(inputs[0], inputs[1], radius, 0, len(values), outputs)
        return outputs[0].numpy().copy()

    def launch(
        self, values: wp.array, known: wp.array, radius: np.ndarray, start: int, stop: int, outputs: list[wp.array]
    ) -> None:
        """Filters pixels `start` to `stop - 1` on the device."""
        # a radius of 0, where neighbouring pixels show one point, would divide by it
        bound = self.device.array(np.maximum(radius, np.float32(1e-30)), float)
        inputs = [start, self.surfaces, bound, self.reach, self.spread, values, known]
        self.device.launch(kernels.filter_pixels, stop - start, inputs, outputs)


def _triple(values: np.ndarray) -> np.ndarray:
    return np.repeat(values.astype(np.float32)[:, None], 3, axis=1)
