"""`sample`: the input stage of light-field reconstruction alone."""

from __future__ import annotations

from typing import Any

import numpy as np
import warp as wp

from warpgi import checks
from warpgi.device import Device, as_device
from warpgi.device_scene import DeviceScene
from warpgi.film import Film
from warpgi.job import Job
from warpgi.kernels import rng
from warpgi.kernels.path import PathSettings
from warpgi.kernels.primary_samples import PrimaryArrays, trace_primary_samples
from warpgi.kernels.samples import SampleArrays, trace_samples
from warpgi.methods.path import NEVER, Sampler
from warpgi.reconstruction import PrimaryHits
from warpgi.samples import NO_HIT, SampleBuffer
from warpgi.scene import Scene

PRIMARY = ("origin", "origin_normal", "albedo")
SECONDARY = ("hit", "hit_normal", "radiance")
HIT_LIGHT = ("throughput", "hit_direct")
# For scenes with a lens or in motion, and for glossy surfaces: of primary hits, then of secondary rays.
MOTION = {"time": float, "origin_motion": wp.vec3}, {"hit_motion": wp.vec3}
GLOSS = (
    {"material": int, "wo": wp.vec3, "reflectance": wp.vec3},
    {"layer": int, "bandwidth": float, "base_radiance": wp.vec3},
)
# Beside these where the scene has mirrors: the segment after one, beginning at the secondary hit.
BEYOND: dict[str, Any] = {
    "mirror": wp.vec3,
    "beyond_hit": wp.vec3,
    "beyond_normal": wp.vec3,
    "beyond_radiance": wp.vec3,
    "beyond_bandwidth": float,
    "beyond_base": wp.vec3,
}
PLACE = {"face": int, "bary": wp.vec2}  # of a primary hit on its surface
ANY_EXPONENT = 1e30
#: Device bytes of a primary hit, and of a secondary ray beside it.
PRIMARY_BYTES, SECONDARY_BYTES = 12 * len(PRIMARY), 12 * len(SECONDARY + HIT_LIGHT)


def path_settings(
    job: Job, max_depth: int, roulette_depth: int, sampler: Sampler, with_layers: bool = False
) -> PathSettings:
    """Settings of the kernels that trace samples."""
    settings = PathSettings()
    settings.max_depth, settings.roulette_depth, settings.seed = max_depth, roulette_depth, job.seed
    settings.sampler = int(rng.SOBOL if sampler is Sampler.SOBOL else rng.INDEPENDENT)
    settings.layers = int(with_layers)
    return settings


def trace_sample_buffer(
    job: Job,
    film: Film,
    spp: int,
    hits: int,
    light_samples: int,
    max_depth: int,
    roulette_depth: int,
    sampler: Sampler,
    with_hit_light: bool,
    with_gloss: bool = False,
    with_weight: bool = False,
    with_beyond: bool = True,
) -> tuple[SampleBuffer, PrimaryHits]:
    """Traces a picture's samples; positions stay relative to the device's origin, other light goes to the film.

    The first `spp` of a pixel's `hits` primary hits send secondary rays, which make the buffer; light is to be gathered
    at all of them. `with_gloss` records glossy primary hits too, with what their BSDFs need; else only diffuse ones;
    `with_weight` what they reflect of their secondary rays' light, `with_beyond` the segments after mirrors too.
    """
    pixels = job.size[0] * job.size[1]
    scene = job.scene.scene
    of_hits: dict[str, Any] = dict.fromkeys(PRIMARY, wp.vec3)
    of_rays: dict[str, Any] = dict.fromkeys(SECONDARY, wp.vec3)
    if with_hit_light:
        of_rays |= dict.fromkeys(HIT_LIGHT, wp.vec3)
    for wanted, (more_of_hits, more_of_rays) in ((scene.moves, MOTION), (with_gloss, GLOSS)):
        if wanted:
            of_hits, of_rays = of_hits | more_of_hits, of_rays | more_of_rays
    if with_weight:
        of_rays["weight"] = wp.vec3
    if scene.camera.lens_radius > 0.0:
        of_hits["lens"] = wp.vec2
    with_mirrors = with_gloss and with_beyond and scene.has_mirrors and not scene.moves
    if with_mirrors:
        of_rays |= BEYOND
    paths = path_settings(job, max_depth, roulette_depth, sampler, with_gloss)
    arrays = _trace(job, film, hits, spp, light_samples, paths, of_hits, of_rays)
    # on cpu these are the very arrays, which the buffer keeps alive
    values = {name: getattr(arrays, name).numpy() for name in of_hits | of_rays}
    gloss = {name: values[name] for name in GLOSS[0] if with_gloss}
    every = PrimaryHits(values["origin"], values["origin_normal"], values["albedo"], hits, **gloss)
    if hits > spp:
        for name in of_hits:
            of_pixel = values[name].reshape(pixels, hits, *values[name].shape[1:])
            values[name] = np.ascontiguousarray(of_pixel[:, :spp]).reshape(-1, *values[name].shape[1:])
    if with_gloss:
        values["materials"] = tuple(shape.material for shape in scene.shapes)
    if with_mirrors:
        values["beyond"] = _beyond(values)
    return SampleBuffer(job.size[0], job.size[1], spp, **values, **_projection(job)), every


