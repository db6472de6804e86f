"""Indirect light at points by path tracing: the strata of hemispheres, and single rays."""

import warp as wp

from warpgi.kernels.film import is_finite
from warpgi.kernels.hemisphere import Hemispheres, stratum_direction
from warpgi.kernels.path import CAMERA_PAIRS, VERTEX_PAIRS, PathSettings, trace_path
from warpgi.kernels.rng import make_sampler, sample_2d
from warpgi.kernels.sampling import PI, make_frame, square_to_cosine_hemisphere, to_world
from warpgi.kernels.scene import FAR, Scene, offset_origin

wp.set_module_options({"enable_backward": False})

# The first pair after that of the direction, as if the point were a path's first vertex.
REST_PAIR = wp.constant(CAMERA_PAIRS + VERTEX_PAIRS)


@wp.func
def incident_light(
    scene: Scene, settings: PathSettings, p: wp.vec3, n: wp.vec3, d: wp.vec3, step: float, key: int, number: int
):
    """Radiance that comes along -d without what a light sends itself, and the distance of what was met."""
    sampler = make_sampler(settings.seed, key, number, settings.sampler)
    path = trace_path(scene, settings, sampler, REST_PAIR, offset_origin(p, n, step, d), d, 0.0)
    light = path.direct + path.indirect
    if not is_finite(light):
        return wp.vec4(0.0, 0.0, 0.0, -1.0)
    return wp.vec4(light[0], light[1], light[2], wp.where(path.depth >= 0.0, path.depth, FAR))


@wp.kernel
def trace_strata(
    offset: int,
    scene: Scene,
    settings: PathSettings,
    step: float,
    hemispheres: Hemispheres,
    strata: wp.array[wp.vec4],
):
    """One thread owns a point and fills the strata of its hemisphere with a path each: radiance and distance."""
    i = offset + wp.tid()
    n = hemispheres.normals[i]
    frame = make_frame(n)
    size = hemispheres.rings * hemispheres.sectors
    for k in range(size):
        d = to_world(frame, stratum_direction(hemispheres, i, k, settings.seed))
        strata[i * size + k] = incident_light(
            scene, settings, hemispheres.points[i], n, d, step, hemispheres.keys[i], k
        )


@wp.kernel
def gather_paths(
    offset: int,
    scene: Scene,
    settings: PathSettings,
    step: float,
    hits: wp.array[int],
    origins: wp.array[wp.vec3],
    normals: wp.array[wp.vec3],
    per_pixel: int,
    rays: int,
    irradiance: wp.array[wp.vec3],
):
    """One thread owns one of the listed primary hits: irradiance from `rays` paths, which a pixel's hits share out."""
    i = offset + wp.tid()
    h = hits[i]
    frame = make_frame(normals[h])
    total = wp.vec3(0.0)
    known = int(0)
    for ray in range(rays):
        number = (h % per_pixel) * rays + ray
        u = sample_2d(make_sampler(settings.seed, h // per_pixel, number, settings.sampler), REST_PAIR - 2)
        d = to_world(frame, square_to_cosine_hemisphere(u))
        found = incident_light(scene, settings, origins[h], normals[h], d, step, h // per_pixel, number)
        if found[3] >= 0.0:
            total = total + wp.vec3(found[0], found[1], found[2])
            known = known + 1
    irradiance[i] = total * (PI / float(wp.max(known, 1)))
