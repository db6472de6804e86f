"""`sample`: the input stage of light-field reconstruction alone."""

from __future__ import annotations

import numpy as np
import warp as wp

from warpgi import checks
from warpgi.device import Device, as_device
from warpgi.device_scene import DeviceScene
from warpgi.film import Film
from warpgi.job import Job
from warpgi.kernels import rng
from warpgi.kernels.path import PathSettings
from warpgi.kernels.samples import SampleArrays, trace_samples
from warpgi.methods.path import NEVER, Sampler
from warpgi.reconstruction import PrimaryHits
from warpgi.samples import NO_HIT, SampleBuffer
from warpgi.scene import Scene

PRIMARY = ("origin", "origin_normal", "albedo")
SECONDARY = ("hit", "hit_normal", "radiance")
HIT_LIGHT = ("throughput", "hit_direct")
#: Device bytes of a primary hit, and of a secondary ray beside it.
PRIMARY_BYTES, SECONDARY_BYTES = 12 * len(PRIMARY), 12 * len(SECONDARY + HIT_LIGHT)


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
) -> tuple[SampleBuffer, PrimaryHits]:
    """Traces a picture's samples; positions stay relative to the device's origin, other light goes to the film.

    The first `spp` of a pixel's `hits` primary hits send secondary rays, which make the buffer; light is to be gathered
    at all of them.
    """
    device = job.device
    pixels = job.size[0] * job.size[1]
    settings = PathSettings()
    settings.max_depth, settings.roulette_depth, settings.seed = max_depth, roulette_depth, job.seed
    settings.sampler = int(rng.SOBOL if sampler is Sampler.SOBOL else rng.INDEPENDENT)
    arrays = SampleArrays()
    arrays.hits, arrays.spp = hits, spp
    sizes = dict.fromkeys(PRIMARY, pixels * hits) | dict.fromkeys(SECONDARY, pixels * spp)
    sizes |= dict.fromkeys(HIT_LIGHT, pixels * spp if with_hit_light else 0)
    for name, count in sizes.items():
        setattr(arrays, name, device.zeros(count, wp.vec3))
    for band in film.bands:
        arrays.first_pixel = band.start
        inputs = [job.scene.struct, job.camera, settings, light_samples]
        device.launch(trace_samples, len(band), inputs, [film.load(band), arrays])
    # on cpu these are the very arrays, which the buffer keeps alive
    values = {name: getattr(arrays, name).numpy() for name, count in sizes.items() if count}
    every = PrimaryHits(values["origin"], values["origin_normal"], values["albedo"], hits)
    if hits > spp:
        values |= {name: values[name].reshape(pixels, hits, 3)[:, :spp].reshape(-1, 3) for name in PRIMARY}
    return SampleBuffer(job.size[0], job.size[1], spp, **values), every


def sample(
    scene: Scene,
    spp: int = 8,
    size: tuple[int, int] = (256, 256),
    seed: int = 0,
    device: str | Device | None = None,
    max_depth: int | None = None,
    recursive: bool = False,
) -> SampleBuffer:
    """Path-traces the samples that `reconstruct` takes: secondary rays and the light that comes along them.

    Light sampling at every vertex, several bounces; emission that a secondary ray meets is direct light and left out.
    Only diffuse primary hits are recorded, behind mirrors and glass where these come first.

    Args:
        scene: what to sample.
        spp: samples per pixel.
        size: (width, height) in pixels.
        seed: which random numbers, 0 to 2^31 - 1.
        device: "cpu", "cuda:0", a `Device`, or None for a GPU if there is one.
        max_depth: longest path in segments, at least 3 for any indirect light; None is unlimited.
        recursive: record throughput and direct light at the secondary hits as well, for recursive filtering.

    Returns:
        A buffer in world coordinates; 72 bytes a sample, 96 with `recursive`.

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
    checks.count("spp", spp)
    size = checks.image_size(size)
    depth = NEVER if max_depth is None else checks.count("max_depth", max_depth)
    where = as_device(device)
    where.load([trace_samples])
    on_device = DeviceScene(scene, where)
    film = Film(
        size, where, where.memory_limit - on_device.nbytes - size[0] * size[1] * spp * (PRIMARY_BYTES + SECONDARY_BYTES)
    )
    job = Job(on_device, on_device.camera(size), size, checks.count("seed", seed, 0), where)
    samples, _ = trace_sample_buffer(job, film, spp, spp, 1, depth, 5, Sampler.SOBOL, recursive)
    centre = on_device.centre.astype(np.float32)
    for points in (samples.origin, samples.hit):
        met = np.abs(points).max(axis=1) < NO_HIT
        points[met] += centre
    return samples
