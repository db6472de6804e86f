"""What points of surfaces know of the light: irradiance where they are diffuse, spherical harmonics where glossy."""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import Protocol

import numpy as np
import warp as wp

from warpgi.device_scene import DeviceScene
from warpgi.irradiance import STRATA_BYTES, PathSource
from warpgi.job import Job
from warpgi.kernels import irradiance_cache
from warpgi.kernels import spherical_harmonics as kernels
from warpgi.kernels.path import PathSettings
from warpgi.kernels.scene import OFFSET_ULPS
from warpgi.materials import Coated, Conductor
from warpgi.methods.path import NEVER
from warpgi.methods.point_filter import PointFilter
from warpgi.reconstruction import PrimaryHits
from warpgi.record_cache import strata
from warpgi.sampling import path_settings
from warpgi.scene import Scene
from warpgi.surface_points import PointLookup, SurfacePoints

# Part of a lobe that harmonics above the largest order may hold.
LOST = 0.05

# Values of hits, vec3, and hits themselves, with the points that each finds, that are on the device at a time.
HIT_VALUES = 1 << 22
HITS = 1 << 18


def order_for(roughness: float) -> int:
    """Largest order l of harmonics that a lobe of this roughness, 1 / exponent, lets through by more than LOST.

    A Blinn distribution of exponent e reflects light from straight above as a Phong lobe of exponent s = e / 4 would,
    whose harmonics fall as exp(-l^2 / (2 s)) (Ramamoorthi, Hanrahan 2001).
    """
    return max(2, math.ceil(math.sqrt(-0.5 * math.log(LOST) / roughness)))


class PointLight(Protocol):
    """One kind of knowledge, at the points that have it."""

    #: Its name, and the points.
    name: str
    points: SurfacePoints
    lookup: PointLookup
    #: RGB values at a point.
    width: int

    def trace(self, job: Job) -> tuple[np.ndarray, int]:
        """A frame's values at the points, shape (P, width, 3), float32, and how many rays they took."""

    def reflect(self, job: Job, hits: PrimaryHits, values: np.ndarray, reflected: wp.array) -> dict[str, int]:
        """Writes what primary hits on such surfaces reflect of the points' values; returns counts."""


def glossy_shapes(scene: Scene, method: PointFilter) -> np.ndarray:
    """Which shapes are glossy and take part, shape (S,), bool."""
    least = np.inf if method.roughness is None else method.roughness
    materials = [shape.material for shape in scene.shapes]
    return np.array([isinstance(each, (Conductor, Coated)) and each.roughness >= least for each in materials])


def lights_at(
    points: SurfacePoints, glossy: np.ndarray, rest: DeviceScene, method: PointFilter
) -> list[Irradiance | Harmonics]:
    """What is to be known at points, each at one kind of them: no more than the sequence needs.

    Args:
        points: where it is to be known.
        glossy: which shapes are glossy in any frame: irradiance does not serve them, harmonics serve them always.
        rest: the scene whose distances count.
        method: settings.
    """
    found: list[Irradiance | Harmonics] = []
    for kind, some in ((Irradiance, ~glossy[points.shape]), (Harmonics, glossy[points.shape])):
        if some.any():
            found.append(kind(points.some(some), glossy, rest, method))
    return found


class Irradiance:
    """Irradiance, all that a diffuse surface needs."""

    name, width = "irradiance", 1

    def __init__(self, points: SurfacePoints, glossy: np.ndarray, rest: DeviceScene, method: PointFilter) -> None:
        self.points, self.method, self._others = points, method, ~glossy
        self.lookup = PointLookup(points, rest)

    def trace(self, job: Job) -> tuple[np.ndarray, int]:
        """See `PointLight`."""
        position, normal = self.points.placed(job.scene)
        none = np.zeros((0, 3), np.float32)
        source = PathSource(job, PrimaryHits(none, none, none, 1), _paths(job, self.method))
        keys = np.arange(len(position), dtype=np.int32)
        found = source.at_points(position, normal, keys, *strata(self.method.rays))
        return found.value[:, None], source.counts["record_rays"]

    def reflect(self, job: Job, hits: PrimaryHits, values: np.ndarray, reflected: wp.array) -> dict[str, int]:
        """See `PointLight`; hits without a point are traced."""
        device, counts = job.device, {"fallback_hits": 0, "fallback_rays": 0}
        irradiance = device.zeros(len(hits.origin), wp.vec3)
        source = PathSource(job, hits, _paths(job, self.method))
        for some in _on(job.scene, hits, self._others, HITS):
            mixed, found = self.lookup.at_hits(job.scene, hits, some, values)
            inputs = [mixed, device.array(some, int)]
            device.launch(irradiance_cache.place_irradiance, len(some), inputs, [irradiance])
            alone = some[found == 0]
            if len(alone):
                traced = source.at_hits(alone, max(1, round(self.method.fallback_rays / hits.per_pixel)))
                inputs = [traced, device.array(alone, int)]
                device.launch(irradiance_cache.place_irradiance, len(alone), inputs, [irradiance])
                counts["fallback_hits"] += len(alone)
        counts["fallback_rays"] = source.counts["fallback_rays"]
        inputs = [irradiance, device.array(hits.albedo, wp.vec3)]
        device.launch(irradiance_cache.reflect_irradiance, len(hits.origin), inputs, [reflected])
        return counts


