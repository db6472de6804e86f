"""Hierarchical meshless basis (Lehtinen, Zwicker, Turquin, Kontkanen, Durand, Aila 2008)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import warp as wp

from warpgi import checks
from warpgi.device import Device
from warpgi.film import Film
from warpgi.filtering import Filtering, SampleFilter
from warpgi.irradiance import PathSource, SplatSource
from warpgi.job import Job
from warpgi.kernels import meshless_hierarchy as kernels
from warpgi.kernels.path_strata import trace_strata
from warpgi.kernels.poisson_disc import throw_darts
from warpgi.kernels.samples import trace_samples
from warpgi.meshless import BYTES_PER_HIT, Refinement
from warpgi.meshless import MeshlessHierarchy as Hierarchy
from warpgi.methods.light_field import LightField
from warpgi.methods.path import NEVER
from warpgi.reconstruction import BYTES_PER_HIT as BYTES_PER_RECEIVER
from warpgi.reconstruction import BYTES_PER_SAMPLE, KERNELS, PrimaryHits, Reconstruction, pixel_means
from warpgi.samples import NO_HIT, SampleBuffer
from warpgi.sampling import PRIMARY_BYTES, SECONDARY_BYTES, path_settings, trace_primary_hits


@dataclass(frozen=True, kw_only=True)
class MeshlessHierarchy(SampleFilter):
    """Irradiance computed at few points of surfaces, finer where it varies, and smooth between (Lehtinen et al. 2008).

    Points of a level are a Poisson-disc subset of the primary hits; radii halve from level to level. A level's basis
    functions are normalised to a partition of unity, its coefficients are what coarser levels leave of the irradiance
    at its points, and where these are small nothing finer is computed. Reconstructs what diffuse surfaces reflect; what
    others do keeps its path-traced light.

    Raises:
        TypeError, ValueError: a setting is out of range.
    """

    tolerance: float = 0.2
    """Coefficient, relative to irradiance, below which nothing finer is computed around a point, 0 or above; points and
    time grow as it falls, and far more so once it is below a few times the noise of a point's rays."""
    rays: int = 256
    """Reconstruction rays from each point; too few of them are seen as blotches."""
    paths: bool = False
    """Path-trace the light at points instead of reconstructing it from samples; `rays` are then paths, and `spp` counts
    for `primary_hits` alone. It needs a scene; thin walls stop it, and it takes longer."""
    radius: float = 0.1
    """Radius of the first level's discs, as a part of the largest side of what is seen."""
    levels: int = 7
    """Levels at most; radii halve from one to the next."""
    primary_hits: int | None = None
    """Primary hits per pixel, `spp` or more; None is `spp`. More of them make smooth edges and textures."""

    def __post_init__(self) -> None:
        super().__post_init__()
        checks.number("tolerance", self.tolerance, 0.0)
        checks.count("rays", self.rays)
        checks.number("radius", self.radius, 0.0, 1.0, open_lower=True)
        checks.count("levels", self.levels, 1, 16)
        if self.primary_hits is not None:
            checks.count("primary_hits", self.primary_hits, self.spp)

    @property
    def kernels(self) -> tuple[wp.Kernel, ...]:
        """What it launches."""
        return (trace_samples, trace_strata if self.paths else KERNELS[0], *KERNELS[1:], throw_darts, kernels.add_level)

    @property
    def hits(self) -> int:
        """Primary hits per pixel that are traced."""
        return self.primary_hits or self.spp

    def passes(self, spp: int | None = None) -> tuple[int, str]:
        """Levels, the unit of its work."""
        return self.levels, "levels"

    def device_bytes(self, size: tuple[int, int]) -> int:
        """Device memory it takes beside scene and film."""
        hit = PRIMARY_BYTES + BYTES_PER_RECEIVER + BYTES_PER_HIT
        return size[0] * size[1] * (self.hits * hit + self.spp * (SECONDARY_BYTES + BYTES_PER_SAMPLE))

    def prepare(self, job: Job, film: Film) -> Filtering:
        """Traces what light is gathered at, and the samples that it is gathered from; the rest goes to the film."""
        if not self.paths:
            return super().prepare(job, film)
        depth, roulette = self.max_depth or NEVER, self.roulette_depth or NEVER
        settings = path_settings(job, depth, roulette, self.sampler)
        hits = trace_primary_hits(job, film, self.hits, max(1, self.light_samples // self.hits), settings)
        source = PathSource(job, hits, path_settings(job, depth - 1, roulette, self.sampler))
        return MeshlessFiltering(hits, source, job.size, job.device, job.seed, self)

    def reconstruction(self, samples: SampleBuffer, device: Device, seed: int) -> MeshlessFiltering:
        """A hierarchy at the samples' own primary hits."""
        if self.paths:
            raise ValueError("paths is True, expected False where there are samples and no scene")
        own = PrimaryHits(samples.origin, samples.unit_origin_normal, samples.albedo, samples.spp)
        return self.filtering(samples, own, device, seed)

    def filtering(self, samples: SampleBuffer, hits: PrimaryHits, device: Device, seed: int) -> MeshlessFiltering:
        """A hierarchy at primary hits, of light from the samples."""
        light = Reconstruction(samples, device, LightField().preprocessing, seed, hits)
        size = (samples.width, samples.height)
        return MeshlessFiltering(hits, SplatSource(light), size, device, seed, self, samples)


class MeshlessFiltering:
    """A hierarchy at a picture's primary hits, level by level.

    Args:
        hits: where light is wanted.
        source: where it comes from.
        size: (width, height) in pixels.
        device: where it computes.
        seed: which points.
        settings: how far it goes.
        samples: whose own the hits are; None: all pixels have as many.
    """

    def __init__(
        self,
        hits: PrimaryHits,
        source: PathSource | SplatSource,
        size: tuple[int, int],
        device: Device,
        seed: int,
        settings: MeshlessHierarchy,
        samples: SampleBuffer | None = None,
    ) -> None:
        self.source, self.samples, self.per_pixel, self.size = source, samples, hits.per_pixel, size
        seen = hits.origin[np.abs(hits.origin).max(axis=1) < NO_HIT]
        extent = float(np.ptp(seen, axis=0).max()) if len(seen) else 1.0
        refinement = Refinement(
            max(settings.radius * extent, 1e-30), settings.levels, settings.tolerance, settings.rays
        )
        self.hierarchy = Hierarchy(hits, source, device, refinement, seed)

    def gather(self, first: int, count: int, total: int) -> None:
        """Adds `count` levels."""
        for _ in range(count):
            self.hierarchy.refine()

    def picture(self) -> np.ndarray:
        """Light that primary hits reflect, as far as levels go, shape (H, W, 3)."""
        reflected = self.hierarchy.reflected().numpy()
        if self.samples is not None and self.per_pixel == self.samples.spp:
            return pixel_means(self.samples, reflected)
        mean = reflected.reshape(-1, self.per_pixel, 3).mean(axis=1, dtype=np.float64)
        return mean.astype(np.float32).reshape(self.size[1], self.size[0], 3)

    def all_counts(self) -> dict[str, int]:
        """Points and rays so far, and what was dropped or without support."""
        light = self.source.reconstruction.all_counts() if isinstance(self.source, SplatSource) else {}
        return light | self.hierarchy.counts
