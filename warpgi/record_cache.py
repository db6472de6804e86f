"""An irradiance cache at work: records where primary hits need them, level by level, and interpolation between them.

Ward, Rubinstein, Clear 1988, in two passes. Pixels are looked at in a fixed order of grids, each finer than the last;
those of a grid are judged together by the records of the grids before, so that the cache depends neither on threads nor
on their order.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import warp as wp

from warpgi.device import Device
from warpgi.irradiance import IrradianceSource
from warpgi.kernels import irradiance_cache as kernels
from warpgi.kernels import regression_filter as filtering
from warpgi.kernels.hemisphere import sum_strata
from warpgi.reconstruction import NOISE_ULPS, PrimaryHits
from warpgi.records import Records
from warpgi.samples import NO_HIT
from warpgi.splat_tree import TREE_KERNELS, SplatTree

#: Pixels between those of the coarsest grid.
COARSEST = 32
# Of eight pixels around one with a record, those that must show the same surface.
SUPPORT = 3
# Device bytes of a primary hit: irradiance, what it reflects, a mark.
BYTES_PER_HIT = 2 * 12 + 4
# Rays of a pixel at which the filter over what they brought is as wide as the setting says.
SMOOTHED_RAYS = 16
# A record in front of which a point lies by more than this part of its radius is not used for it.
FRONT = 0.01

#: What a cache launches, to be compiled first: a kernel of each module.
KERNELS = (kernels.interpolate, sum_strata, filtering.regress, *TREE_KERNELS)


@dataclass(frozen=True)
class Caching:
    """How records are placed and used."""

    tolerance: float
    """a: a record serves where its error is below (Ward et al. 1988)."""
    overlap: float
    """Interpolation takes records of up to so many times that tolerance."""
    spread: float
    """Relative standard deviation of what records say, above which there is to be one more."""
    rays: int
    """Rays of a record, about: strata of a hemisphere, pi times as many in azimuth as in the polar angle."""
    smallest: float
    """Least radius of a record in pixels."""
    largest: float
    """Largest radius of a record in pixels."""
    finest: int
    """Pixels between those of the finest grid; what it leaves without a record is gathered hit by hit."""
    gradients: bool
    """Extrapolate records by their gradients."""
    smoothing: float
    """Radius in pixels of the filter over hits that no record serves, at 16 rays a pixel; 0: none."""

    @property
    def rings(self) -> int:
        """Strata of the polar angle."""
        return strata(self.rays)[0]

    @property
    def sectors(self) -> int:
        """Strata of the azimuth."""
        return strata(self.rays)[1]

    @property
    def rounds(self) -> list[list[tuple[int, int, int]]]:
        """See `grids`."""
        return grids(COARSEST, self.finest)


def strata(rays: int) -> tuple[int, int]:
    """Rings and sectors of a hemisphere, about `rays` in all: pi times as many in azimuth as in the polar angle."""
    rings = max(1, round(math.sqrt(rays / math.pi)))
    return rings, max(1, round(rays / rings))


def grids(coarsest: int, finest: int) -> list[list[tuple[int, int, int]]]:
    """Rounds of (step, x, y): every pixel of the finest grid once, neighbours of a round as far apart as can be."""
    half = coarsest // 2
    rounds = [[(coarsest, half, half)]]
    step = coarsest
    while step > finest:
        half = step // 2
        # the centres of the squares so far, then the middles of their sides; everything modulo the step
        at = rounds[-1][-1][1] if step == coarsest else 0
        a = (at + half) % step
        rounds.append([(step, a, a)])
        rounds.append([(step, a, at % step), (step, at % step, a)])
        step = half
    return rounds


class RecordCache:
    """Records for the primary hits of a picture.

    Args:
        device: where it computes.
        hits: where light is wanted, relative to the device's origin or the samples' own.
        size: (width, height) in pixels.
        source: where irradiance comes from.
        caching: how.
        known: records to begin with.
        apart: numbers of primary hits that are gathered one by one, as their surfaces are not diffuse; None: none.
    """

    def __init__(
        self,
        device: Device,
        hits: PrimaryHits,
        size: tuple[int, int],
        source: IrradianceSource,
        caching: Caching,
        known: Records | None = None,
        apart: np.ndarray | None = None,
    ) -> None:
        self.device, self.size, self.source, self.caching, self._hits = device, size, source, caching, hits
        self.rounds = caching.rounds
        self.records = Records.empty() if known is None else known
        self.record_pixels = np.zeros(0, np.int64)
        self._albedo = device.array(hits.albedo, wp.vec3)
        self._struct = kernels.Hits()
        self.apart = np.zeros(0, np.int32) if apart is None else apart
        origins = hits.origin
        if len(self.apart):
            origins = origins.copy()
            origins[self.apart] = NO_HIT
        self._struct.origins, self._struct.normals = (device.array(a, wp.vec3) for a in (origins, hits.normal))
        self._struct.per_pixel, (self._struct.width, self._struct.height) = hits.per_pixel, size
        x, y, z = np.abs(origins).T
        reach = np.maximum(np.maximum(x, y), z)
        met = reach < NO_HIT
        largest = float(reach[met].max(initial=1e-30))
        self.noise = NOISE_ULPS * largest
        self._build()
        self.rounds_done = 0
        self.counts = {"records": len(self.records), "fallback_hits": 0, "hits": int(np.count_nonzero(met))}
        if len(self.apart):
            self.counts["glossy_hits"] = len(self.apart)

    def fill(self, first: int, count: int) -> None:
        """Makes the records of rounds `first` to `first + count - 1`."""
        for places in self.rounds[first : first + count]:
            self._fill_round(places)
        self.rounds_done = first + count

    def reflected(self, fallback_rays: int) -> wp.array:
        """Indirect light that each primary hit reflects, vec3 on the device.

        Args:
            fallback_rays: rays per pixel where no record serves.
        """
        device, hits = self.device, self._struct
        count, pixels = len(self._hits.origin), self.size[0] * self.size[1]
        irradiance, reflected = (device.zeros(count, wp.vec3) for _ in range(2))
        uncovered = device.zeros(count, int)
        device.launch(kernels.interpolate, pixels, [self._kernel_records, hits, 0], [irradiance, uncovered])
        alone = np.flatnonzero(uncovered.numpy()).astype(np.int32)
        self.counts["fallback_hits"] = len(alone)
        # an unfinished cache leaves many, and is to be shown soon
        rays = fallback_rays if self.rounds_done == len(self.rounds) else 1
        for some in (alone, self.apart):
            if len(some):
                values = self.source.at_hits(some, max(1, round(rays / self._hits.per_pixel)))
                device.launch(kernels.place_irradiance, len(some), [values, device.array(some, int)], [irradiance])
            if some is alone and len(some):
                self._smooth(uncovered, rays, irradiance)
        device.launch(kernels.reflect_irradiance, count, [irradiance, self._albedo], [reflected])
        return reflected

    def picture(self) -> np.ndarray:
        """Where this picture's records are: 1 in their pixels, shape (H, W, 1), float32."""
        layer = np.zeros(self.size[0] * self.size[1], np.float32)
        layer[self.record_pixels] = 1.0
        return layer.reshape(self.size[1], self.size[0], 1)

    def all_counts(self) -> dict[str, int]:
        """Records, hits without one, and rays."""
        return self.counts | self.source.counts

    def _smooth(self, uncovered: wp.array, rays: int, irradiance: wp.array) -> None:
        """Filters irradiance at uncovered hits, where `rays` brought it to a pixel; fewer need a wider filter."""
        radius = self.caching.smoothing * (SMOOTHED_RAYS / max(rays, self._hits.per_pixel)) ** 0.5
        if radius <= 0.0:
            return
        device, count = self.device, self.size[0] * self.size[1]
        pixels = filtering.Pixels()
        pixels.position, pixels.normal, pixels.irradiance = (device.zeros(count, wp.vec3) for _ in range(3))
        pixels.hits, pixels.wanted = device.zeros(count, int), device.zeros(count, int)
        device.launch(filtering.average_hits, count, [self._struct, irradiance, uncovered], [pixels])
        device.launch(filtering.regress, count, [self._struct, uncovered, pixels, radius], [irradiance])

    def _fill_round(self, places: list[tuple[int, int, int]]) -> None:
        device, caching = self.device, self.caching
        width, height = self.size
        grids = [
            (np.arange(y, height, step)[:, None] * width + np.arange(x, width, step)).ravel() for step, x, y in places
        ]
        candidates = np.concatenate(grids).astype(np.int32)
        wanted, footprint = device.zeros(len(candidates), int), device.zeros(len(candidates), float)
        inputs = [self._kernel_records, self._struct, device.array(candidates, int)]
        inputs += [caching.tolerance, caching.spread, SUPPORT]
        device.launch(kernels.find_uncovered, len(candidates), inputs, [wanted, footprint])
        new = np.flatnonzero(wanted.numpy() >= 0)
        if not len(new):
            return
        hits = wanted.numpy()[new]
        points, normals = self._hits.origin[hits], self._hits.normal[hits]
        known = self.source.at_points(points, normals, hits, caching.rings, caching.sectors)
        pixel = footprint.numpy()[new]
        made = Records.made(
            points, normals, known, caching.smallest * pixel, caching.largest * pixel, caching.gradients
        )
        self.records = Records.joined([self.records, made])
        self.record_pixels = np.concatenate([self.record_pixels, hits // self._hits.per_pixel])
        self.counts["records"] = len(self.records)
        self._build()

    def _build(self) -> None:
        """A tree over the records, with radii by their neighbours."""
        device, records, caching = self.device, self.records, self.caching
        count = len(records)
        positions, normals, values = (
            device.array(array, wp.vec3) for array in (records.position, records.normal, records.irradiance)
        )
        tree = SplatTree(device, positions, normals, values, np.arange(count, dtype=np.int32), self.noise)
        order = tree.order.numpy()
        clamped = device.zeros(count, float)
        device.launch(kernels.clamp_radii, count, [tree.struct, device.array(records.radius[order], float)], [clamped])
        radius = clamped.numpy()
        most = caching.tolerance * caching.overlap
        tree.set_radius2(device.array(np.square(most * radius), float))
        tree.refit_as_balls()
        packed = records.packed()[order]
        packed[:, 0] = radius
        struct = kernels.Records()
        struct.tree, struct.values = tree.struct, device.array(packed.ravel(), float)
        struct.most, struct.front = most, -((FRONT / most) ** 2)
        self._tree, self._kernel_records = tree, struct  # structs do not keep their arrays alive
