"""Light-field reconstruction (Lehtinen et al. 2012): hundreds of samples' worth of indirect light from a few."""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np
import warp as wp

from warpgi import checks
from warpgi.cached_reconstruction import CachedReconstruction
from warpgi.device import Device
from warpgi.film import Film
from warpgi.glossy_reconstruction import GlossyReconstruction
from warpgi.irradiance import STRATA_BYTES
from warpgi.job import Job
from warpgi.kernels.light_field import add_reflected
from warpgi.kernels.neighbours import MAX_NEIGHBOURS
from warpgi.kernels.primary_samples import trace_primary_samples
from warpgi.kernels.samples import trace_samples
from warpgi.lens_reconstruction import PRIMARY_SAMPLE_BYTES, LensReconstruction
from warpgi.methods.irradiance_cache import IrradianceCache
from warpgi.methods.path import NEVER, Sampler, check_paths
from warpgi.methods.photon_map import PhotonMap, light_by_photons
from warpgi.reconstruction import (
    BYTES_PER_HIT,
    BYTES_PER_SAMPLE,
    KERNELS,
    Preprocessing,
    PrimaryHits,
    Reconstruction,
    pixel_means,
)
from warpgi.record_cache import BYTES_PER_HIT as CACHE_BYTES_PER_HIT
from warpgi.record_cache import KERNELS as CACHE_KERNELS
from warpgi.record_cache import Caching
from warpgi.samples import SampleBuffer
from warpgi.sampling import PRIMARY_BYTES, SECONDARY_BYTES, path_settings, trace_primary_buffer, trace_sample_buffer
from warpgi.traced_reconstruction import KERNELS as TRACED_KERNELS
from warpgi.traced_reconstruction import TracedReconstruction

# Points of a pixel that make its edges, textures and foliage smooth, while this many rays are left to each.
SMOOTH_HITS = 16
FEWEST_RAYS = 8

AnyReconstruction = Reconstruction | CachedReconstruction | LensReconstruction


