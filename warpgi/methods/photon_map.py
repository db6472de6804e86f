"""Photon mapping (Jensen 1996), progressive on request (Knaus, Zwicker 2011)."""

from __future__ import annotations

import math
from dataclasses import dataclass
from enum import Enum
from typing import Any

import numpy as np
import warp as wp

from warpgi import checks
from warpgi.film import Film
from warpgi.job import Job
from warpgi.kernels import density, rng
from warpgi.kernels import photon_map as kernels
from warpgi.kernels import photons as photon_kernels
from warpgi.kernels.scene import OFFSET_ULPS
from warpgi.methods.path import Sampler
from warpgi.photons import BATCH_BYTES, PHOTON_BYTES, TREE_BYTES, PhotonSource
from warpgi.reconstruction import PrimaryHits
from warpgi.samples import SampleBuffer
from warpgi.splat_tree import TREE_KERNELS, SplatTree

# Photons that a path leaves behind, for a guess at memory before any is traced.
PHOTONS_PER_PATH = 4
# Probes of the surface start so many radii above it, or less.
PROBE_LIFT = 0.5
# Added to a map's number: paths that only say where irradiance is to be known.
OTHER_PATHS = 1 << 30
COVER = 12.0
# Beyond any scene.
UNLIMITED = 1e30


class Kernel(Enum):
    """How a photon's weight falls with its distance d, out to the radius h; each has integral 1 over the disc."""

    CONSTANT = "constant"
    """1 / (pi h^2)."""
    EPANECHNIKOV = "epanechnikov"
    """2 (1 - d^2/h^2) / (pi h^2)."""
    CONE = "cone"
    """Jensen's cone filter, proportional to 1 - d / (1.1 h)."""
    GAUSSIAN = "gaussian"
    """A Gaussian of standard deviation h/2, cut off at h."""


SHAPES = {
    Kernel.CONSTANT: density.CONSTANT,
    Kernel.EPANECHNIKOV: density.EPANECHNIKOV,
    Kernel.CONE: density.CONE,
    Kernel.GAUSSIAN: density.GAUSSIAN,
}


