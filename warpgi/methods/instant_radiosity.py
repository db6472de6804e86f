"""Instant radiosity (Keller 1997): indirect light from virtual point lights, progressive on request."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from enum import Enum

import numpy as np
import warp as wp

from warpgi import checks
from warpgi.film import Film
from warpgi.interleaving import PIXEL_BYTES, join, make_interleaving, mean_rows
from warpgi.job import Job
from warpgi.kept_paths import KeptPaths
from warpgi.kernels import instant_radiosity as kernels
from warpgi.kernels import photons as photon_kernels
from warpgi.kernels import rng
from warpgi.kernels import vpls as vpl_kernels
from warpgi.kernels.interleaving import join_subsets
from warpgi.materials import Coated, Conductor, Dielectric, Mirror
from warpgi.methods.path import Sampler
from warpgi.photons import BATCH_BYTES, PHOTON_BYTES, PhotonSource, Shot
from warpgi.vpls import VPL_BYTES, make_vpls

# Lights that a path leaves behind, for a guess at memory before any is traced.
LIGHTS_PER_PATH = 4


class NearLight(Enum):
    """What becomes of light from virtual lights that are near, where 1 / distance^2 has no bound."""

    UNBOUNDED = "unbounded"
    """Nothing: right in the mean over many sets of lights, with spikes in each."""
    CLAMPED = "clamped"
    """The geometry term is cut off at 1 / near_distance^2: no spikes, dark corners."""
    COMPENSATED = "compensated"
    """The same, and a ray from each camera hit brings back what is cut off (Kollig, Keller 2004)."""
    SPHERICAL = "spherical"
    """Lights are spheres of radius near_distance (Hasan et al. 2009): no spikes, light near corners is blurred."""


NEAR = {
    NearLight.UNBOUNDED: vpl_kernels.UNBOUNDED,
    NearLight.CLAMPED: vpl_kernels.CLAMPED,
    NearLight.COMPENSATED: vpl_kernels.COMPENSATED,
    NearLight.SPHERICAL: vpl_kernels.SPHERICAL,
}


# `near_distance` over the radius of a path's share of the surface. Clamped lights and spheres lose light as it grows,
# three times as much from 0.5 to 1; compensation pays with some rays more, for half the error from 1 to 2.
NEAR_SHARE = {NearLight.UNBOUNDED: 1.0, NearLight.CLAMPED: 1.0, NearLight.COMPENSATED: 2.0, NearLight.SPHERICAL: 0.5}


@dataclass(frozen=True, kw_only=True)
class InstantRadiosity:
    """Instant radiosity (Keller 1997): photons of a few light paths light the picture as virtual point lights.

    Direct light is sampled as in every method, mirrors and glass are followed from the camera, and all other indirect
    light comes from virtual lights on diffuse surfaces and rough gloss, joined by shadow rays with all that they light,
    BSDFs at both ends. Caustics, and what smooth gloss reflects, come from rays. All pixels share the lights: errors
    are no noise, but shadows and spots. With `set_spp` below `spp` it is progressive: one set of lights after the
    other, and the picture converges to the path tracer's.

    Raises:
        TypeError, ValueError: a setting is out of range.
    """

    paths: int = 64
    """Paths from the lights for a set of virtual lights; each leaves one at every surface that it meets."""
    spp: int = 4
    """Camera paths per pixel."""
    set_spp: int | None = None
    """Camera paths per pixel that share a set of lights before a new one is made; None: all."""
    near_light: NearLight = NearLight.COMPENSATED
    """How spikes near virtual lights are kept away."""
    near_distance: float | None = None
    """Distance [scene units] at which two surfaces that face each other reach the bound of the geometry term, or the
    radius of spherical lights, above 0; None: in proportion to the disc that is one path's share of the scene's
    surface. More takes more light away from the virtual lights."""
    shadow_map: int = 0
    """Texels along a side of a shadow map over each light's hemisphere, 4 bytes each, up to 4096: shadows are off by
    about a texel, and pictures of many pixels in large scenes faster. 0: a shadow ray from each hit to each light."""
    interleave: int = 1
    """Side of a square of pixels that share out the lights, 1 to 8: at 4 each camera path takes every 16th, for a
    sixteenth of the shadow rays, and a filter (Keller, Heidrich 2001) joins the indirect light of diffuse surfaces that
    lie in a plane. Shadows and caustics blur by as many pixels."""
    min_roughness: float = 0.05
    """Rough metal and coats of this roughness or more are lit by virtual lights and become some; smoother ones are
    followed by rays, in (0, 1]."""
    renewed_paths: int | None = None
    """In a sequence: paths that are made anew from frame to frame at most. The others are kept, weighted by their
    Voronoi cells, as long as the moved light reaches what they met (Laine et al. 2007), so that nothing flickers;
    nor do the camera's random numbers change. None: each frame has a set of its own."""
    light_samples: int = 2
    """Shadow rays to lights from each camera path's first surface."""
    sampler: Sampler = Sampler.SOBOL
    """Where random numbers come from."""

    def __post_init__(self) -> None:
        for name in ("paths", "spp", "light_samples"):
            checks.count(name, getattr(self, name))
        if self.set_spp is not None:
            checks.count("set_spp", self.set_spp)
        if self.renewed_paths is not None:
            checks.count("renewed_paths", self.renewed_paths, 0)
            if self.set_spp is not None:
                raise ValueError(
                    f"renewed_paths is given, expected None where set_spp is {self.set_spp}: one set is kept"
                )
        if not isinstance(self.near_light, NearLight):
            raise TypeError(f"near_light is {self.near_light!r}, expected a NearLight")
        if self.near_distance is not None:
            checks.number("near_distance", self.near_distance, 0.0, open_lower=True)
        checks.count("shadow_map", self.shadow_map, 0, 4096)
        checks.count("interleave", self.interleave, 1, 8)
        checks.number("min_roughness", self.min_roughness, 0.0, 1.0, open_lower=True)
        if not isinstance(self.sampler, Sampler):
            raise TypeError(f"sampler is {self.sampler!r}, expected a Sampler")

    @property
    def keeps_all_in_film(self) -> bool:
        """Whether the film is all that a later pass needs of earlier ones; lights can be made again."""
        return self.interleave == 1

    @property
    def needs_light(self) -> bool:
        """Whether the picture of a scene without light is black."""
        return True

    @property
    def kernels(self) -> tuple[wp.Kernel, ...]:
        """What it launches: a kernel of each module."""
        return (kernels.light_pixels, photon_kernels.shoot, vpl_kernels.light_up, join_subsets)

    def passes(self) -> tuple[int, str]:
        """Samples per pixel, the unit of its passes."""
        return self.spp, "spp"

    def device_bytes(self, size: tuple[int, int]) -> int:
        """Device memory it takes beside scene and film, as far as it can be known."""
        light_bytes = PHOTON_BYTES + VPL_BYTES + 4 * self.shadow_map**2
        shared_bytes = size[0] * size[1] * PIXEL_BYTES if self.interleave > 1 else 0
        return BATCH_BYTES + LIGHTS_PER_PATH * self.paths * light_bytes + shared_bytes

    def prepare(self, job: Job, film: Film) -> Lighting:
        """The set of lights that comes next."""
        lighting = Lighting(self, job)
        if film.spp() < self.spp:
            lighting.use(film.spp() // (self.set_spp or self.spp))
        return lighting

    @property
    def prepare_next(self) -> Callable[..., Lighting]:
        """The lights of a frame out of those of the frame before; none where each frame has its own."""
        if self.renewed_paths is None:
            raise AttributeError("frames do not build on each other where renewed_paths is None")
        return self._prepare_next

    def _prepare_next(self, job: Job, film: Film, before: Lighting | None) -> Lighting:
        lighting = Lighting(self, job)
        lighting.keep(before)
        return lighting

    def estimate(self, job: Job, state: Lighting, film: Film, first: int, count: int) -> None:
        """Adds samples `first` to `first + count - 1` of every pixel, each by its set of lights."""
        each = self.set_spp or self.spp
        while count > 0:
            state.use(first // each)
            some = min(count, each - first % each)
            for band in film.bands:
                inputs = [job.scene.struct, job.camera, state.vpls, state.joining, state.view]
                inputs += [state.interleaving, first, some]
                job.device.launch(kernels.light_pixels, len(band), inputs, [film.load(band)])
            first, count = first + some, count - some

    def finish(self, job: Job, state: Lighting, film: Film) -> dict[str, np.ndarray]:
        """The indirect layer with the light that pixels shared out; else every pass left a finished picture."""
        if self.interleave == 1:
            return {}
        shared = join(mean_rows(state.interleaving, film), state.interleaving, job)
        return {"indirect": shared + film.field("indirect").reshape(shared.shape)}

    def counts(self, state: Lighting) -> dict[str, int]:
        """Sets of lights so far and what they were made of."""
        return state.counts


class Lighting:
    """The virtual lights of a picture, set by set.

    Attributes:
        vpls, joining, view, interleaving: what kernels see.
        counts: of all sets so far.
    """

    def __init__(self, settings: InstantRadiosity, job: Job) -> None:
        self.settings, self.job = settings, job
        sampler = int(rng.SOBOL if settings.sampler is Sampler.SOBOL else rng.INDEPENDENT)
        sharpest = 1.0 / settings.min_roughness
        self.source = PhotonSource(job.scene, job.seed, sampler, sharpest)
        joining = vpl_kernels.Joining()
        joining.near, joining.sharpest = int(NEAR[settings.near_light]), sharpest
        joining.radius = self.near_distance()
        if settings.near_light in (NearLight.CLAMPED, NearLight.COMPENSATED):
            joining.bound = min(joining.radius**-2, 1e30)
        self.joining = joining
        view = kernels.View()
        view.seed, view.sampler, view.light_samples = job.seed, sampler, settings.light_samples
        sharp = any(
            isinstance(m, (Mirror, Dielectric))
            or (isinstance(m, (Conductor, Coated)) and m.roughness < settings.min_roughness)
            for m in (shape.material for shape in job.scene.scene.shapes)
        )
        compensated = settings.near_light is NearLight.COMPENSATED
        view.goes_on = int(job.scene.struct.visible_light != 0 or sharp or compensated)
        self.view = view
        self.interleaving = make_interleaving(settings.interleave, job)
        self.vpls = vpl_kernels.Vpls()
        self.kept: KeptPaths | None = None
        self.number = -1
        self.counts = dict.fromkeys(("vpl_sets", "vpl_paths", "vpls", "photon_rays", "nonfinite_photons"), 0)

    def near_distance(self) -> float:
        """Where clamping begins, or the radius of spherical lights."""
        if self.settings.near_distance is not None:
            return self.settings.near_distance
        area = sum(float(shape.areas().sum()) for shape in self.job.scene.scene.shapes)
        return NEAR_SHARE[self.settings.near_light] * math.sqrt(area / (math.pi * self.settings.paths))

    def use(self, number: int) -> None:
        """Makes set `number` of the lights unless it is the present one."""
        if number == self.number:
            return
        self.number = number
        self._light(self.source.shoot(self.settings.paths, number), self.settings.paths)

    def keep(self, before: Lighting | None) -> None:
        """Makes the lights of a frame, of those before it what is still lit."""
        settings, self.number = self.settings, 0
        if before is None or before.kept is None:
            self.kept = KeptPaths(self.source, settings.paths, self.job.seed)
        else:
            # kept paths have kept random numbers, and noise of the camera's would flicker too
            self.source.emission.seed, self.view.seed = before.source.emission.seed, before.view.seed
            self.kept = before.kept.advance(self.source, settings.renewed_paths or 0)
        self._light(self.kept.shoot(self.source), self.kept.made)

    def _light(self, shot: Shot, made: int) -> None:
        self.vpls = make_vpls(self.job.scene, shot.photons, shot.count, self.settings.shadow_map)
        self._shot = shot  # structs do not keep their arrays alive
        self.counts["vpl_sets"] += 1
        self.counts["vpl_paths"] += made
        self.counts["vpls"] += shot.count
        self.counts["photon_rays"] += shot.rays
        self.counts["nonfinite_photons"] += shot.dropped