class Harmonics:
    """Spherical harmonics of the incident light, from which a glossy surface's BSDF takes its share."""

    name = "harmonics"

    def __init__(self, points: SurfacePoints, glossy: np.ndarray, rest: DeviceScene, method: PointFilter) -> None:
        self.points, self.method, self.rest, self._glossy = points, method, rest, glossy
        self.lookup = PointLookup(points, rest)
        assert method.roughness is not None
        self.order = order_for(method.roughness)
        self.width = (self.order + 1) ** 2

    def trace(self, job: Job) -> tuple[np.ndarray, int]:
        """See `PointLight`."""
        position, normal = self.points.placed(job.scene)
        rings, sectors = strata(self.method.rays)
        size, device = rings * sectors, job.device
        paths, step = _paths(job, self.method), float(OFFSET_ULPS) * job.scene.radius
        batch = max(1, STRATA_BYTES // (28 * size + 16 * self.width))
        parts = []
        for start in range(0, len(position), batch):
            some = slice(start, start + batch)
            count = len(position[some])
            directions, found = device.zeros(count * size, wp.vec3), device.zeros(count * size, wp.vec4)
            inputs = [device.array(a[some], wp.vec3) for a in (position, normal)]
            keys = np.arange(len(position), dtype=np.int32)[some]
            inputs += [device.array(a, int) for a in (self.points.face[some], keys)]
            inputs = [job.scene.struct, self.rest.struct, paths, step, *inputs, rings, sectors]
            device.launch(kernels.trace_directions, count, inputs, [directions, found])
            parts.append(self.projected(directions, found, size, self.points.normal[some]))
        return np.concatenate(parts), len(position) * size

    def projected(self, directions: wp.array, found: wp.array, size: int, normals: np.ndarray) -> np.ndarray:
        """Coefficients from `size` directions of equal solid angle of each point's hemisphere, shape (P, width, 3)."""
        device, count = self.lookup.device, len(normals)
        room, coefficients = device.zeros(count * self.width, float), device.zeros(count * self.width, wp.vec3)
        inputs = [directions, found, size, device.array(normals, wp.vec3), self.order]
        device.launch(kernels.project_directions, count, inputs, [room, coefficients])
        return coefficients.numpy().reshape(count, self.width, 3)

    def reflect(self, job: Job, hits: PrimaryHits, values: np.ndarray, reflected: wp.array) -> dict[str, int]:
        """See `PointLight`; hits without a point are dark and counted."""
        device, dark = job.device, 0
        lobes = kernels.Lobes()
        lobes.normal, lobes.wo, lobes.reflectance, lobes.albedo = (
            device.array(a, wp.vec3) for a in (hits.normal, hits.wo, hits.reflectance, hits.albedo)
        )
        lobes.face, lobes.material = device.array(hits.face, int), device.array(hits.material, int)
        lobes.per_pixel = hits.per_pixel
        rays = max(1, round(self.method.lobe_rays / hits.per_pixel))
        for some in _on(job.scene, hits, self._glossy, min(HITS, max(1, HIT_VALUES // self.width))):
            mixed, found = self.lookup.at_hits(job.scene, hits, some, values)
            dark += int(np.count_nonzero(found == 0))
            lobes.hits = device.array(some, int)
            inputs = [job.scene.struct, self.rest.struct, lobes, mixed, self.order, rays, job.seed]
            room = device.zeros(len(some) * self.width, float)
            device.launch(kernels.reflect_harmonics, len(some), inputs, [room, reflected])
        return {"dark_hits": dark}


def _paths(job: Job, method: PointFilter) -> PathSettings:
    return path_settings(job, (method.max_depth or NEVER) - 1, method.roulette_depth or NEVER, method.sampler)


def _on(scene: DeviceScene, hits: PrimaryHits, wanted: np.ndarray, most: int) -> Iterator[np.ndarray]:
    """Numbers of primary hits on the shapes wanted, some at a time."""
    assert hits.face is not None
    met = np.flatnonzero(hits.face >= 0)
    shape = np.searchsorted(scene.first_face, hits.face[met], side="right") - 1
    numbers = met[wanted[shape]].astype(np.int32)
    for start in range(0, len(numbers), most):
        yield numbers[start : start + most]
