"""`sample_from_mitsuba`: the input of light-field reconstruction from any scene of Mitsuba 3 (Jakob et al. 2022)."""

from __future__ import annotations

import math
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any, NamedTuple

import numpy as np

from warpgi import checks
from warpgi.mitsuba_scene import NEVER, require_mitsuba
from warpgi.samples import ESCAPED_DISTANCE, SampleBuffer, escaped_hit

# Paths in one go: each takes some hundred bytes there.
WAVEFRONT = 1 << 22

# Mirrors and glass before the first diffuse surface; a longer chain is left dark.
MAX_CHAIN = 16


class Incident(NamedTuple):
    """What came along rays."""

    hit: Any
    """Where they ended: SurfaceInteraction3f."""
    radiance: Any
    """Radiance without the emission at `hit`: Color3f."""


def incident(mi: Any, scene: Any, path: Any, sampler: Any, ray: Any, active: Any) -> Incident:
    """Radiance along rays by Mitsuba's integrator `path`, without what the first surface, or the sky, emits itself.

    Path tracing adds that emission to each path as it is, so it is taken away again exactly, but for rounding.
    """
    import drjit as dr

    radiance, _, _ = path.sample(scene, sampler, mi.RayDifferential3f(ray), None, active)
    hit = scene.ray_intersect(ray, active)
    emission = hit.emitter(scene, active).eval(hit, active)
    return Incident(hit, dr.select(active, dr.maximum(radiance - emission, 0.0), 0.0))


