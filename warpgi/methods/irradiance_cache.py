"""Irradiance caching (Ward, Rubinstein, Clear 1988): indirect light where it is needed, interpolated elsewhere."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import warp as wp

from warpgi import checks
from warpgi.film import Film
from warpgi.gathering import GatheringSource
from warpgi.irradiance import STRATA_BYTES, PathSource
from warpgi.job import Job
from warpgi.kernels.light_field import add_reflected
from warpgi.kernels.path_strata import trace_strata
from warpgi.kernels.photon_strata import gather_strata
from warpgi.kernels.samples import trace_samples
from warpgi.methods.path import NEVER, Sampler, check_paths
from warpgi.methods.photon_map import PhotonMap
from warpgi.record_cache import BYTES_PER_HIT, COARSEST, KERNELS, Caching, RecordCache
from warpgi.records import Records
from warpgi.sampling import PRIMARY_BYTES, path_settings, trace_primary_hits


@dataclass(frozen=True, kw_only=True)
class IrradianceCache:
    """Irradiance caching (Ward, Rubinstein, Clear 1988): indirect light at a few points, interpolated between them.

    Records lie where surfaces are seen and none is near enough, found on grids of pixels from coarse to fine; each is
    traced with many paths, which also tell how far it can be trusted and how its light changes (Ward, Heckbert 1992).
    Diffuse surfaces are cached, also behind mirrors and glass; others keep light that is path-traced from each pixel.

    Raises:
        TypeError, ValueError: a setting is out of range.
    """

    spp: int = 8
    """Primary hits per pixel, a camera ray each, which make edges and textures."""
    tolerance: float = 0.3
    """Error up to which a record serves, a of Ward et al.: distance over its radius, plus turn of the normal; above 0,
    and below 1 in earnest. Records, and time, grow about with its inverse square."""
    rays: int = 1024
    """Paths of a record, one to a stratum of its hemisphere; with fewer, noise becomes splotches."""
    overlap: float = 1.5
    """Interpolation takes records of up to so many times the tolerance, 1 or above; more is smoother and blurs more."""
    spread: float = 0.25
    """One more record is made where those at hand disagree by this relative standard deviation, above 0."""
    min_radius: float = 4.0
    """Least radius of a record [pixels], 0 or above."""
    max_radius: float = 100.0
    """Largest radius of a record [pixels], `min_radius` or above."""
    finest: int = 4
    """Pixels from one place for a record to the next on the finest grid: a power of 2 up to 32."""
    gradients: bool = True
    """Extrapolate records by their gradients."""
    fallback_rays: int = 64
    """Paths per pixel where no record serves, such as in foliage."""
    smoothing: float = 0.0
    """Radius [pixels] of the filter over what is gathered hit by hit, at 16 rays a pixel; it falls with the square root
    of `fallback_rays`, as their noise does. It cleans foliage, but a thin wall does not stop it. 0: none."""
    photons: int = 0
    """Paths from the lights for photon maps, in which a record's rays end at their first hit: final gathering, with
    caustics read at the primary hits (Jensen 1996); `max_depth` is then not heeded; 0: none, paths go on."""
    light_samples: int = 32
    """Shadow rays to lights per pixel, shared out over its primary hits, which make the direct light."""
    max_depth: int | None = None
    """Longest path in segments, mirrors before a cached surface not counted; None is unlimited."""
    roulette_depth: int | None = 5
    """Segments after which Russian roulette may end a path; None switches it off and needs a `max_depth`."""
    sampler: Sampler = Sampler.SOBOL
    """Where the paths' random numbers come from."""
    records: str | None = None
    """File of records (.npz) to begin with where it is there, and in which all are kept in the end: for another view
    of the same scene, or more pixels."""

    def __post_init__(self) -> None:
        for name in ("spp", "rays", "fallback_rays", "light_samples"):
            checks.count(name, getattr(self, name))
        for name in ("tolerance", "spread"):
            checks.number(name, getattr(self, name), 0.0, open_lower=True)
        checks.number("overlap", self.overlap, 1.0)
        checks.number("min_radius", self.min_radius, 0.0)
        checks.number("max_radius", self.max_radius, self.min_radius)
        checks.number("smoothing", self.smoothing, 0.0, 100.0)
        checks.count("finest", self.finest, 1, COARSEST)
        if self.finest & (self.finest - 1):
            raise ValueError(f"finest is {self.finest}, expected a power of 2")
        if self.records is not None and not isinstance(self.records, str):
            raise TypeError(f"records is {type(self.records).__name__}, expected the name of a file")
        checks.count("photons", self.photons, 0)
        if self.photons and self.records is not None:
            raise ValueError("photons and records are both given, expected one: records by photons hold no caustics")
        check_paths(self.max_depth, self.roulette_depth, self.sampler)

    @property
    def needs_light(self) -> bool:
        """Whether the picture of a scene without light is black."""
        return True

    @property
    def kernels(self) -> tuple[wp.Kernel, ...]:
        """What it launches: a kernel of each module."""
        rays = (gather_strata, *PhotonMap().kernels) if self.photons else (trace_strata,)
        return (trace_samples, add_reflected, *rays, *KERNELS)

    @property
    def caching(self) -> Caching:
        """How records are placed and used."""
        return Caching(
            tolerance=self.tolerance,
            rays=self.rays,
            overlap=self.overlap,
            spread=self.spread,
            smallest=self.min_radius,
            largest=self.max_radius,
            finest=self.finest,
            gradients=self.gradients,
            smoothing=self.smoothing,
        )

    def passes(self) -> tuple[int, str]:
        """Grids of pixels that are looked at."""
        return len(self.caching.rounds), "grids"

    def device_bytes(self, size: tuple[int, int]) -> int:
        """Device memory it takes beside scene and film."""
        photons = PhotonMap(photons=self.photons).device_bytes(size) if self.photons else 0
        return size[0] * size[1] * self.spp * (2 * PRIMARY_BYTES + BYTES_PER_HIT) + STRATA_BYTES + photons

    def prepare(self, job: Job, film: Film) -> RecordCache:
        """Traces the primary hits, with all light that is not cached going to the film."""
        known = None
        if self.records is not None and Path(self.records).exists():
            known = Records.load(self.records).moved(-job.scene.centre)
        paths = path_settings(job, self.max_depth or NEVER, self.roulette_depth or NEVER, self.sampler)
        hits = trace_primary_hits(job, film, self.spp, max(1, self.light_samples // self.spp), paths)
        if self.photons:
            return RecordCache(job.device, hits, job.size, GatheringSource(job, hits, self.photons), self.caching)
        rest = path_settings(job, (self.max_depth or NEVER) - 1, self.roulette_depth or NEVER, self.sampler)
        return RecordCache(job.device, hits, job.size, PathSource(job, hits, rest), self.caching, known)

    def estimate(self, job: Job, state: RecordCache, film: Film, first: int, count: int) -> None:
        """Makes the records of `count` grids."""
        state.fill(first, count)

    def finish(self, job: Job, state: RecordCache, film: Film) -> dict[str, np.ndarray]:
        """Adds interpolated light to the film's indirect layer; returns where records are."""
        lights = [state.reflected(self.fallback_rays)]
        if isinstance(state.source, GatheringSource):
            lights.append(state.source.caustics())
        for band in film.bands:
            for light in lights:
                job.device.launch(add_reflected, len(band), [film.load(band), light, self.spp])
        if self.records is not None:
            state.records.moved(job.scene.centre).save(self.records)
        return {"records": state.picture()}

    def counts(self, state: RecordCache) -> dict[str, int]:
        """Records, primary hits and those without a record, and rays."""
        return state.all_counts()
