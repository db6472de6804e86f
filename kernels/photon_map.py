"""Photon mapping (Jensen 1996; Knaus, Zwicker 2011): light seen from the camera, read from photon maps."""

import warp as wp

from warpgi.kernels.bsdf import (
    base_entry,
    base_reflectance,
    base_share,
    fresnel_dielectric,
    has_base,
    is_delta,
    sample,
)
from warpgi.kernels.bvh import BLOCK_STRIDE, LANES, RADIUS_ROW
from warpgi.kernels.camera import Camera
from warpgi.kernels.density import GUESS_NEARBY, Density, Lookup, density, nearest_photons, nearest_place, vec8
from warpgi.kernels.direct import add_features, direct_light, emission_weight, emitted, facing_normal, reflects
from warpgi.kernels.film import Film, PathSample, add_sample
from warpgi.kernels.path import CAMERA_PAIRS, VERTEX_PAIRS, add_light, pixel_ray
from warpgi.kernels.rng import SOBOL_PAIRS, Sampler, make_sampler, sample_2d
from warpgi.kernels.sampling import INV_PI, PI, make_frame, square_to_cosine_hemisphere, to_world
from warpgi.kernels.scene import (
    COATED,
    DIELECTRIC,
    DIFFUSE,
    FAR,
    Scene,
    ShapeRecord,
    Surface,
    closest_hit,
    max_abs,
    offset_origin,
    surface_at,
)
from warpgi.kernels.splats import SplatTree

wp.set_module_options({"enable_backward": False})

# Surfaces that are not diffuse before the first that is; a longer chain is left dark.
MAX_CHAIN = wp.constant(16)
# Diffuse surfaces too near for an estimate, one after the other, of a gather ray; the next is taken as it is.
MAX_NEAR = wp.constant(4)
# Coordinates from here on say that a ray met nothing.
MET = wp.constant(1.0e10)
# Pairs of random numbers of gather rays begin here, after the camera path's; each of their vertices takes two.
GATHER_PAIR = wp.constant(CAMERA_PAIRS + VERTEX_PAIRS * MAX_CHAIN)
# Directions from the first surface take the last pair that is stratified.
FIRST_GATHER_PAIR = wp.constant(SOBOL_PAIRS - 1)


@wp.struct
class Maps:
    """What is known of light that came over at least one surface."""

    caustic: SplatTree  # photons L S+ D
    diffuse: SplatTree  # photons of all other indirect light; for gathering of what caustics elsewhere send here
    irradiance: SplatTree  # for gathering: that of all light but caustics at some points, which cover their radius
    places: SplatTree  # the same in boxes of the points alone
    usual2: float  # squared radius of such a point, in the middle
    caustic_look: Lookup
    diffuse_look: Lookup
    reach2: float  # that such a point's squared radius is raised by, where few photons make a radius
    near: float  # hits nearer than so many radii are no good for gathering, squared


@wp.struct
class View:
    """How camera paths are followed."""

    seed: int
    sampler: int
    light_samples: int  # shadow rays from each diffuse hit
    gather: int  # rays of final gathering from each diffuse hit; 0: the map is seen directly


@wp.kernel
def estimate_at(
    offset: int, scene: Scene, photons: SplatTree, look: Lookup, reach2: float, seed: int, points: SplatTree
):
    """One thread writes one block of `points`: the irradiance at its points by `photons`, and how far it reaches."""
    block = offset + wp.tid()
    b = points.blocks
    guess2 = float(0.0)
    for lane in range(LANES):
        k = block * BLOCK_STRIDE + lane
        if b[k + RADIUS_ROW] >= 0.0:
            x = wp.vec3(b[k], b[k + 8], b[k + 16])
            n = wp.vec3(b[k + 24], b[k + 32], b[k + 40])
            found = density(photons, scene, look, x, n, guess2, block * LANES + lane, seed)
            guess2 = found.guess2
            points.blocks[k + RADIUS_ROW] = found.radius2 * reach2
            for axis in range(3):
                points.blocks[k + (7 + axis) * LANES] = found.irradiance[axis]