def sample_from_mitsuba(
    mi_scene: Any,
    spp: int = 8,
    size: tuple[int, int] = (256, 256),
    seed: int = 0,
    max_depth: int | None = None,
    roulette_depth: int | None = 5,
    recursive: bool = False,
    sensor: int = 0,
) -> SampleBuffer:
    """Path-traces a scene in Mitsuba 3 and records the samples that `reconstruct` takes.

    Camera rays, intersections, materials and light are Mitsuba's; radiance comes from its `path` integrator. Primary
    hits are recorded where a material has a diffuse part, behind mirrors and glass where these come first, and only
    that part is reconstructed. Direct light is not part of the samples: emission that a secondary ray meets is left
    out. What a picture needs besides, `mitsuba.render` brings with a `path` integrator of `max_depth` 2.

    Args:
        mi_scene: what `mitsuba.load_dict` or `load_file` returned, of an RGB variant that is vectorised: "llvm_ad_rgb"
            or "cuda_ad_rgb", which has to be set.
        spp: samples per pixel.
        size: (width, height) in pixels, in place of the film's own size and crop; the horizontal field of view stays.
        seed: which random numbers, 0 to 2^31 - 1.
        max_depth: longest path in segments, at least 3 for any indirect light, mirrors and glass before the first
            diffuse surface not counted; None is unlimited.
        roulette_depth: segments of a secondary path after which Russian roulette may end it; None switches it off.
        recursive: record throughput and direct light at the secondary hits as well, for recursive filtering.
        sensor: which of the scene's cameras.

    Returns:
        A buffer in world coordinates.

    Raises:
        ImportError: Mitsuba is not installed.
        TypeError, ValueError: an argument is wrong, or the variant is.

    Example:
        >>> import warpgi as gi
        >>> import mitsuba
        >>> mitsuba.set_variant("llvm_ad_rgb")
        >>> samples = gi.sample_from_mitsuba(mitsuba.load_dict(mitsuba.cornell_box()), spp=2, size=(8, 8))
        >>> gi.reconstruct(samples, gi.LightField(rays=16)).layers["indirect"].shape
        (8, 8, 3)
    """
    mi = require_mitsuba()
    if mi.variant().startswith("scalar"):
        raise ValueError(f"mitsuba's variant is {mi.variant()}, expected a vectorised one, such as llvm_ad_rgb")
    if not isinstance(mi_scene, mi.Scene):
        raise TypeError(f"mi_scene is {type(mi_scene).__name__}, expected a mitsuba.Scene of {mi.variant()}")
    spp, size, seed = checks.count("spp", spp), checks.image_size(size), checks.count("seed", seed, 0)
    # the paths that Mitsuba traces are the secondary rays' own
    depth = -1 if max_depth is None else checks.count("max_depth", max_depth, 2) - 1
    roulette = NEVER if roulette_depth is None else checks.count("roulette_depth", roulette_depth)
    sensors = mi_scene.sensors()
    if not sensors:
        raise ValueError("mi_scene has no sensor, expected one: a perspective camera, say")
    camera = sensors[checks.count("sensor", sensor, 0, len(sensors) - 1)]
    tracer = _Tracer(mi, mi_scene, camera, size, spp, {"type": "path", "max_depth": depth, "rr_depth": roulette})
    step = max(1, WAVEFRONT // (size[0] * spp))
    bands = [range(y, min(y + step, size[1])) for y in range(0, size[1], step)]
    with _film_size(mi, camera, size):
        parts = [tracer.trace(rows, seed, recursive) for rows in bands]
    arrays: dict[str, Any] = {name: np.concatenate([part[name] for part in parts]) for name in parts[0]}
    return SampleBuffer(size[0], size[1], spp, **arrays)


@contextmanager
def _film_size(mi: Any, sensor: Any, size: tuple[int, int]) -> Iterator[None]:
    """The sensor with a film of another size, whole; afterwards as it was."""
    params = mi.traverse(sensor)
    names = ("film.size", "film.crop_size", "film.crop_offset")
    before = {name: type(params[name])(params[name]) for name in names}
    try:
        params["film.size"] = list(size)
        params["film.crop_size"] = list(size)
        params["film.crop_offset"] = [0, 0]
        params.update()
        yield
    finally:
        for name, value in before.items():
            params[name] = value
        params.update()


class _Tracer:
    """Traces bands of rows; one lane there is one sample here, in pixel order."""

    def __init__(self, mi: Any, scene: Any, sensor: Any, size: tuple[int, int], spp: int, path: dict[str, Any]) -> None:
        self.mi, self.scene, self.sensor = mi, scene, sensor
        self.size, self.spp = size, spp
        self.path = mi.load_dict(path)
        self.direct = mi.load_dict(path | {"max_depth": 2})
        # stratified where this many samples make a grid
        kind = "independent" if spp % math.isqrt(spp) else "multijitter"
        self.sampler = mi.load_dict({"type": kind, "sample_count": spp})
        self.sampler.set_samples_per_wavefront(spp)
        self.context = mi.BSDFContext()

    def trace(self, rows: range, seed: int, recursive: bool) -> dict[str, np.ndarray]:
        """Samples of these rows, by the names of `SampleBuffer`."""
        import drjit as dr

        mi, sampler = self.mi, self.sampler
        # mixed, so that neighbouring seeds and bands share no stream
        mixed = int(np.random.SeedSequence((seed, rows.start)).generate_state(1)[0])
        sampler.seed(mixed, len(rows) * self.size[0] * self.spp)
        primary, albedo, active = self._first_diffuse(*self._camera_rays(rows))
        normal = _facing(dr, primary)
        direction = mi.Frame3f(normal).to_world(mi.warp.square_to_cosine_hemisphere(sampler.next_2d()))
        # a one-sided material is black from behind
        active &= dr.any(primary.bsdf().eval(self.context, primary, primary.to_local(direction), active) > 0.0)
        ray = primary.spawn_ray(direction)
        again = sampler.clone()
        secondary, radiance = incident(mi, self.scene, self.path, sampler, ray, active)
        met = active & secondary.is_valid()
        arrays = {
            "origin": dr.select(active, primary.p, ESCAPED_DISTANCE),
            "origin_normal": normal,
            "albedo": dr.select(active, albedo, 0.0),
            "hit": dr.select(met, secondary.p, 0.0),
            "hit_normal": dr.select(met, _facing(dr, secondary), 0.0),
            "radiance": radiance,
        }
        if recursive:
            # the same random numbers, so that this is the very direct light in `radiance`
            arrays["hit_direct"] = incident(mi, self.scene, self.direct, again, ray, active).radiance
            reflectance = secondary.bsdf().eval_diffuse_reflectance(secondary, met)
            arrays["throughput"] = dr.select(met, reflectance, 0.0)
        dr.eval(arrays, direction, met)
        values = {name: np.ascontiguousarray(np.array(array).T, dtype=np.float32) for name, array in arrays.items()}
        lost = ~np.array(met)
        values["hit"][lost] = escaped_hit(values["origin"], np.array(direction).T)[lost]
        return values

    def _camera_rays(self, rows: range) -> tuple[Any, Any]:
        """Rays through random points of the pixels, and what the sensor weights them with."""
        import drjit as dr

        mi, sampler, sensor = self.mi, self.sampler, self.sensor
        width, height = self.size
        index = dr.arange(mi.UInt32, len(rows) * width * self.spp) // self.spp
        corner = mi.Point2f(mi.Float(index % width), mi.Float(index // width + rows.start))
        place = (corner + sampler.next_2d()) / mi.Point2f(width, height)
        time = sensor.shutter_open() + sampler.next_1d() * sensor.shutter_open_time()
        lens = sampler.next_2d() if sensor.needs_aperture_sample() else mi.Point2f(0.5)
        return sensor.sample_ray(time, sampler.next_1d(), place, lens)

    def _first_diffuse(self, ray: Any, weight: Any) -> tuple[Any, Any, Any]:
        """Where rays first meet a material with a diffuse part: the hit, the light it reflects there, whether any."""
        import drjit as dr

        mi, sampler, kinds = self.mi, self.sampler, self.mi.BSDFFlags
        result, albedo = dr.zeros(mi.SurfaceInteraction3f), mi.Color3f(0.0)
        found, going = mi.Mask(False), mi.Mask(True)
        for _ in range(MAX_CHAIN + 1):
            hit = self.scene.ray_intersect(ray, going)
            going &= hit.is_valid()
            bsdf = hit.bsdf(ray)
            flags = bsdf.flags()
            diffuse = going & mi.has_flag(flags, kinds.DiffuseReflection)
            # the holes of cut-outs let a share of the rays through
            gap = dr.mean(bsdf.eval_null_transmission(hit, diffuse))
            diffuse &= sampler.next_1d() >= gap
            result[diffuse] = hit
            albedo[diffuse] = weight * bsdf.eval_diffuse_reflectance(hit, diffuse)
            found |= diffuse
            glossy = mi.has_flag(flags, kinds.GlossyReflection) | mi.has_flag(flags, kinds.GlossyTransmission)
            going &= ~diffuse & ((gap > 0.0) | ~glossy)
            if not dr.any(going):
                break
            sample, factor = bsdf.sample(self.context, hit, sampler.next_1d(), sampler.next_2d(), going)
            hole = mi.has_flag(flags, kinds.DiffuseReflection)
            weight *= dr.select(hole, 1.0, factor)
            ray = hit.spawn_ray(dr.select(hole, ray.d, hit.to_world(sample.wo)))
            going &= dr.any(weight > 0.0)
        return result, albedo, found


def _facing(dr: Any, hit: Any) -> Any:
    """Shading normal on the side from which the ray came."""
    return dr.mulsign(hit.sh_frame.n, hit.wi.z)