def _beyond(values: dict[str, Any]) -> SampleBuffer | None:
    """The segments after mirrors, taken out of the arrays of secondary rays; None where no ray met any."""
    arrays = {name: values.pop(name) for name in BEYOND}
    met = np.flatnonzero(arrays["mirror"].any(axis=1)).astype(np.int32)
    if not len(met):
        return None
    names = ("hit", "hit_normal", "radiance", "bandwidth", "base_radiance")
    after = dict(zip(names, (arrays[name][met] for name in list(BEYOND)[1:]), strict=True))
    start = {"origin": values["hit"][met], "origin_normal": values["hit_normal"][met], "albedo": arrays["mirror"][met]}
    return SampleBuffer(len(arrays["mirror"]), 1, 0, pixel=met, **after, **start)


def trace_primary_hits(
    job: Job,
    film: Film,
    hits: int,
    light_samples: int,
    paths: PathSettings,
    with_place: bool = False,
    exponent: float = 0.0,
) -> PrimaryHits:
    """Traces a picture's primary hits alone; positions stay relative to the device's origin. Direct light, and all
    light of surfaces that are not diffuse, goes to the film; `with_place` tells places on surfaces, and glossy ones of
    Blinn exponents up to `exponent` are recorded too."""
    more: dict[str, Any] = (PLACE if with_place else {}) | (GLOSS[0] if exponent > 0.0 else {})
    of_hits = dict.fromkeys(PRIMARY, wp.vec3) | more
    arrays = _trace(job, film, hits, 0, light_samples, paths, of_hits, {}, exponent)
    origin, normal, albedo = (getattr(arrays, name).numpy() for name in PRIMARY)
    return PrimaryHits(origin, normal, albedo, hits, **{name: getattr(arrays, name).numpy() for name in more})


def _trace(
    job: Job,
    film: Film,
    hits: int,
    spp: int,
    light_samples: int,
    paths: PathSettings,
    of_hits: dict[str, Any],
    of_rays: dict[str, Any],
    exponent: float = ANY_EXPONENT,
) -> SampleArrays:
    """Fills the named arrays of a picture's primary hits, and of its secondary rays."""
    pixels = job.size[0] * job.size[1]
    arrays = SampleArrays()
    arrays.hits, arrays.spp, arrays.exponent = hits, spp, exponent
    for names, count in ((of_hits, pixels * hits), (of_rays, pixels * spp)):
        for name, dtype in names.items():
            setattr(arrays, name, job.device.zeros(count, dtype))
    for band in film.bands:
        arrays.first_pixel = band.start
        inputs = [job.scene.struct, job.camera, paths, light_samples]
        job.device.launch(trace_samples, len(band), inputs, [film.load(band), arrays])
    return arrays


def trace_primary_buffer(
    job: Job, film: Film, spp: int, max_depth: int, roulette_depth: int, sampler: Sampler
) -> SampleBuffer:
    """Traces a picture's camera rays as path tracing does; they go to the film too. Positions are in camera space."""
    device, scene = job.device, job.scene.scene
    count = job.size[0] * job.size[1] * spp
    dtypes: dict[str, Any] = {"image_xy": wp.vec2, "origin": wp.vec3, "hit": wp.vec3, "hit_normal": wp.vec3}
    dtypes["radiance"] = wp.vec3
    if scene.camera.lens_radius > 0.0:
        dtypes["lens"] = wp.vec2
    if scene.moves:
        dtypes |= {"time": float, "hit_motion": wp.vec3}
    arrays = PrimaryArrays()
    arrays.spp = spp
    for name, dtype in dtypes.items():
        setattr(arrays, name, device.zeros(count, dtype))
    for band in film.bands:
        arrays.first_pixel = band.start
        inputs = [job.scene.struct, job.camera, path_settings(job, max_depth, roulette_depth, sampler)]
        device.launch(trace_primary_samples, len(band), inputs, [film.load(band), arrays])
    values = {name: getattr(arrays, name).numpy() for name in dtypes}
    values["origin_normal"] = np.tile(np.array([0.0, 0.0, -1.0], np.float32), (count, 1))
    values["albedo"] = np.ones((count, 3), np.float32)
    return SampleBuffer(job.size[0], job.size[1], spp, **values, **_projection(job))


