"""Irradiance caching (Ward, Rubinstein, Clear 1988): indirect light where it is needed, interpolated elsewhere."""

from __future__ import annotations

import os
from dataclasses import dataclass

import numpy as np
import warp as wp

from warpgi import checks
from warpgi.film import Film
from warpgi.irradiance import PathSource
from warpgi.job import Job
from warpgi.kernels.light_field import add_reflected
from warpgi.kernels.path_strata import trace_strata
from warpgi.kernels.samples import trace_samples
from warpgi.methods.path import NEVER, Sampler, check_paths
from warpgi.record_cache import KERNELS, Caching, RecordCache
from warpgi.records import Records
from warpgi.sampling import PRIMARY_BYTES, path_settings, trace_primary_hits


@dataclass(frozen=True, kw_only=True)
class IrradianceCache:
    spp: int = 8
    """Primary hits per pixel, which make edges and textures; a camera ray each."""
    error: float = 0.3
    """Allowed error of a record (Ward et al.), above 0: time grows about with the inverse of its square."""
    rays: int = 1024
    overlap: float = 1.5
    spread: float = 1.0
    min_radius: float = 4.0
    max_radius: float = 100.0
    finest: int = 4
    support: int = 3
    gradients: bool = True
    fallback_rays: int = 64
    light_samples: int = 32
    max_depth: int | None = None
    roulette_depth: int | None = 5
    sampler: Sampler = Sampler.SOBOL
    records: str | None = None

    @property
    def needs_light(self) -> bool:
        return True

    @property
    def kernels(self) -> tuple[wp.Kernel, ...]:
        return (trace_samples, trace_strata, add_reflected, *KERNELS)

    @property
    def caching(self) -> Caching:
        return Caching(
            self.error, self.overlap, self.spread, self.rays, self.min_radius, self.max_radius,
            self.finest, self.support, self.gradients,
        )

    def passes(self) -> tuple[int, str]:
        return len(self.caching.rounds), "levels"

    def device_bytes(self, size: tuple[int, int]) -> int:
        return size[0] * size[1] * self.spp * (2 * PRIMARY_BYTES)

    def prepare(self, job: Job, film: Film) -> RecordCache:
        paths = path_settings(job, self.max_depth or NEVER, self.roulette_depth or NEVER, self.sampler)
        hits = trace_primary_hits(job, film, self.spp, max(1, self.light_samples // self.spp), paths)
        rest = path_settings(job, (self.max_depth or NEVER) - 1, self.roulette_depth or NEVER, self.sampler)
        known = None
        if self.records and os.path.exists(self.records):
            known = Records.load(self.records).moved(-job.scene.centre)
        return RecordCache(job.device, hits, job.size, PathSource(job, hits, rest), self.caching, known)

    def estimate(self, job: Job, state: RecordCache, film: Film, first: int, count: int) -> None:
        state.fill(first, count)

    def finish(self, job: Job, state: RecordCache, film: Film) -> dict[str, np.ndarray]:
        reflected = state.reflected(self.fallback_rays)
        for band in film.bands:
            job.device.launch(add_reflected, len(band), [film.load(band), reflected, self.spp])
        if self.records:
            state.records.moved(job.scene.centre).save(self.records)
        return {"records": state.picture()}

    def counts(self, state: RecordCache) -> dict[str, int]:
        return state.all_counts()
