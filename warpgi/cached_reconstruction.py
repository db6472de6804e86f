"""The hybrid: an irradiance cache whose records come from the splats of a light field."""

from __future__ import annotations

import numpy as np
import warp as wp

from warpgi.irradiance import SplatSource
from warpgi.materials import Diffuse
from warpgi.reconstruction import PrimaryHits, Reconstruction
from warpgi.record_cache import Caching, RecordCache
from warpgi.samples import NO_HIT, SampleBuffer


class CachedReconstruction:
    """A `Reconstruction` that is gathered at an irradiance cache's records instead of every primary hit.

    Args:
        reconstruction: splats of a sample buffer.
        hits: where light is wanted; None: at the samples' own primary hits.
        caching: how records are placed.
        fallback_rays: rays per pixel where no record serves.

    Raises:
        ValueError: samples lie irregularly.
    """

    def __init__(
        self, reconstruction: Reconstruction, hits: PrimaryHits | None, caching: Caching, fallback_rays: int
    ) -> None:
        samples = reconstruction.samples
        if hits is None:
            if samples.pixel is not None:
                raise ValueError("samples lie irregularly, expected as many in each pixel for cache")
            hits = PrimaryHits(
                samples.origin, samples.unit_origin_normal, samples.albedo, samples.spp, samples.material
            )
        self.reconstruction, self.fallback_rays = reconstruction, fallback_rays
        self.caustics: wp.array | None = None
        size = (samples.width, samples.height)
        self.cache = RecordCache(
            reconstruction.device, hits, size, SplatSource(reconstruction), caching, None, glossy_hits(samples, hits)
        )

    @property
    def samples(self) -> SampleBuffer:
        """The input."""
        return self.reconstruction.samples

    def gather(self, first: int, count: int, each: int) -> None:
        """Makes the records of levels `first` to `first + count - 1` out of `each`."""
        self.cache.fill(first, count)

    def reflected(self) -> wp.array:
        """Indirect light that each primary hit reflects, vec3 on the device; 0 for rows without one."""
        return self.cache.reflected(self.fallback_rays)

    def records(self) -> np.ndarray:
        """Where records are, shape (H, W, 1)."""
        return self.cache.picture()

    def all_counts(self) -> dict[str, int]:
        """Records, hits without one, rays so far, and what was dropped, cut short or without support."""
        return self.reconstruction.all_counts() | self.cache.all_counts()


def glossy_hits(samples: SampleBuffer, hits: PrimaryHits) -> np.ndarray:
    """Numbers of the primary hits whose light depends on where it is seen from, int32: no irradiance serves them."""
    if hits.material is None:
        return np.zeros(0, np.int32)
    glossy = np.array([not isinstance(material, Diffuse) for material in samples.materials])
    met = np.abs(hits.origin).max(axis=1) < NO_HIT
    return np.flatnonzero(met & glossy[hits.material]).astype(np.int32)
