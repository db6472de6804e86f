"""Path tracing of some pixels of a picture alone."""

import warp as wp

from warpgi.kernels.camera import Camera, shutter_time
from warpgi.kernels.film import Film, add_sample
from warpgi.kernels.path import CAMERA_PAIRS, PathSettings, pixel_ray, shutter_part, trace_path
from warpgi.kernels.rng import make_sampler
from warpgi.kernels.scene import Scene

wp.set_module_options({"enable_backward": False})


@wp.kernel
def trace_chosen(
    offset: int,
    scene: Scene,
    camera: Camera,
    settings: PathSettings,
    pixels: wp.array[int],
    sample_count: int,
    film: Film,
):
    """One thread owns one of `pixels`: the paths that it would get in the whole picture, into its place in `film`."""
    i = offset + wp.tid()
    pixel = pixels[i]
    for index in range(sample_count):
        sampler = make_sampler(settings.seed, pixel, index, settings.sampler)
        ray = pixel_ray(camera, sampler, pixel)
        if scene.moving != 0:
            scene.time = shutter_time(camera, shutter_part(sampler))
        add_sample(film, i, trace_path(scene, settings, sampler, CAMERA_PAIRS, ray.o, ray.d, 0.0))