def _projection(job: Job) -> dict[str, Any]:
    """Circle of confusion and focal plane of the camera, in camera space: the viewing direction is -z."""
    camera, (width, height) = job.camera, job.size
    focus = camera.focus_distance
    step = np.array([2.0 * camera.tan_x / width, 2.0 * camera.tan_y / height]) * focus
    matrix = np.array(
        [
            [step[0], 0.0, 0.0, -camera.tan_x * focus],
            [0.0, -step[1], 0.0, camera.tan_y * focus],
            [0.0, 0.0, 0.0, -focus],
            [0.0, 0.0, 0.0, 1.0],
        ]
    )
    # a point at depth z blurs to the radius R |1 - focus / z| on the focal plane
    radius = camera.lens_radius / step[1]
    return {"pixel_to_camera": matrix, "coc": (-radius * focus, radius) if radius > 0.0 else (0.0, 0.0)}


def sample(
    scene: Scene,
    spp: int = 8,
    size: tuple[int, int] = (256, 256),
    seed: int = 0,
    device: str | Device | None = None,
    max_depth: int | None = None,
    recursive: bool = False,
    glossy: bool = False,
    primary: bool = False,
) -> SampleBuffer:
    """Path-traces the samples that `reconstruct` takes: secondary rays and the light that comes along them.

    Light sampling at every vertex, several bounces; emission that a secondary ray meets is direct light and left out.
    Only diffuse primary hits are recorded, behind mirrors and glass where these come first. Lens coordinates, times
    and motion are there where the camera has a lens and the scene moves.

    Args:
        scene: what to sample.
        spp: samples per pixel.
        size: (width, height) in pixels.
        seed: which random numbers, 0 to 2^31 - 1.
        device: "cpu", "cuda:0", a `Device`, or None for a GPU if there is one.
        max_depth: longest path in segments, at least 3 for any indirect light; None is unlimited.
        recursive: record throughput and direct light at the secondary hits as well, for recursive filtering.
        glossy: record glossy primary hits too, with what their BSDFs need, and bandwidths and layers at the secondary
            hits; nothing more than without it where the scene has no glossy surface.
        primary: record the camera's own rays and all light that comes along them, for defocus and motion: `origin` is
            on the lens, `hit` what the ray met, and both are in camera space, where the viewing direction is -z.

    Returns:
        A buffer in world coordinates, or camera space with `primary`; 72 bytes a sample, 96 with `recursive`.

    Raises:
        TypeError, ValueError: an argument is wrong; nothing has been computed then.

    Example:
        >>> import warpgi as gi
        >>> samples = gi.sample(gi.scenes.cornell_box(), spp=2, size=(8, 8))
        >>> samples.radiance.shape
        (128, 3)
    """
    if not isinstance(scene, Scene):
        raise TypeError(f"scene is {type(scene).__name__}, expected Scene")
    if primary and (recursive or glossy):
        raise ValueError("primary goes with neither recursive nor glossy, expected it alone")
    checks.count("spp", spp)
    size = checks.image_size(size)
    depth = NEVER if max_depth is None else checks.count("max_depth", max_depth)
    where = as_device(device)
    where.load([trace_primary_samples if primary else trace_samples])
    on_device = DeviceScene(scene, where)
    film = Film(
        size, where, where.memory_limit - on_device.nbytes - size[0] * size[1] * spp * (PRIMARY_BYTES + SECONDARY_BYTES)
    )
    job = Job(on_device, on_device.camera(size), size, checks.count("seed", seed, 0), where)
    if primary:
        return trace_primary_buffer(job, film, spp, depth, 5, Sampler.SOBOL)
    with_gloss = glossy and scene.is_glossy
    samples, _ = trace_sample_buffer(job, film, spp, spp, 1, depth, 5, Sampler.SOBOL, recursive, with_gloss, with_gloss)
    centre = on_device.centre.astype(np.float32)
    beyond = samples if samples.beyond is None else samples.beyond
    for points in {id(points): points for points in (samples.origin, samples.hit, beyond.origin, beyond.hit)}.values():
        met = np.abs(points).max(axis=1) < NO_HIT
        points[met] += centre
    return samples
