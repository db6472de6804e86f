"""Irradiance at points, with gradients and distances: by path tracing, or by reconstruction rays on splats."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np
import warp as wp

from warpgi.device import Device
from warpgi.job import Job
from warpgi.kernels import hemisphere, path_strata
from warpgi.kernels.path import PathSettings
from warpgi.kernels.scene import OFFSET_ULPS
from warpgi.reconstruction import PrimaryHits, Reconstruction

# Bytes of strata on the device at a time; a stratum takes 16.
STRATA_BYTES = 64 << 20


@dataclass(frozen=True, eq=False)
class Irradiance:
    """What is known of the light at N points; all float32."""

    value: np.ndarray
    """Irradiance of indirect light [W/m^2], shape (N, 3)."""
    rotation: np.ndarray
    """Derivative by turns of the normal, (n x n') . rotation for each channel, shape (N, 3 channels, 3)."""
    translation: np.ndarray
    """Derivative by position, shape (N, 3 channels, 3)."""
    harmonic: np.ndarray
    """Harmonic mean of the distances of what the rays met [scene units], shape (N,); far beyond any scene: nothing."""
    nearest: np.ndarray
    """The least of them, shape (N,)."""


class IrradianceSource(Protocol):
    """Where a cache's irradiance comes from."""

    #: Rays so far, by kind.
    counts: dict[str, int]

    def at_points(
        self, points: np.ndarray, normals: np.ndarray, keys: np.ndarray, rings: int, sectors: int
    ) -> Irradiance:
        """Irradiance with all that is known of it at points of surfaces, from rings x sectors rays each.

        Args:
            points: shape (N, 3), float32, in the coordinates of the primary hits.
            normals: unit vectors on the side that is lit, shape (N, 3), float32.
            keys: of the random numbers, shape (N,), int32.
            rings: strata of the polar angle.
            sectors: strata of the azimuth.
        """

    def at_hits(self, hits: np.ndarray, rays: int) -> wp.array:
        """Irradiance at some of the primary hits, by number, int32, from `rays` rays each; vec3 on the device."""


class PathSource:
    """Irradiance by path tracing.

    Args:
        job: the scene.
        hits: the primary hits, relative to the device's origin.
        settings: of the paths, the segment to the point counted.
    """

    def __init__(self, job: Job, hits: PrimaryHits, settings: PathSettings) -> None:
        self.device, self.scene, self.per_pixel = job.device, job.scene, hits.per_pixel
        self.settings = settings
        self.step = float(OFFSET_ULPS) * job.scene.radius
        self._origins, self._normals = (self.device.array(a, wp.vec3) for a in (hits.origin, hits.normal))
        self.counts = {"record_rays": 0, "fallback_rays": 0}

    def at_points(
        self, points: np.ndarray, normals: np.ndarray, keys: np.ndarray, rings: int, sectors: int
    ) -> Irradiance:
        """See `IrradianceSource`."""

        def fill(hemispheres: hemisphere.Hemispheres, strata: wp.array, count: int) -> None:
            inputs = [self.scene.struct, self.settings, self.step, hemispheres]
            self.device.launch(path_strata.trace_strata, count, inputs, [strata])

        self.counts["record_rays"] += len(points) * rings * sectors
        return sum_hemispheres(self.device, points, normals, keys, rings, sectors, fill)

    def at_hits(self, hits: np.ndarray, rays: int) -> wp.array:
        """See `IrradianceSource`."""
        result = self.device.zeros(len(hits), wp.vec3)
        inputs = [self.scene.struct, self.settings, self.step, self.device.array(hits, int)]
        inputs += [self._origins, self._normals, self.per_pixel, rays]
        self.device.launch(path_strata.gather_paths, len(hits), inputs, [result])
        self.counts["fallback_rays"] += len(hits) * rays
        return result


class SplatSource:
    """Irradiance by reconstruction rays: no path is traced, and no scene is needed (Lehtinen et al. 2012).

    Args:
        reconstruction: splats of a sample buffer.
    """

    def __init__(self, reconstruction: Reconstruction) -> None:
        self.reconstruction, self.device = reconstruction, reconstruction.device
        self.counts = {"record_rays": 0, "fallback_rays": 0}

    def at_points(
        self, points: np.ndarray, normals: np.ndarray, keys: np.ndarray, rings: int, sectors: int
    ) -> Irradiance:
        """See `IrradianceSource`."""

        def fill(hemispheres: hemisphere.Hemispheres, strata: wp.array, count: int) -> None:
            self.reconstruction.fill_strata(hemispheres, strata, count)

        self.counts["record_rays"] += len(points) * rings * sectors
        points = points - self.reconstruction.centre
        return sum_hemispheres(self.device, points, normals, keys, rings, sectors, fill)

    def at_hits(self, hits: np.ndarray, rays: int) -> wp.array:
        """See `IrradianceSource`."""
        self.counts["fallback_rays"] += len(hits) * rays
        return self.reconstruction.irradiance_at(hits, rays)


def sum_hemispheres(
    device: Device, points: np.ndarray, normals: np.ndarray, keys: np.ndarray, rings: int, sectors: int, fill
) -> Irradiance:
    """Sums over strata that `fill` fills, some points at a time."""
    size = rings * sectors
    batch = max(1, STRATA_BYTES // (16 * size))
    parts: list[tuple[np.ndarray, ...]] = []
    for start in range(0, len(points), batch):
        some = slice(start, start + batch)
        count = len(points[some])
        h = hemisphere.Hemispheres()
        h.points, h.normals = (device.array(a[some], wp.vec3) for a in (points, normals))
        h.keys, h.rings, h.sectors = device.array(keys[some], int), rings, sectors
        strata = device.zeros(count * size, wp.vec4)
        fill(h, strata, count)
        result = hemisphere.Irradiance()
        result.value = device.zeros(count, wp.vec3)
        result.rotation, result.translation = (device.zeros((count, 3), wp.vec3) for _ in range(2))
        result.harmonic, result.nearest = (device.zeros(count, float) for _ in range(2))
        device.launch(hemisphere.sum_strata, count, [h, strata], [result])
        names = ("value", "rotation", "translation", "harmonic", "nearest")
        parts.append(tuple(getattr(result, name).numpy() for name in names))
    if not parts:
        empty = [np.zeros((0, *shape), np.float32) for shape in ((3,), (3, 3), (3, 3), (), ())]
        return Irradiance(*empty)
    return Irradiance(*(np.concatenate(arrays) for arrays in zip(*parts, strict=True)))
