"""Path tracing (Kajiya 1986) with multiple importance sampling (Veach 1997) and Russian roulette."""

import warp as wp

from warpgi.kernels.bsdf import bandwidth, base_share, is_delta, sample
from warpgi.kernels.camera import Camera, camera_ray, shutter_time
from warpgi.kernels.direct import (
    add_features,
    direct_light,
    emitted,
    facing_normal,
    found_light_weight,
    reflects,
)
from warpgi.kernels.film import Film, PathSample, add_sample
from warpgi.kernels.rng import Sampler, make_sampler, sample_2d
from warpgi.kernels.scene import DIELECTRIC, Scene, closest_hit, motion_at, offset_origin, surface_at

wp.set_module_options({"enable_backward": False})

# Pairs of random numbers: two for the camera, then three for each vertex.
CAMERA_PAIRS = wp.constant(2)
VERTEX_PAIRS = wp.constant(3)
TIME_PAIR = wp.constant(-1)  # beside these, so that a still scene's numbers do not depend on it

# Even a path that loses nothing ends some day.
MAX_SURVIVAL = wp.constant(0.95)


@wp.struct
class PathSettings:
    max_depth: int  # longest path in segments; 1 sees emitters only
    roulette_depth: int  # segments after which roulette may end a path
    sampler: int  # INDEPENDENT or SOBOL
    seed: int
    layers: int  # 1: tell bandwidth and base of what is met first


@wp.func
def add_light(path: PathSample, depth: int, radiance: wp.vec3):
    """Light that reached the camera over `depth` segments, into its layer."""
    result = path
    if depth == 1:
        result.emission = result.emission + radiance
    elif depth == 2:
        result.direct = result.direct + radiance
    else:
        result.indirect = result.indirect + radiance
    return result


@wp.func
def inverse_distance(t: float):
    """One over a hit's distance, bounded where a ray meets something at its very start."""
    return 1.0 / wp.max(t, 1.0e-20)


@wp.func
def trace_path(
    scene: Scene,
    settings: PathSettings,
    sampler: Sampler,
    first_pair: int,
    origin: wp.vec3,
    direction: wp.vec3,
    first_pdf: float,
):
    """Light that arrives at `origin` against `direction`, by the number of its scatterings.

    `first_pdf` is the density of the direction where light sampling at `origin` shares its emission, else 0. The path
    takes its random numbers from pair `first_pair` on.
    """
    path = PathSample()
    path.depth = -1.0
    o = origin
    d = direction
    throughput = wp.vec3(1.0)
    bsdf_pdf = first_pdf  # of the direction d; 0: from the camera or a delta lobe
    eta_scale = float(1.0)  # product of crossed indices squared, which roulette must not mistake for loss
    share = wp.vec3(1.0)  # of the light after the first vertex that left it by way of a diffuse layer
    before = wp.vec3(0.0)  # what came to it straight from lights
    depth = int(1)
    while True:
        hit = closest_hit(scene, o, d)
        path.closest_hit_rays = path.closest_hit_rays + 1
        if hit.face < 0:
            # The environment is found by BSDF sampling alone: of a constant one that is the better half.
            path = add_light(path, depth, wp.cw_mul(throughput, scene.environment))
            break
        shape = scene.shapes[scene.face_shapes[hit.face]]
        s = surface_at(scene, hit, shape)
        wo = -d
        if depth == 1:
            path = add_features(path, s, wo, hit.t)
            if settings.layers != 0:
                path.bandwidth = bandwidth(shape)
            if scene.moving != 0:
                path.motion = motion_at(scene, hit)
        elif depth == 2:
            path.inverse_distance = inverse_distance(hit.t)

        # emission
        le = emitted(shape, s.ng, wo)
        if le[0] + le[1] + le[2] > 0.0:
            w = found_light_weight(shape.light_pdf * s.stretch, s.ng, d, hit.t, bsdf_pdf)
            path = add_light(path, depth, wp.cw_mul(throughput, le) * w)
        last = depth + 1 >= settings.max_depth
        if depth >= settings.max_depth:
            break

        # light sampling
        n = s.n
        if shape.kind != DIELECTRIC:
            n = facing_normal(s, wo)
        pair = first_pair + VERTEX_PAIRS * (depth - 1)
        extra = sample_2d(sampler, pair + 2)
        if scene.light_count > 0 and not is_delta(shape.kind):
            light = direct_light(scene, shape, s, n, wo, sample_2d(sampler, pair), extra[0], 1.0)
            path.shadow_rays = path.shadow_rays + light.shadow_rays
            path = add_light(path, depth + 1, wp.cw_mul(throughput, light.radiance))
            if depth == 1 and settings.layers != 0:
                before = light.radiance
                path.base = wp.cw_mul(before, base_share(shape, s.albedo, n, wo, light.wi))
        if last and scene.visible_light == 0:
            break  # nothing but a light could still be met, and there is none to meet

        # BSDF sampling
        b = sample(shape, s.albedo, n, wo, sample_2d(sampler, pair + 1))
        if b.weight[0] + b.weight[1] + b.weight[2] <= 0.0:
            break
        if b.transmitted == 0 and not reflects(s, wo, b.wi):
            break  # a shading normal sent it through the surface
        if depth == 1 and settings.layers != 0:
            share = base_share(shape, s.albedo, n, wo, b.wi)
        throughput = wp.cw_mul(throughput, b.weight)
        eta_scale = eta_scale * b.eta * b.eta
        bsdf_pdf = b.pdf

        # roulette
        if depth >= settings.roulette_depth:
            survival = wp.min(MAX_SURVIVAL, wp.max(throughput) * eta_scale)
            if extra[1] >= survival:
                break
            throughput = throughput / survival
        o = offset_origin(s.p, s.ng, s.offset, b.wi)
        d = b.wi
        depth = depth + 1
        path.has_ray = 1
    if settings.layers != 0:
        path.base = path.base + wp.cw_mul(share, path.direct + path.indirect - before)
    return path


@wp.func
def pixel_ray(camera: Camera, sampler: Sampler, pixel: int):
    """Camera ray through a random point of a pixel, and of the lens if there is one."""
    u = sample_2d(sampler, 0)
    lens = wp.vec2(0.0)
    if camera.lens_radius > 0.0:
        lens = sample_2d(sampler, 1)
    return camera_ray(camera, float(pixel % camera.width) + u[0], float(pixel // camera.width) + u[1], lens)


@wp.func
def shutter_part(sampler: Sampler):
    """A random part of the shutter's interval, in [0, 1)."""
    return sample_2d(sampler, TIME_PAIR)[0]


@wp.kernel
def trace_paths(
    offset: int,
    scene: Scene,
    camera: Camera,
    settings: PathSettings,
    first_sample: int,
    sample_count: int,
    film: Film,
):
    """One thread owns one pixel: `sample_count` paths from `first_sample` on, folded into `film`."""
    i = offset + wp.tid()
    pixel = film.first_pixel + i
    for index in range(first_sample, first_sample + sample_count):
        sampler = make_sampler(settings.seed, pixel, index, settings.sampler)
        ray = pixel_ray(camera, sampler, pixel)
        if scene.moving != 0:
            scene.time = shutter_time(camera, shutter_part(sampler))
        add_sample(film, i, trace_path(scene, settings, sampler, CAMERA_PAIRS, ray.o, ray.d, 0.0))