@dataclass(frozen=True, kw_only=True)
class LightField:
    """Indirect light reconstructed from a few path-traced samples per pixel (Lehtinen et al. 2012).

    Reconstructs what diffuse and glossy surfaces reflect; mirrors and glass keep their path-traced light. Where
    secondary rays meet mirrors, light is reconstructed at the next segment of the path.
    `gi.reconstruct` uses it on a sample buffer alone, where the fields that say how samples are traced mean nothing.

    Raises:
        TypeError, ValueError: a setting is out of range.
    """

    spp: int = 8
    """Input paths per pixel; more of them resolve finer detail of geometry and light."""
    rays: int = 256
    """Reconstruction rays per pixel, shared out over its samples; noise falls and time grows with it."""
    neighbours: int = 12
    """Samples that lie within a splat's radius at first, itself counted, in [2, 32]; more is smoother."""
    alpha: float = 3.0
    """Factor by which distances along a splat's normal count for more, 1 or above."""
    margin: float = 1e-3
    """Part of an input ray at either end in which the splats that it crosses do not shrink, in [0, 0.5)."""
    lone_radius: float = 1.0
    """Part of its radius that a splat keeps where it alone is the first surface on a ray and others lie behind, in
    (0, 1]; two keep a third less of the difference to 1. The paper takes 0.5 against too much occlusion; measured
    in foliage it lets too much light through, and 1 is nearer to the truth and faster."""
    bandwidth: bool = True
    """Read the light of glossy surfaces that secondary rays met from samples of like direction; False takes it for the
    same in all directions, as diffuse surfaces send it."""
    recursive: int = 0
    """Times that the samples' own light is reconstructed first; cures artefacts of noisy samples in corners."""
    recursive_rays: int = 16
    """Reconstruction rays for each sample in that step."""
    primary_hits: int | None = None
    """Primary hits per pixel at which light is gathered, `spp` or more. More of them make smooth edges, textures and
    foliage, for the cost of a camera ray each; None is up to 16, of at least 8 rays each."""
    photons: int = 0
    """Paths from the lights for a photon map that gives the radiance at secondary hits in place of traced paths: free
    of noise but blurred, with caustics read at the primary hits; 0: none."""
    cache: bool = False
    """Gather at the records of an irradiance cache instead of every primary hit, and interpolate between them; `rays`
    are then those of pixels where the cache would interpolate across too much, such as foliage."""
    tolerance: float = 0.3
    """With `cache`: error up to which a record serves, see `IrradianceCache`."""
    scene_rays: bool = True
    """With `cache`, and where a scene is at hand: let it stop the rays of records, and splats only light them."""
    smoothing: float = 3.5
    """With `cache`: radius [pixels] of the filter over what is gathered hit by hit, at 16 rays a pixel; it falls with
    the square root of `rays`, as their noise does. A thin wall does not stop it. 0: none."""
    record_rays: int = 256
    """With `cache`: rays of a record."""
    light_samples: int = 32
    """Shadow rays to lights per pixel, shared out over its primary hits, which make the direct light."""
    max_depth: int | None = None
    """Longest path in segments; None is unlimited."""
    roulette_depth: int | None = 5
    """Segments after which Russian roulette may end an input path; None switches it off and needs a `max_depth`."""
    sampler: Sampler = Sampler.SOBOL
    """Where the input paths' random numbers come from."""
    primary_rays: bool = False
    """Reconstruct what the lens sees while the shutter is open from camera rays, not what surfaces reflect from
    secondary rays (section 3.4); the whole picture, in the layer "image", and the way to render what moves. `rays` are
    then those of a pixel; settings that say how indirect light is gathered mean nothing."""

    def __post_init__(self) -> None:
        checks.count("spp", self.spp)
        checks.count("rays", self.rays)
        checks.count("neighbours", self.neighbours, 2, MAX_NEIGHBOURS)
        checks.number("alpha", self.alpha, 1.0)
        checks.number("margin", self.margin, 0.0, 0.499)
        checks.number("lone_radius", self.lone_radius, 0.0, 1.0, open_lower=True)
        checks.count("recursive", self.recursive, 0)
        checks.count("recursive_rays", self.recursive_rays)
        checks.count("photons", self.photons, 0)
        checks.count("light_samples", self.light_samples)
        checks.number("tolerance", self.tolerance, 0.0, open_lower=True)
        checks.count("record_rays", self.record_rays)
        checks.number("smoothing", self.smoothing, 0.0, 100.0)
        if self.cache and self.primary_rays:
            raise ValueError("cache and primary_rays are both set, expected one: a cache is for light on surfaces")
        if self.primary_hits is not None:
            checks.count("primary_hits", self.primary_hits, self.spp)
        check_paths(self.max_depth, self.roulette_depth, self.sampler)

    @property
    def takes_motion(self) -> bool:
        """Whether it renders scenes that move."""
        return self.primary_rays

    @property
    def needs_light(self) -> bool:
        """Whether the picture of a scene without light is black."""
        return True

    @property
    def kernels(self) -> tuple[wp.Kernel, ...]:
        """What it launches."""
        if self.primary_rays:
            return (trace_primary_samples,)  # lens reconstruction loads its own, those for motion where it needs them
        photons = PhotonMap().kernels if self.photons else ()
        cache = (*CACHE_KERNELS, *TRACED_KERNELS) if self.cache else ()
        return (trace_samples, *KERNELS, *photons, *cache)

    @property
    def preprocessing(self) -> Preprocessing:
        """How splats are sized."""
        return Preprocessing(self.neighbours, self.alpha, self.margin, self.lone_radius)

    @property
    def caching(self) -> Caching:
        """How records are placed."""
        cache = IrradianceCache(rays=self.record_rays, tolerance=self.tolerance, smoothing=self.smoothing)
        return cache.caching

    @property
    def hits(self) -> int:
        """Primary hits per pixel."""
        return self.primary_hits or max(self.spp, min(SMOOTH_HITS, self.rays // FEWEST_RAYS))

    def passes(self, hits: int | None = None) -> tuple[int, str]:
        """Reconstruction rays for each primary hit, at `hits` of them in a pixel, and what to call them."""
        if self.primary_rays:
            return self.rays, "rays"
        if self.cache:
            return len(self.caching.rounds), "levels"
        return max(1, round(self.rays / (hits or self.hits))), "rays per hit"

    def device_bytes(self, size: tuple[int, int]) -> int:
        """Device memory it takes beside scene and film."""
        if self.primary_rays:
            return size[0] * size[1] * self.spp * PRIMARY_SAMPLE_BYTES
        hit, ray = PRIMARY_BYTES + BYTES_PER_HIT, SECONDARY_BYTES + BYTES_PER_SAMPLE
        photons = PhotonMap(photons=self.photons).device_bytes(size) if self.photons else 0
        if self.cache:
            hit, photons = hit + CACHE_BYTES_PER_HIT + PRIMARY_BYTES, photons + STRATA_BYTES
        return size[0] * size[1] * (self.hits * hit + self.spp * ray) + photons

    def prepare(self, job: Job, film: Film) -> AnyReconstruction:
        """Traces the input, with what is not reconstructed going to the film, and makes splats of it."""
        if self.primary_rays:
            depths = self.max_depth or NEVER, self.roulette_depth or NEVER
            rays = trace_primary_buffer(job, film, self.spp, *depths, self.sampler)
            return self.reconstruction(rays, job.device, job.seed)
        samples, hits = trace_sample_buffer(
            job,
            film,
            self.spp,
            self.hits,
            max(1, self.light_samples // self.hits),
            self.max_depth or NEVER,
            self.roulette_depth or NEVER,
            self.sampler,
            with_hit_light=self.recursive > 0,
            with_gloss=job.scene.scene.is_glossy and not self.photons,
        )
        caustics = light_by_photons(job, self.photons, samples, hits) if self.photons else None
        state = self.reconstruction(samples, job.device, job.seed, hits, job)
        if not isinstance(state, LensReconstruction):
            state.caustics = caustics
        return state

    def reconstruction(
        self,
        samples: SampleBuffer,
        device: Device,
        seed: int,
        hits: PrimaryHits | None = None,
        job: Job | None = None,
    ) -> AnyReconstruction:
        """Splats made of a sample buffer, ready for `gather`."""
        if self.primary_rays:
            return LensReconstruction(samples, device, self.preprocessing, seed)
        bandwidth = self.bandwidth and samples.bandwidth is not None and not self.cache
        make: Any = Reconstruction
        if self.cache and self.scene_rays and job is not None:
            depths = (self.max_depth or NEVER) - 1, self.roulette_depth or NEVER
            make = partial(TracedReconstruction, job, path_settings(job, *depths, self.sampler))
        elif samples.material is not None or bandwidth:
            make = partial(GlossyReconstruction, bandwidth=bandwidth)
        how = {"recursions": self.recursive, "recursive_rays": self.recursive_rays}
        state: Reconstruction = make(samples, device, self.preprocessing, seed, hits, **how)
        return CachedReconstruction(state, hits, self.caching, self.rays) if self.cache else state

    def estimate(self, job: Job, state: AnyReconstruction, film: Film, first: int, count: int) -> None:
        """Sends `count` reconstruction rays from every primary hit."""
        state.gather(first, count, self.passes()[0])

    def finish(self, job: Job, state: AnyReconstruction, film: Film) -> dict[str, np.ndarray]:
        """Adds the reconstructed light to the film's indirect layer."""
        if isinstance(state, LensReconstruction):
            return self.layers(state)
        reflected = state.reflected()
        for band in film.bands:
            job.device.launch(add_reflected, len(band), [film.load(band), reflected, self.hits])
            if state.caustics is not None:
                job.device.launch(add_reflected, len(band), [film.load(band), state.caustics, self.hits])
        return {"records": state.records()} if isinstance(state, CachedReconstruction) else {}

    def layers(self, state: AnyReconstruction) -> dict[str, np.ndarray]:
        """The indirect layer of a reconstruction without a scene, or the picture seen through the lens."""
        if isinstance(state, LensReconstruction):
            return {"image": state.image()}
        layers = {"indirect": pixel_means(state.samples, state.reflected().numpy())}
        return layers | ({"records": state.records()} if isinstance(state, CachedReconstruction) else {})

    def counts(self, state: AnyReconstruction) -> dict[str, int]:
        """Reconstruction rays, and what was dropped, cut short or without support."""
        return state.all_counts()
