"""Instant radiosity (Keller 1997) with bias compensation (Kollig, Keller 2004): camera paths that end at lights."""

import warp as wp

from warpgi.kernels.bsdf import bandwidth, has_wide_lobe, is_delta, is_wide, sample, wide_share
from warpgi.kernels.camera import Camera
from warpgi.kernels.direct import (
    add_features,
    direct_light,
    emission_weight,
    emitted,
    facing_normal,
    reflects,
)
from warpgi.kernels.film import Film, PathSample, add_sample
from warpgi.kernels.interleaving import Interleaving, add_shared, subset_of
from warpgi.kernels.path import CAMERA_PAIRS, MAX_SURVIVAL, VERTEX_PAIRS, add_light, inverse_distance, pixel_ray
from warpgi.kernels.rng import Sampler, make_sampler, sample_2d
from warpgi.kernels.scene import DIELECTRIC, Scene, closest_hit, offset_origin, surface_at
from warpgi.kernels.vpls import COMPENSATED, Joining, Vpls, geometry_kept, reflect_vpls

wp.set_module_options({"enable_backward": False})

# Segments after which roulette may end a path.
ROULETTE_DEPTH = wp.constant(5)


@wp.struct
class View:
    """How camera paths are followed."""

    seed: int
    sampler: int  # INDEPENDENT or SOBOL
    light_samples: int  # shadow rays to lights from the first surface that scatters
    goes_on: int  # 1: a ray from a surface of wide lobes could meet light that nothing else brings


@wp.func
def follow(
    scene: Scene,
    vpls: Vpls,
    joining: Joining,
    view: View,
    first: int,
    stride: int,
    pixel: int,
    index: int,
    sampler: Sampler,
    o_: wp.vec3,
    d_: wp.vec3,
):
    """One camera path: lights bring what wide lobes at both ends send on, geometry clamped; a ray goes for the rest.

    A path that meets a diffuse surface first takes every `stride`-th light from `first` on, others all.

    Radiance that leaves a surface by its wide lobes reaches the camera with weight `joined`, from which is taken off
    what lights brought at the surface before; other radiance with weight `rest`.
    """
    o = o_
    d = d_
    path = PathSample()
    path.depth = -1.0
    by_lights = wp.vec3(0.0)  # weight of light along d whose wide part lights bring, but for what is clamped
    rest = wp.vec3(1.0)  # of all light along d, in the end
    cos_before = float(0.0)
    eta_scale = float(1.0)
    bsdf_pdf = float(0.0)
    scattered = int(0)
    depth = int(1)
    while True:
        hit = closest_hit(scene, o, d)
        path.closest_hit_rays = path.closest_hit_rays + 1
        if hit.face < 0:
            path = add_light(path, depth, wp.cw_mul(rest, scene.environment))
            break
        shape = scene.shapes[scene.face_shapes[hit.face]]
        s = surface_at(scene, hit, shape)
        wo = -d
        if depth == 1:
            path = add_features(path, s, wo, hit.t)
            path.bandwidth = bandwidth(shape)
        elif depth == 2:
            path.inverse_distance = inverse_distance(hit.t)
        le = emitted(shape, s.ng, wo)
        if wp.max(le) > 0.0:
            path = add_light(path, depth, wp.cw_mul(rest, le) * emission_weight(shape, s.ng, d, hit.t, bsdf_pdf))

        # bias compensation: the share of the geometry term that the lights do not bring
        kept = float(1.0)
        if joining.near == COMPENSATED:
            kept = geometry_kept(joining, cos_before * wp.abs(wp.dot(s.ng, d)) / (hit.t * hit.t))
        joined = rest - by_lights * kept
        if is_wide(shape, joining.sharpest) and wp.max(joined) <= 1.0e-6 * wp.max(rest):
            break  # all that it reflects was there already

        n = s.n
        if shape.kind != DIELECTRIC:
            n = facing_normal(s, wo)
        pair = CAMERA_PAIRS + VERTEX_PAIRS * (depth - 1)
        extra = sample_2d(sampler, pair + 2)
        light_part = float(1.0)
        if not is_delta(shape.kind):
            # direct light
            light_samples = wp.where(scattered == 0, view.light_samples, 1)
            light_part = 1.0 / float(light_samples)
            if scene.light_count > 0:
                for j in range(light_samples):
                    light_sampler = sampler
                    if light_samples > 1:
                        light_sampler = make_sampler(view.seed, pixel, index * light_samples + j, view.sampler)
                    choice = sample_2d(light_sampler, pair + 2)[0]
                    u = sample_2d(light_sampler, pair)
                    light = direct_light(scene, shape, s, n, wo, u, choice, light_part)
                    path.shadow_rays = path.shadow_rays + light.shadow_rays
                    share = wide_share(shape, s.albedo, n, wo, light.wi, joining.sharpest)
                    weight = (rest + wp.cw_mul(joined - rest, share)) * light_part
                    path = add_light(path, depth + 1, wp.cw_mul(weight, light.radiance))
            # virtual lights
            if has_wide_lobe(shape, joining.sharpest):
                begin = wp.where(path.bandwidth == 0.0, first, 0)
                step = wp.where(path.bandwidth == 0.0, stride, 1)
                found = reflect_vpls(scene, vpls, joining, shape, s, n, wo, begin, step, sampler)
                path.shadow_rays = path.shadow_rays + found.shadow_rays
                path = add_light(path, depth + 2, wp.cw_mul(joined, found.radiance))
            scattered = 1
        if view.goes_on == 0 and is_wide(shape, joining.sharpest):
            break

        # the ray
        b = sample(shape, s.albedo, n, wo, sample_2d(sampler, pair + 1))
        if wp.max(b.weight) <= 0.0 or (b.transmitted == 0 and not reflects(s, wo, b.wi)):
            break
        share = wide_share(shape, s.albedo, n, wo, b.wi, joining.sharpest)
        by_lights = wp.cw_mul(wp.cw_mul(joined, share), b.weight)
        rest = wp.cw_mul(wp.cw_mul(rest, wp.vec3(1.0) - share), b.weight) + by_lights
        bsdf_pdf = b.pdf * light_part
        cos_before = wp.abs(wp.dot(n, b.wi))
        eta_scale = eta_scale * b.eta * b.eta
        if depth >= ROULETTE_DEPTH:
            survival = wp.min(MAX_SURVIVAL, wp.max(rest) * eta_scale)
            if extra[1] >= survival:
                break
            by_lights = by_lights / survival
            rest = rest / survival
        o = offset_origin(s.p, s.ng, s.offset, b.wi)
        d = b.wi
        depth = depth + 1
        path.has_ray = 1
    return path


@wp.kernel
def light_pixels(
    offset: int,
    scene: Scene,
    camera: Camera,
    vpls: Vpls,
    joining: Joining,
    view: View,
    interleaving: Interleaving,
    first_sample: int,
    sample_count: int,
    film: Film,
):
    """One thread owns one pixel: `sample_count` camera paths from `first_sample` on, folded into `film`."""
    i = offset + wp.tid()
    pixel = film.first_pixel + i
    stride = interleaving.side * interleaving.side
    for index in range(first_sample, first_sample + sample_count):
        sampler = make_sampler(view.seed, pixel, index, view.sampler)
        ray = pixel_ray(camera, sampler, pixel)
        first = subset_of(interleaving, pixel, index)
        path = follow(scene, vpls, joining, view, first, stride, pixel, index, sampler, ray.o, ray.d)
        if stride > 1:
            add_shared(interleaving, film, i, pixel, path)
        else:
            add_sample(film, i, path)
