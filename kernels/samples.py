"""The input of light-field reconstruction: secondary rays from the path tracer (Lehtinen et al. 2012, section 2.1)."""

import warp as wp

from warpgi.kernels.bsdf import COAT, DELTA_EXPONENT, is_delta, is_wide, sample
from warpgi.kernels.camera import Camera, shutter_time
from warpgi.kernels.direct import add_features, direct_light, emitted, facing_normal, reflects
from warpgi.kernels.film import Film, PathSample, add_sample
from warpgi.kernels.path import (
    CAMERA_PAIRS,
    VERTEX_PAIRS,
    PathSettings,
    add_light,
    inverse_distance,
    pixel_ray,
    shutter_part,
    trace_path,
)
from warpgi.kernels.rng import make_sampler, sample_2d
from warpgi.kernels.sampling import square_to_disc
from warpgi.kernels.scene import (
    COATED,
    DIELECTRIC,
    DIFFUSE,
    FAR,
    MIRROR,
    Hit,
    Scene,
    Surface,
    closest_hit,
    motion_at,
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
    # for scenes with a lens, or in motion; empty for others
    lens: wp.array[wp.vec2]
    time: wp.array[float]  # part of the shutter's interval
    origin_motion: wp.array[wp.vec3]  # while the shutter is open
    hit_motion: wp.array[wp.vec3]
    # where on the surface the primary hit lies; empty where nobody asked
    face: wp.array[int]  # -1: nowhere
    bary: wp.array[wp.vec2]
    # for glossy reconstruction; empty where nobody asked, and then surfaces that are not diffuse are not recorded
    exponent: float  # largest Blinn exponent of those that are
    material: wp.array[int]  # number of the primary hit's shape
    wo: wp.array[wp.vec3]  # from the primary hit towards what sees it
    reflectance: wp.array[wp.vec3]  # its albedo; `albedo` is then what multiplies its BSDF
    layer: wp.array[int]  # that the secondary ray was drawn from, COAT or BASE
    bandwidth: wp.array[float]  # Blinn exponent at the secondary hit
    base_radiance: wp.array[wp.vec3]  # part of the radiance that left the secondary hit by way of a diffuse layer
    weight: wp.array[wp.vec3]  # BSDF times cosine over density of the secondary ray, 1 where diffuse
    # where the scene has mirrors too: the segment after one that the secondary ray met, with all light along it
    mirror: wp.array[wp.vec3]  # what it reflects; 0 where none was met
    beyond_hit: wp.array[wp.vec3]
    beyond_normal: wp.array[wp.vec3]
    beyond_radiance: wp.array[wp.vec3]
    beyond_bandwidth: wp.array[float]
    beyond_base: wp.array[wp.vec3]


@wp.struct
class MirrorMet:
    found: int  # 1: a ray met a mirror first
    p: wp.vec3
    n: wp.vec3
    reflectance: wp.vec3
    distance: float
    o: wp.vec3  # where the ray goes on
    d: wp.vec3


@wp.func
def meet_mirror(scene: Scene, o: wp.vec3, d: wp.vec3):
    """The mirror that a ray meets, if that is what it meets and it reflects all by itself."""
    m = MirrorMet()
    hit = closest_hit(scene, o, d)
    if hit.face >= 0:
        shape = scene.shapes[scene.face_shapes[hit.face]]
        if shape.kind == MIRROR:
            s = surface_at(scene, hit, shape)
            m.n = facing_normal(s, -d)
            m.d = d - m.n * (2.0 * wp.dot(d, m.n))
            if reflects(s, -d, m.d) and wp.max(emitted(shape, s.ng, -d)) <= 0.0:
                m.found = 1
                m.p = s.p
                m.reflectance = s.albedo
                m.distance = hit.t
                m.o = offset_origin(s.p, s.ng, s.offset, m.d)
    return m


@wp.func
def record_receiver(
    samples: SampleArrays,
    scene: Scene,
    camera: Camera,
    hit: Hit,
    s: Surface,
    n: wp.vec3,
    wo: wp.vec3,
    place: int,
    part: float,
    albedo: wp.vec3,
):
    """A primary hit, where light is to be gathered; `albedo` is what multiplies it."""
    samples.origin[place] = s.p
    samples.origin_normal[place] = n
    samples.albedo[place] = albedo
    if samples.face.shape[0] > 0:
        samples.face[place] = hit.face
        samples.bary[place] = wp.vec2(hit.u, hit.v)
    if samples.wo.shape[0] > 0:
        samples.material[place] = scene.face_shapes[hit.face]
        samples.wo[place] = wo
        samples.reflectance[place] = s.albedo
    if scene.moving != 0:
        samples.time[place] = part
        samples.origin_motion[place] = motion_at(scene, hit) * camera.shutter_length


@wp.func
def record_beyond(samples: SampleArrays, k: int, mirror: MirrorMet, gathered: PathSample):
    """The segment after a mirror, as a secondary ray's own would be; lamps at its end shine along it too."""
    samples.mirror[k] = mirror.reflectance
    samples.beyond_radiance[k] = gathered.emission + gathered.direct + gathered.indirect
    samples.beyond_bandwidth[k] = gathered.bandwidth
    samples.beyond_base[k] = gathered.base + gathered.emission
    if gathered.depth >= 0.0:
        samples.beyond_hit[k] = gathered.position
        samples.beyond_normal[k] = gathered.normal
    else:
        samples.beyond_hit[k] = mirror.d * NO_HIT


@wp.func
def seen_in_mirror(mirror: MirrorMet, gathered: PathSample):
    """What a path that met the mirror first has gathered."""
    s = PathSample()
    s.depth = mirror.distance
    s.position = mirror.p
    s.normal = mirror.n
    s.bandwidth = DELTA_EXPONENT
    s.direct = wp.cw_mul(mirror.reflectance, gathered.emission)
    s.indirect = wp.cw_mul(mirror.reflectance, gathered.direct + gathered.indirect)
    s.closest_hit_rays = gathered.closest_hit_rays
    s.shadow_rays = gathered.shadow_rays
    return s


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
    `samples`. Surfaces that are not diffuse keep their path-traced light, but glossy ones only where nobody asked for
    them.

    `light_samples` shadow rays go out from each primary hit, for the noise of direct light stays in the picture.
    """
    i = offset + wp.tid()
    light_share = 1.0 / float(wp.max(light_samples, 1))
    pixel = film.first_pixel + i
    for index in range(samples.hits):
        place = (samples.first_pixel + i) * samples.hits + index
        k = (samples.first_pixel + i) * samples.spp + index
        samples.origin[place] = wp.vec3(NO_HIT)
        if samples.face.shape[0] > 0:
            samples.face[place] = -1
        if index < samples.spp:
            samples.hit[k] = wp.vec3(NO_HIT)
        sampler = make_sampler(settings.seed, pixel, index, settings.sampler)
        ray = pixel_ray(camera, sampler, pixel)
        part = shutter_part(sampler)
        if samples.lens.shape[0] > 0:
            samples.lens[place] = square_to_disc(sample_2d(sampler, 1))
        if scene.moving != 0:
            scene.time = shutter_time(camera, part)
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
            delta = is_delta(shape.kind)
            recorded = shape.kind == DIFFUSE or (samples.wo.shape[0] > 0 and is_wide(shape, samples.exponent))

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

            if recorded and shape.kind != DIFFUSE:
                record_receiver(samples, scene, camera, hit, s, n, wo, place, part, throughput)
                if index < samples.spp:
                    samples.hit[k] = s.p  # a ray of no length, unless one is found below

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
                record_receiver(samples, scene, camera, hit, s, n, wo, place, part, wp.cw_mul(throughput, b.weight))
                if wp.max(scene.environment) > 0.0:
                    path.shadow_rays = path.shadow_rays + 1
                    if not occluded(scene, o, d, FAR):
                        path = add_light(path, depth + 1, wp.cw_mul(samples.albedo[place], scene.environment))
            else:
                going = 0
                rest = settings
                rest.max_depth = settings.max_depth - depth
                if recorded and index >= samples.spp:
                    rest.max_depth = 1  # for the lamps that it meets alone
                pair = CAMERA_PAIRS + VERTEX_PAIRS * depth
                first_pdf = b.pdf * light_share
                mirror = MirrorMet()
                if samples.mirror.shape[0] > 0 and index < samples.spp and rest.max_depth > 1:
                    mirror = meet_mirror(scene, o, d)
                    path.closest_hit_rays = path.closest_hit_rays + 1
                if mirror.found == 1:
                    # the path goes on from there: what is met next sends its light along the next segment
                    rest.max_depth = rest.max_depth - 1
                    pair = pair + VERTEX_PAIRS
                    first_pdf = 0.0
                    o = mirror.o
                    d = mirror.d
                gathered = trace_path(scene, rest, sampler, pair, o, d, first_pdf)
                path.has_ray = 1
                if depth == 1 and mirror.found == 1:
                    path.inverse_distance = inverse_distance(mirror.distance)
                elif depth == 1 and gathered.depth >= 0.0:
                    path.inverse_distance = inverse_distance(gathered.depth)
                if mirror.found == 1:
                    record_beyond(samples, k, mirror, gathered)
                    gathered = seen_in_mirror(mirror, gathered)
                path.closest_hit_rays = path.closest_hit_rays + gathered.closest_hit_rays
                path.shadow_rays = path.shadow_rays + gathered.shadow_rays
                weight = wp.cw_mul(throughput, b.weight)
                path = add_light(path, depth + 1, wp.cw_mul(weight, gathered.emission))
                incident = gathered.direct + gathered.indirect
                if shape.kind == DIFFUSE:
                    record_receiver(samples, scene, camera, hit, s, n, wo, place, part, weight)
                if recorded and index < samples.spp:
                    samples.radiance[k] = incident
                    if scene.moving != 0:
                        samples.hit_motion[k] = gathered.motion * camera.shutter_length
                    if samples.wo.shape[0] > 0:
                        samples.layer[k] = wp.where(shape.kind == DIFFUSE, 0, COAT)
                        if shape.kind == COATED:
                            samples.layer[k] = b.layer
                        samples.bandwidth[k] = gathered.bandwidth
                        samples.base_radiance[k] = gathered.base
                        if samples.weight.shape[0] > 0:
                            samples.weight[k] = wp.where(shape.kind == DIFFUSE, wp.vec3(1.0), b.weight)
                    if gathered.depth >= 0.0:
                        samples.hit[k] = gathered.position
                        samples.hit_normal[k] = gathered.normal
                        if samples.throughput.shape[0] > 0:
                            samples.throughput[k] = gathered.albedo
                            samples.hit_direct[k] = gathered.direct
                    else:
                        samples.hit[k] = d * NO_HIT
                elif not recorded:
                    path = add_light(path, depth + 2, wp.cw_mul(weight, incident))
        add_sample(film, i, path)