@dataclass(frozen=True, kw_only=True)
class PhotonMap:
    """Photon mapping (Jensen 1996): caustics and indirect light from the density of light particles.

    Direct light is sampled as in every method, and light over mirrors, glass and metal is followed from the camera to
    the first diffuse surface; there caustics are read from a map of their own, and other indirect light from the map
    itself or, with `final_gather`, from where rays across the hemisphere meet surfaces, but for the light of caustics
    there, which few rays would find. With `map_spp` below `spp` it
    is progressive: one map after the other, each with a smaller radius than the last, so that both noise and bias
    vanish with time at constant memory (Knaus, Zwicker 2011).

    Raises:
        TypeError, ValueError: a setting is out of range.
    """

    photons: int = 200_000
    """Paths from the lights for a map; each leaves a photon wherever it meets a diffuse surface."""
    caustic_photons: int = 200_000
    """Further paths for a map of caustics, aimed at what made some before; scenes that are all diffuse need none."""
    spp: int = 16
    """Camera paths per pixel."""
    map_spp: int | None = None
    """Camera paths per pixel that share a map before a new one is made; None: all, which is photon mapping with one
    map."""
    shrink: float = 2.0 / 3.0
    """alpha of the radius reduction r^2 <- r^2 (i + alpha) / (i + 1) from map to map, in (0, 1]; 1 keeps the radius."""
    neighbours: int = 50
    """Photons of an estimate, of which the last sets the radius, in [2, 256]; 0: all within `radius`. More is smoother
    and blurs more."""
    radius: float | None = None
    """Radius [scene units] beyond which there are no photons in an estimate, above 0; None: none such."""
    caustic_neighbours: int = 20
    """`neighbours` for the map of caustics, whose edges are sharp."""
    caustic_radius: float | None = None
    """`radius` for the map of caustics; None: a twentieth of the radius of the scene."""
    kernel: Kernel = Kernel.EPANECHNIKOV
    """How photons are weighted by distance."""
    normal_angle: float = 60.0
    """Photons whose surface is turned further [degrees] are of another surface, in (0, 180]; 180 takes all."""
    flatten: float = 2.0
    """Factor by which distances along the normal count for more, 1 or above: photons off the surface's plane are left
    out."""
    edge_rays: int = 8
    """Short rays per estimate that find which part of its disc is on the surface, against dark edges; 0: none."""
    final_gather: int = 0
    """Rays per camera path that gather indirect light from the map at their hits; 0: the map is seen directly."""
    gather_stride: int = 4
    """With final gathering irradiance is computed at a point for every so many photons, and gather rays take the
    nearest."""
    near: float = 1.0
    """Gather hits nearer than so many radii of their estimate are traced on, 0 or above: the map is bad in corners."""
    light_samples: int = 2
    """Shadow rays to lights from each camera path's diffuse surface."""
    sampler: Sampler = Sampler.SOBOL
    """Where random numbers come from."""

    def __post_init__(self) -> None:
        checks.count("photons", self.photons)
        checks.count("caustic_photons", self.caustic_photons, 0)
        checks.count("spp", self.spp)
        if self.map_spp is not None:
            checks.count("map_spp", self.map_spp)
        checks.number("shrink", self.shrink, 0.0, 1.0, open_lower=True)
        for name in ("", "caustic_"):
            neighbours, radius = getattr(self, f"{name}neighbours"), getattr(self, f"{name}radius")
            checks.count(f"{name}neighbours", neighbours, 0, density.MAX_PHOTONS)
            if neighbours == 1:
                raise ValueError(f"{name}neighbours is 1, expected 0, or 2 or more")
            if radius is not None:
                checks.number(f"{name}radius", radius, 0.0, open_lower=True)
        if self.neighbours == 0 and self.radius is None:
            raise ValueError("neighbours is 0 and radius is None, expected one of them")
        if not isinstance(self.kernel, Kernel):
            raise TypeError(f"kernel is {self.kernel!r}, expected a Kernel")
        checks.number("normal_angle", self.normal_angle, 0.0, 180.0, open_lower=True)
        checks.number("flatten", self.flatten, 1.0)
        checks.count("edge_rays", self.edge_rays, 0, 256)
        checks.count("final_gather", self.final_gather, 0)
        checks.count("gather_stride", self.gather_stride)
        checks.number("near", self.near, 0.0)
        checks.count("light_samples", self.light_samples)
        if not isinstance(self.sampler, Sampler):
            raise TypeError(f"sampler is {self.sampler!r}, expected a Sampler")

    @property
    def keeps_all_in_film(self) -> bool:
        """Whether the film is all that a later pass needs of earlier ones; maps can be made again."""
        return True

    @property
    def needs_light(self) -> bool:
        """Whether the picture of a scene without light is black."""
        return True

    @property
    def kernels(self) -> tuple[wp.Kernel, ...]:
        """What it launches: a kernel of each module."""
        return (kernels.see, photon_kernels.shoot, *TREE_KERNELS)

    def passes(self) -> tuple[int, str]:
        """Samples per pixel, the unit of its passes."""
        return self.spp, "spp"

    def device_bytes(self, size: tuple[int, int]) -> int:
        """Device memory it takes beside scene and film, as far as it can be known."""
        photons = PHOTONS_PER_PATH * self.photons + self.caustic_photons
        return BATCH_BYTES + photons * (PHOTON_BYTES + TREE_BYTES)

    def prepare(self, job: Job, film: Film) -> Mapping:
        """The first map, but where a picture goes on that is past it."""
        mapping = Mapping(self, job)
        if film.spp() < (self.map_spp or self.spp):
            mapping.use(0)
        return mapping

    def estimate(self, job: Job, state: Mapping, film: Film, first: int, count: int) -> None:
        """Adds samples `first` to `first + count - 1` of every pixel, each by its map."""
        each = self.map_spp or self.spp
        while count > 0:
            state.use(first // each)
            some = min(count, each - first % each)
            for band in film.bands:
                inputs = [job.scene.struct, job.camera, state.maps, state.view, first, some]
                job.device.launch(kernels.see, len(band), inputs, [film.load(band)])
            first, count = first + some, count - some

    def finish(self, job: Job, state: Mapping, film: Film) -> dict[str, np.ndarray]:
        """Nothing: every pass left a finished picture in the film."""
        return {}

    def counts(self, state: Mapping) -> dict[str, int]:
        """Paths from lights, photons in maps and rays that made them, over all maps."""
        return dict(state.counts)


class Mapping:
    """The present map of a scene.

    Attributes:
        maps, view: what kernels see.
        counts: of all maps so far.
    """

    def __init__(self, settings: PhotonMap, job: Job) -> None:
        self.settings, self.job = settings, job
        self.sampler = int(rng.SOBOL if settings.sampler is Sampler.SOBOL else rng.INDEPENDENT)
        self.source = PhotonSource(job.scene, job.seed, self.sampler)
        view = kernels.View()
        view.seed, view.sampler, view.gather = job.seed, self.sampler, settings.final_gather
        view.light_samples = settings.light_samples
        self.view = view
        self.maps = kernels.Maps()
        self.number = -1
        self.counts = dict.fromkeys(("maps", "photon_paths", "photons", "caustic_photons", "photon_rays"), 0)
        self.counts["nonfinite_photons"] = 0
        self._trees: list[SplatTree] = []

    def use(self, number: int) -> None:
        """Makes map `number` unless it is the present one."""
        if number == self.number:
            return
        self.number = number
        s, source = self.settings, self.source
        self._trees = []  # before new ones are made
        scale2 = self.radius_scale2(number)
        maps = kernels.Maps()
        maps.near = s.near**2
        # a place without a point near enough is as rare as exp(-COVER) where light is even
        maps.reach2 = max(1.0, COVER * s.gather_stride / (s.neighbours or math.inf))
        maps.diffuse_look = self.lookup(s.neighbours, s.radius, scale2)
        maps.caustic_look = self.lookup(
            s.caustic_neighbours, s.caustic_radius or 0.05 * max(self.job.scene.radius, 1e-30), scale2
        )
        shot = source.shoot(s.photons, number)
        self._count(shot, "photons")
        empty = np.zeros(0, np.int32)
        direct, indirect, echo = (int(getattr(photon_kernels, name)) for name in ("DIRECT", "INDIRECT", "ECHO"))
        if s.final_gather:
            # caustics are too small for gather rays: what they light is read as it is seen
            every = self._tree(shot, shot.of_kind(direct, indirect, echo))
            # points of other paths: photons far from others stand for more of the surface, and are where light is
            # underestimated, so that the map's own would darken it
            points = source.shoot(-(-s.photons // s.gather_stride), number + OTHER_PATHS)
            maps.irradiance = self._tree(points, np.arange(points.count, dtype=np.int32))
            inputs = [self.job.scene.struct, every, maps.diffuse_look, maps.reach2, number]
            self.job.device.launch(kernels.estimate_at, maps.irradiance.block_count, inputs, [maps.irradiance])
            tree = self._trees[-1]
            maps.places, maps.usual2 = tree.with_present_boxes(), float(np.median(tree.radii() ** 2))
            tree.refit_as_balls()
            maps.diffuse = self._tree(shot, shot.of_kind(echo))
        else:
            maps.diffuse = self._tree(shot, shot.of_kind(indirect, echo))
            maps.irradiance = maps.places = self._tree(shot, empty)
        if source.has_caustics and s.caustic_photons:
            shot = source.shoot_caustics(s.caustic_photons, number)
            self._count(shot, "caustic_photons")
            maps.caustic = self._tree(shot, np.arange(shot.count, dtype=np.int32))
        else:
            maps.caustic = self._tree(shot, empty)
        self.maps = maps
        self.counts["maps"] += 1

    def radius_scale2(self, number: int) -> float:
        """What is left of the first map's squared radii (Knaus, Zwicker 2011, eq. 21)."""
        alpha = self.settings.shrink
        return math.prod((i + alpha) / (i + 1.0) for i in range(1, number + 1))

    def lookup(self, neighbours: int, radius: float | None, scale2: float) -> kernels.Lookup:
        """How estimates are made."""
        s = self.settings
        look = kernels.Lookup()
        look.neighbours, look.scale2 = neighbours, scale2
        look.limit2 = UNLIMITED if radius is None else min(radius**2, UNLIMITED)
        look.stretch = s.flatten**2 - 1.0
        look.facing = -2.0 if s.normal_angle >= 180.0 else math.cos(math.radians(s.normal_angle))
        look.shape = int(SHAPES[s.kernel])
        look.probes, look.lift = s.edge_rays, PROBE_LIFT
        return look

    def _tree(self, shot: Any, indices: np.ndarray) -> Any:
        tree = self.source.tree(shot, indices)
        self._trees.append(tree)  # structs do not keep their arrays alive
        return tree.struct

    def _count(self, shot: Any, what: str) -> None:
        self.counts["photon_paths"] += shot.paths
        self.counts["photon_rays"] += shot.rays
        self.counts["nonfinite_photons"] += shot.dropped
        self.counts[what] += shot.count


def gathering_map(job: Job, photons: int) -> Mapping:
    """Maps made for rays that gather, from `photons` paths each."""
    mapping = Mapping(PhotonMap(photons=photons, caustic_photons=photons, final_gather=1), job)
    mapping.use(0)
    return mapping


def caustics_at_hits(mapping: Mapping, hits: PrimaryHits) -> wp.array:
    """The light of caustics, there and elsewhere, that each primary hit reflects, vec3 on the device."""
    device = mapping.job.device
    origins, normals, albedo = (device.array(a, wp.vec3) for a in (hits.origin, hits.normal, hits.albedo))
    caustics = device.zeros(len(hits.origin), wp.vec3)
    inputs = [mapping.job.scene.struct, mapping.maps, origins, normals, albedo]
    device.launch(kernels.caustics_at, len(hits.origin), inputs, [caustics])
    return caustics


def light_by_photons(job: Job, photons: int, samples: SampleBuffer, hits: PrimaryHits) -> wp.array:
    """Gives the samples' secondary rays the radiance that a photon map knows at their ends.

    Returns:
        The light of caustics, there and elsewhere, that each primary hit reflects, vec3 on the device: the maps'
        samples hold none.
    """
    device = job.device
    mapping = gathering_map(job, photons)
    origins, normals = (device.array(a, wp.vec3) for a in (hits.origin, hits.normal))
    radiance = device.array(samples.radiance, wp.vec3)
    step = float(OFFSET_ULPS) * job.scene.radius
    inputs = [job.scene.struct, mapping.maps, mapping.view, step, samples.spp, hits.per_pixel, origins, normals]
    device.launch(kernels.light_samples, len(samples), [*inputs, device.array(samples.hit, wp.vec3)], [radiance])
    samples.radiance[:] = radiance.numpy()
    return caustics_at_hits(mapping, hits)