@wp.kernel
def nearest_of_each(
    offset: int,
    photons: SplatTree,
    points: wp.array[wp.vec3],
    normals: wp.array[wp.vec3],
    k: int,
    stretch: float,
    facing: float,
    found: wp.array[vec8],
):
    """One thread owns eight points that follow each other, and finds the k nearest photons of each."""
    first = 8 * (offset + wp.tid())
    guess2 = float(0.0)
    for i in range(first, wp.min(first + 8, points.shape[0])):
        found[i] = nearest_photons(photons, points[i], normals[i], k, guess2, 1.0e30, 1.0, stretch, facing, 0)
        guess2 = GUESS_NEARBY * found[i][5]


@wp.func
def irradiance_near(maps: Maps, x: wp.vec3, n: wp.vec3):
    """That of the nearest point at which it is known, and whose estimate reaches here (Christensen 1999)."""
    result = Density()
    look = maps.diffuse_look
    place = nearest_place(maps.places, maps.irradiance, maps.usual2, x, n, look.stretch, look.facing)
    if place >= 0:
        k = (place // LANES) * BLOCK_STRIDE + place % LANES
        b = maps.irradiance.blocks
        result.radius2 = b[k + RADIUS_ROW] / maps.reach2
        result.irradiance = wp.vec3(b[k + 56], b[k + 64], b[k + 72])
    return result


@wp.struct
class Incident:
    """Light that came along a gather ray."""

    radiance: wp.vec3  # that a diffuse surface reflected last, but of caustics on it, which few rays would find
    direct: wp.vec3  # of lights that the ray met first, weighted against light sampling
    distance: float  # to the first hit, FAR: none
    closest_hit_rays: int
    shadow_rays: int


@wp.func
def incident_light(
    scene: Scene, maps: Maps, sampler: Sampler, key: int, index: int, o_: wp.vec3, d_: wp.vec3, first_pdf: float
):
    """Light from o along d that is direct or was last reflected by a diffuse surface, over any others in between.

    Where the map's radius reaches back to the ray's origin the map would mix up the two surfaces of a corner: the ray
    goes on from there, with direct light of that point added, and what caustics elsewhere send there. `first_pdf` is
    the density of d where light sampling at o shares what it meets, else 0.
    """
    o = o_
    d = d_
    result = Incident()
    result.distance = FAR
    throughput = wp.vec3(1.0)
    travelled = float(0.0)
    near = int(0)
    pdf = first_pdf
    direct = int(1)  # nothing but a diffuse surface, or the beginning, is behind
    for step in range(MAX_CHAIN):
        hit = closest_hit(scene, o, d)
        result.closest_hit_rays = result.closest_hit_rays + 1
        light = scene.environment
        shape = ShapeRecord()
        s = Surface()
        wo = -d
        if hit.face >= 0:
            shape = scene.shapes[scene.face_shapes[hit.face]]
            s = surface_at(scene, hit, shape)
            light = emitted(shape, s.ng, wo)
            if direct == 1 and wp.max(light) > 0.0:
                light = light * emission_weight(shape, s.ng, d, hit.t, pdf)
        if step == 0:
            result.direct = light
            result.distance = hit.t
        elif direct == 1:
            result.radiance = result.radiance + wp.cw_mul(throughput, light)
        if hit.face < 0:
            break
        travelled = travelled + hit.t
        n = s.n
        if shape.kind != DIELECTRIC:
            n = facing_normal(s, wo)
        pair = GATHER_PAIR + 4 * step
        direct = 0
        read = int(0)
        side = s.ng * wp.sign(wp.dot(s.ng, wo))
        if has_base(shape.kind):
            found = irradiance_near(maps, s.p, side)
            # what coats reflect straight from lights is in the caustics, which is why they are not traced on
            if shape.kind == COATED or near >= MAX_NEAR or travelled * travelled >= maps.near * found.radius2:
                reflectance = wp.cw_mul(throughput, base_reflectance(shape, s.albedo, n, wo))
                result.radiance = result.radiance + wp.cw_mul(reflectance, found.irradiance) * INV_PI
                read = 1
        if shape.kind == DIFFUSE:
            if read == 1:
                break
            near = near + 1
            travelled = 0.0
            direct = 1
            if scene.light_count > 0:
                choice = sample_2d(sampler, pair + 1)[0]
                sampled = direct_light(scene, shape, s, n, wo, sample_2d(sampler, pair), choice, 1.0)
                result.shadow_rays = result.shadow_rays + sampled.shadow_rays
                result.radiance = result.radiance + wp.cw_mul(throughput, sampled.radiance)
            echo = density(maps.diffuse, scene, maps.diffuse_look, s.p, side, 0.0, key, index)
            result.closest_hit_rays = result.closest_hit_rays + echo.rays
            reflected = wp.cw_mul(throughput, wp.cw_mul(s.albedo, echo.irradiance)) * INV_PI
            result.radiance = result.radiance + reflected
        b = sample(shape, s.albedo, n, wo, sample_2d(sampler, pair + 2))
        if wp.max(b.weight) <= 0.0 or (b.transmitted == 0 and not reflects(s, wo, b.wi)):
            break
        throughput = wp.cw_mul(throughput, b.weight)
        if shape.kind == COATED:
            coat = wp.vec3(1.0) - base_share(shape, s.albedo, n, wo, b.wi)
            survival = wp.min(wp.max(wp.cw_mul(coat, b.weight)), 1.0)
            if sample_2d(sampler, pair + 3)[0] >= survival:
                break
            throughput = wp.cw_mul(throughput, coat) / survival
        pdf = b.pdf
        o = offset_origin(s.p, s.ng, s.offset, b.wi)
        d = b.wi
    return result


@wp.func
def gather_direction(seed: int, sampler: int, key: int, index: int, n: wp.vec3):
    return to_world(
        make_frame(n),
        square_to_cosine_hemisphere(sample_2d(make_sampler(seed, key, index, sampler), FIRST_GATHER_PAIR)),
    )


@wp.kernel
def gather_irradiance(
    offset: int,
    scene: Scene,
    maps: Maps,
    view: View,
    points: wp.array[wp.vec3],
    normals: wp.array[wp.vec3],
    irradiance: wp.array[wp.vec3],
    inverse_distance: wp.array[float],
):
    """One thread owns one point, a little off its surface: irradiance of indirect light by gathering, without that
    of caustics here and elsewhere, and the mean of 1 / distance over its rays.
    """
    i = offset + wp.tid()
    total = wp.vec3(0.0)
    inverse = float(0.0)
    for ray in range(view.gather):
        d = gather_direction(view.seed, view.sampler, i, ray, normals[i])
        sampler = make_sampler(view.seed, i, ray, view.sampler)
        light = incident_light(scene, maps, sampler, i, view.seed, points[i], d, 0.0)
        total = total + light.radiance
        inverse = inverse + 1.0 / light.distance
    irradiance[i] = total * (PI / float(view.gather))
    inverse_distance[i] = inverse / float(view.gather)


@wp.kernel
def light_samples(
    offset: int,
    scene: Scene,
    maps: Maps,
    view: View,
    step: float,
    spp: int,
    hits: int,
    origins: wp.array[wp.vec3],
    normals: wp.array[wp.vec3],
    hit: wp.array[wp.vec3],
    radiance: wp.array[wp.vec3],
):
    """One thread owns one secondary ray, which begins at one of the first `spp` of a pixel's `hits` primary hits: its
    radiance by the maps, in place of what a path brought. `step` takes the ray off its surface.
    """
    k = offset + wp.tid()
    pixel = k // spp
    place = pixel * hits + k % spp
    o = origins[place]
    if max_abs(o) >= MET or max_abs(hit[k]) >= MET:
        return
    d = wp.normalize(hit[k] - o)
    sampler = make_sampler(view.seed, pixel, k % spp, view.sampler)
    incident = incident_light(scene, maps, sampler, pixel, k % spp, offset_origin(o, normals[place], step, d), d, 0.0)
    radiance[k] = incident.radiance


@wp.kernel
def caustics_at(
    offset: int,
    scene: Scene,
    maps: Maps,
    origins: wp.array[wp.vec3],
    normals: wp.array[wp.vec3],
    albedo: wp.array[wp.vec3],
    reflected: wp.array[wp.vec3],
):
    """One thread owns one primary hit: the light that it reflects of caustics here and, for gathering, elsewhere."""
    i = offset + wp.tid()
    if max_abs(origins[i]) < MET:
        here = density(maps.caustic, scene, maps.caustic_look, origins[i], normals[i], 0.0, i, 0)
        elsewhere = density(maps.diffuse, scene, maps.diffuse_look, origins[i], normals[i], 0.0, i, 0)
        reflected[i] = wp.cw_mul(albedo[i], here.irradiance + elsewhere.irradiance) * INV_PI


@wp.func
def visible_light(scene: Scene, o: wp.vec3, d: wp.vec3, pdf: float):
    """Light that a ray meets first, weighted against light sampling."""
    hit = closest_hit(scene, o, d)
    if hit.face < 0:
        return scene.environment
    shape = scene.shapes[scene.face_shapes[hit.face]]
    ng = scene.face_normals[hit.face]
    return emitted(shape, ng, -d) * emission_weight(shape, ng, d, hit.t, pdf)


@wp.struct
class Followed:
    """A camera path."""

    path: PathSample
    forked: int  # 1: it met glass first, and followed but one of what it reflects and what is seen through it


@wp.func
def follow(
    scene: Scene,
    maps: Maps,
    view: View,
    pixel: int,
    index: int,
    sampler: Sampler,
    o_: wp.vec3,
    d_: wp.vec3,
    through: int,
):
    """One camera path: over mirrors, glass and metal to a diffuse surface, where light is sampled and maps are read.

    Of glass that it meets first it follows the reflection, or with `through` 1 what is transmitted, by its share of the
    light: drawn by that share a lamp's reflection would be rare bright dots.
    """
    o = o_
    d = d_
    path = PathSample()
    path.depth = -1.0
    throughput = wp.vec3(1.0)
    bsdf_pdf = float(0.0)
    coat = wp.vec3(1.0)  # part of the reflection at the last surface that is not its diffuse layer's
    depth = int(1)
    forked = int(0)
    while True:
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
        le = emitted(shape, s.ng, wo)
        if wp.max(le) > 0.0:
            w = emission_weight(shape, s.ng, d, hit.t, bsdf_pdf)
            path = add_light(path, depth, wp.cw_mul(throughput, le) * w)
        if depth > MAX_CHAIN:
            break
        n = s.n
        if shape.kind != DIELECTRIC:
            n = facing_normal(s, wo)
        pair = CAMERA_PAIRS + VERTEX_PAIRS * (depth - 1)
        extra = sample_2d(sampler, pair + 2)
        part = wp.max(coat)
        if part < 1.0:
            if extra[1] >= part:
                break
            throughput = wp.cw_mul(throughput, coat) / part
            coat = wp.vec3(1.0)

        light_part = float(1.0)
        if has_base(shape.kind):
            # direct light, by lights and by directions (Veach 1997): of a coat by that which the path takes
            rays = int(view.gather)
            searching = float(1.0)
            light_part = 1.0 / float(view.light_samples)
            if shape.kind == DIFFUSE:
                if view.gather == 0 and scene.visible_light != 0:
                    rays = view.light_samples
                searching = float(rays)
            ray_part = 1.0 / float(wp.max(rays, 1))
            if scene.light_count > 0:
                for j in range(view.light_samples):
                    light_sampler = make_sampler(view.seed, pixel, index * view.light_samples + j, view.sampler)
                    u = sample_2d(light_sampler, pair)
                    choice = sample_2d(light_sampler, pair + 2)[0]
                    light = direct_light(scene, shape, s, n, wo, u, choice, searching * light_part)
                    path.shadow_rays = path.shadow_rays + light.shadow_rays
                    path = add_light(path, depth + 1, wp.cw_mul(throughput, light.radiance) * light_part)
            side = s.ng * wp.sign(wp.dot(s.ng, wo))  # discs lie on the real surface
            found = density(maps.caustic, scene, maps.caustic_look, s.p, side, 0.0, pixel, index)
            path.closest_hit_rays = path.closest_hit_rays + found.rays
            irradiance = found.irradiance
            found = density(maps.diffuse, scene, maps.diffuse_look, s.p, side, 0.0, pixel, index)
            path.closest_hit_rays = path.closest_hit_rays + found.rays
            irradiance = irradiance + found.irradiance
            reflectance = wp.cw_mul(throughput, base_reflectance(shape, s.albedo, n, wo))
            for ray in range(rays):
                number = index * rays + ray
                wi = gather_direction(view.seed, view.sampler, pixel, number, n)
                if reflects(s, wo, wi):
                    o = offset_origin(s.p, s.ng, s.offset, wi)
                    ray_pdf = wp.dot(n, wi) * INV_PI * float(rays) * light_part
                    if view.gather > 0:
                        ray_sampler = make_sampler(view.seed, pixel, number, view.sampler)
                        incident = incident_light(scene, maps, ray_sampler, pixel, index, o, wi, ray_pdf)
                        path.closest_hit_rays = path.closest_hit_rays + incident.closest_hit_rays
                        path.shadow_rays = path.shadow_rays + incident.shadow_rays
                        if shape.kind == DIFFUSE:
                            path = add_light(path, depth + 1, wp.cw_mul(reflectance, incident.direct) * ray_part)
                        gathered = incident.radiance * (base_entry(shape, n, wi) * ray_part)
                        path = add_light(path, depth + 2, wp.cw_mul(reflectance, gathered))
                    else:
                        path.closest_hit_rays = path.closest_hit_rays + 1
                        seen = visible_light(scene, o, wi, ray_pdf)
                        path = add_light(path, depth + 1, wp.cw_mul(reflectance, seen) * ray_part)
            path = add_light(path, depth + 2, wp.cw_mul(reflectance, irradiance) * INV_PI)
            if shape.kind == DIFFUSE:
                break
        elif not is_delta(shape.kind) and scene.light_count > 0:
            light = direct_light(scene, shape, s, n, wo, sample_2d(sampler, pair), extra[0], 1.0)
            path.shadow_rays = path.shadow_rays + light.shadow_rays
            path = add_light(path, depth + 1, wp.cw_mul(throughput, light.radiance))

        # on, by what is not diffuse
        drawn = sample_2d(sampler, pair + 1)
        if depth == 1 and shape.kind == DIELECTRIC:
            forked = 1
            cos_o = wp.dot(n, wo)
            reflected = fresnel_dielectric(wp.abs(cos_o), wp.where(cos_o >= 0.0, shape.ior, 1.0 / shape.ior))
            drawn = wp.vec2(float(through), drawn[1])
            throughput = throughput * wp.where(through == 1, 1.0 - reflected, reflected)
        b = sample(shape, s.albedo, n, wo, drawn)
        if wp.max(b.weight) <= 0.0 or (b.transmitted == 0 and not reflects(s, wo, b.wi)):
            break
        throughput = wp.cw_mul(throughput, b.weight)
        coat = wp.vec3(1.0) - base_share(shape, s.albedo, n, wo, b.wi)
        bsdf_pdf = b.pdf * light_part
        o = offset_origin(s.p, s.ng, s.offset, b.wi)
        d = b.wi
        depth = depth + 1
    result = Followed()
    result.path = path
    result.forked = forked
    return result


@wp.kernel
def see(
    offset: int, scene: Scene, camera: Camera, maps: Maps, view: View, first_sample: int, sample_count: int, film: Film
):
    """One thread owns one pixel: `sample_count` camera paths from `first_sample` on, folded into `film`."""
    i = offset + wp.tid()
    pixel = film.first_pixel + i
    for index in range(first_sample, first_sample + sample_count):
        sampler = make_sampler(view.seed, pixel, index, view.sampler)
        ray = pixel_ray(camera, sampler, pixel)
        followed = follow(scene, maps, view, pixel, index, sampler, ray.o, ray.d, 0)
        path = followed.path
        if followed.forked == 1:
            other = follow(scene, maps, view, pixel, index, sampler, ray.o, ray.d, 1).path
            path.direct = path.direct + other.direct
            path.indirect = path.indirect + other.indirect
            path.closest_hit_rays = path.closest_hit_rays + other.closest_hit_rays
            path.shadow_rays = path.shadow_rays + other.shadow_rays
        add_sample(film, i, path)
