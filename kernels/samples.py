"""The input of light-field reconstruction: secondary rays from the path tracer (Lehtinen et al. 2012, section 2.1)."""

import warp as wp

from warpgi.kernels.bsdf import sample
from warpgi.kernels.camera import Camera
from warpgi.kernels.direct import add_features, direct_light, emitted, facing_normal, reflects
from warpgi.kernels.film import Film, PathSample, add_sample
from warpgi.kernels.path import (
    CAMERA_PAIRS,
    VERTEX_PAIRS,
    PathSettings,
    add_light,
    inverse_distance,
    pixel_ray,
    trace_path,
)
from warpgi.kernels.rng import make_sampler, sample_2d
from warpgi.kernels.scene import (
    DIELECTRIC,
    DIFFUSE,
    FAR,
    MIRROR,
    Scene,
    closest_hit,
    occluded,
    offset_origin,
    surface_at,
)

wp.set_module_options({"enable_backward": False})

NO_HIT = wp.constant(1.0e11)  # coordinates from 1e10 on say that a ray met nothing

# Mirrors and glass before the first surface that scatters light; a longer chain is left dark.
MAX_CHAIN = wp.constant(16)


@wp.struct
class SampleArrays:
    first_pixel: int  # of the band
    hits: int  # primary hits of a pixel
    spp: int  # how many of them send a secondary ray, the first ones
    origin: wp.array[wp.vec3]  # primary hit, or NO_HIT
    origin_normal: wp.array[wp.vec3]
    albedo: wp.array[wp.vec3]  # of the primary hit, times what mirrors before it left
    hit: wp.array[wp.vec3]  # of the secondary ray, or its direction times NO_HIT
    hit_normal: wp.array[wp.vec3]
    radiance: wp.array[wp.vec3]  # along the secondary ray, without emission
    throughput: wp.array[wp.vec3]  # albedo at the secondary hit; empty where nobody asked
    hit_direct: wp.array[wp.vec3]  # its direct light; empty likewise


@wp.kernel
def trace_samples(
    offset: int,
    scene: Scene,
    camera: Camera,
    settings: PathSettings,
    light_samples: int,
    film: Film,
    samples: SampleArrays,
):
    """One thread owns one pixel: traces its paths, puts what reconstruction leaves alone into `film`, the rest into
    `samples`. Surfaces that are not diffuse keep their path-traced light.

    `light_samples` shadow rays go out from each primary hit, for the noise of direct light stays in the picture.
    """
    i = offset + wp.tid()
    light_share = 1.0 / float(wp.max(light_samples, 1))
    pixel = film.first_pixel + i
    for index in range(samples.hits):
        place = (samples.first_pixel + i) * samples.hits + index
        k = (samples.first_pixel + i) * samples.spp + index
        samples.origin[place] = wp.vec3(NO_HIT)
        if index < samples.spp:
            samples.hit[k] = wp.vec3(NO_HIT)
        sampler = make_sampler(settings.seed, pixel, index, settings.sampler)
        ray = pixel_ray(camera, sampler, pixel)
        path = PathSample()
        path.depth = -1.0
        throughput = wp.vec3(1.0)
        o = ray.o
        d = ray.d
        depth = int(1)
        going = int(1)
        while going == 1:
            hit = closest_hit(scene, o, d)
            path.closest_hit_rays = path.closest_hit_rays + 1
            if hit.face < 0:
                path = add_light(path, depth, wp.cw_mul(throughput, scene.environment))
                break
            shape = scene.shapes[scene.face_shapes[hit.face]]
            s = surface_at(scene, hit, shape)
            wo = -d
            if depth == 1:
                path = add_features(path, s, wo, hit.t)
            elif depth == 2:
                path.inverse_distance = inverse_distance(hit.t)
            path = add_light(path, depth, wp.cw_mul(throughput, emitted(shape, s.ng, wo)))
            if depth >= settings.max_depth or depth > MAX_CHAIN:
                break
            n = s.n
            if shape.kind != DIELECTRIC:
                n = facing_normal(s, wo)
            delta = shape.kind == DIELECTRIC or shape.kind == MIRROR

            # light sampling; alone in charge of lamps where no secondary ray looks for them
            has_ray = index < samples.spp or shape.kind != DIFFUSE
            share = wp.where(has_ray, light_share, 0.0)
            if scene.light_count > 0 and not delta:
                for j in range(light_samples):
                    light_sampler = make_sampler(settings.seed, pixel, index * light_samples + j, settings.sampler)
                    light = direct_light(
                        scene,
                        shape,
                        s,
                        n,
                        wo,
                        sample_2d(light_sampler, CAMERA_PAIRS),
                        sample_2d(light_sampler, CAMERA_PAIRS + 2)[0],
                        share,
                    )
                    path.shadow_rays = path.shadow_rays + light.shadow_rays
                    path = add_light(path, depth + 1, wp.cw_mul(throughput, light.radiance) * light_share)

            # the secondary ray
            b = sample(shape, s.albedo, n, wo, sample_2d(sampler, CAMERA_PAIRS + VERTEX_PAIRS * (depth - 1) + 1))
            if b.weight[0] + b.weight[1] + b.weight[2] <= 0.0:
                break
            if b.transmitted == 0 and not reflects(s, wo, b.wi):
                break
            o = offset_origin(s.p, s.ng, s.offset, b.wi)
            d = b.wi
            if delta:
                path.has_ray = 1
                throughput = wp.cw_mul(throughput, b.weight)
                depth = depth + 1
            elif not has_ray:
                going = 0
                samples.origin[place] = s.p
                samples.origin_normal[place] = n
                samples.albedo[place] = wp.cw_mul(throughput, b.weight)
                if wp.max(scene.environment) > 0.0:
                    path.shadow_rays = path.shadow_rays + 1
                    if not occluded(scene, o, d, FAR):
                        path = add_light(path, depth + 1, wp.cw_mul(samples.albedo[place], scene.environment))
            else:
                going = 0
                rest = settings
                rest.max_depth = settings.max_depth - depth
                gathered = trace_path(
                    scene, rest, sampler, CAMERA_PAIRS + VERTEX_PAIRS * depth, o, d, b.pdf * light_share
                )
                path.has_ray = 1
                if depth == 1 and gathered.depth >= 0.0:
                    path.inverse_distance = inverse_distance(gathered.depth)
                path.closest_hit_rays = path.closest_hit_rays + gathered.closest_hit_rays
                path.shadow_rays = path.shadow_rays + gathered.shadow_rays
                weight = wp.cw_mul(throughput, b.weight)
                path = add_light(path, depth + 1, wp.cw_mul(weight, gathered.emission))
                incident = gathered.direct + gathered.indirect
                if shape.kind == DIFFUSE:
                    samples.origin[place] = s.p
                    samples.origin_normal[place] = n
                    samples.albedo[place] = weight
                    samples.radiance[k] = incident
                    if gathered.depth >= 0.0:
                        samples.hit[k] = gathered.position
                        samples.hit_normal[k] = gathered.normal
                        if samples.throughput.shape[0] > 0:
                            samples.throughput[k] = gathered.albedo
                            samples.hit_direct[k] = gathered.direct
                    else:
                        samples.hit[k] = d * NO_HIT
                else:
                    path = add_light(path, depth + 2, wp.cw_mul(weight, incident))
        add_sample(film, i, path)
