"""The input of defocus and motion reconstruction: camera rays and all the light that comes along them.

Lehtinen et al. 2012, section 3.4: primary rays take the place of secondary ones, points of the lens that of primary
hits.
"""

import warp as wp

from warpgi.kernels.camera import Camera, shutter_time
from warpgi.kernels.film import Film, add_sample
from warpgi.kernels.path import CAMERA_PAIRS, PathSettings, pixel_ray, shutter_part, trace_path
from warpgi.kernels.rng import make_sampler, sample_2d
from warpgi.kernels.samples import NO_HIT
from warpgi.kernels.sampling import square_to_disc
from warpgi.kernels.scene import Scene

wp.set_module_options({"enable_backward": False})


@wp.struct
class PrimaryArrays:
    """In camera space: x to the right, y up, the viewing direction is -z, the lens about the origin."""

    first_pixel: int  # of the band
    spp: int
    image_xy: wp.array[wp.vec2]
    lens: wp.array[wp.vec2]  # in the unit disc; empty for a pinhole
    time: wp.array[float]  # part of the shutter's interval; empty where nothing moves
    origin: wp.array[wp.vec3]  # on the lens
    hit: wp.array[wp.vec3]  # what the ray met, at its time, or its direction times NO_HIT
    hit_normal: wp.array[wp.vec3]
    hit_motion: wp.array[wp.vec3]  # while the shutter is open; empty where nothing moves
    radiance: wp.array[wp.vec3]


@wp.func
def to_camera(camera: Camera, v: wp.vec3):
    """A direction in camera space."""
    return wp.vec3(wp.dot(camera.right, v), wp.dot(camera.up, v), -wp.dot(camera.forward, v))


@wp.kernel
def trace_primary_samples(
    offset: int, scene: Scene, camera: Camera, settings: PathSettings, film: Film, samples: PrimaryArrays
):
    """One thread owns one pixel: traces its paths as path tracing does, into `film` and into `samples`."""
    i = offset + wp.tid()
    pixel = film.first_pixel + i
    for index in range(samples.spp):
        k = (samples.first_pixel + i) * samples.spp + index
        sampler = make_sampler(settings.seed, pixel, index, settings.sampler)
        ray = pixel_ray(camera, sampler, pixel)
        part = shutter_part(sampler)
        if scene.moving != 0:
            scene.time = shutter_time(camera, part)
        path = trace_path(scene, settings, sampler, CAMERA_PAIRS, ray.o, ray.d, 0.0)
        add_sample(film, i, path)
        samples.image_xy[k] = wp.vec2(float(pixel % camera.width), float(pixel // camera.width)) + sample_2d(sampler, 0)
        samples.origin[k] = to_camera(camera, ray.o - camera.position)
        samples.radiance[k] = path.emission + path.direct + path.indirect
        if samples.lens.shape[0] > 0:
            samples.lens[k] = square_to_disc(sample_2d(sampler, 1))
        if path.depth >= 0.0:
            samples.hit[k] = to_camera(camera, path.position - camera.position)
            samples.hit_normal[k] = to_camera(camera, path.normal)
        else:
            samples.hit[k] = to_camera(camera, ray.d) * NO_HIT
        if scene.moving != 0:
            samples.time[k] = part
            samples.hit_motion[k] = to_camera(camera, path.motion) * camera.shutter_length
