"""Light-field reconstruction (Lehtinen et al. 2012): sizing, shrinking and reconstruction rays."""

import warp as wp

from warpgi.kernels.film import Film
from warpgi.kernels.hemisphere import Hemispheres, stratum_direction
from warpgi.kernels.rng import SOBOL, SOBOL_PAIRS, make_sampler, sample_2d
from warpgi.kernels.sampling import PI, make_frame, square_to_cosine_hemisphere, to_world
from warpgi.kernels.splats import (
    SplatTree,
    first_surface,
    nearest_facing,
    shrink_crossed,
    splat_radiance,
)

wp.set_module_options({"enable_backward": False})

FAR = wp.constant(1.0e30)  # beyond any scene

# Of the random numbers: none that places a primary hit or aims an input ray, or rays would follow hits.
GATHER_PAIR = wp.constant(SOBOL_PAIRS - 1)


@wp.struct
class Rays:
    """Input rays of the splats, in the samples' own order."""

    origins: wp.array[wp.vec3]
    hits: wp.array[wp.vec3]
    order: wp.array[int]  # place in the tree -> sample


@wp.struct
class Sky:
    """What input rays saw that left the scene, by direction, on an octahedral map."""

    size: int  # 0: none did
    radiance: wp.array[wp.vec3]


@wp.func
def octahedral(d: wp.vec3):
    """Unit square coordinates of a direction (Meyer et al. 2010)."""
    s = wp.abs(d[0]) + wp.abs(d[1]) + wp.abs(d[2])
    u = d[0] / s
    v = d[1] / s
    if d[2] < 0.0:
        w = (1.0 - wp.abs(v)) * wp.where(u >= 0.0, 1.0, -1.0)
        v = (1.0 - wp.abs(u)) * wp.where(v >= 0.0, 1.0, -1.0)
        u = w
    return wp.vec2(0.5 * u + 0.5, 0.5 * v + 0.5)


@wp.func
def sky_radiance(sky: Sky, d: wp.vec3):
    uv = octahedral(d)
    x = wp.min(int(uv[0] * float(sky.size)), sky.size - 1)
    y = wp.min(int(uv[1] * float(sky.size)), sky.size - 1)
    return sky.radiance[y * sky.size + x]


@wp.kernel
def size_lone_splats(offset: int, rays: Rays, radius2: wp.array[float]):
    """One thread sizes one splat that has no neighbour: something of the size of what it was seen from."""
    i = offset + wp.tid()
    if radius2[i] < 0.0:
        half = 0.5 * wp.length(rays.hits[rays.order[i]] - rays.origins[rays.order[i]])
        radius2[i] = half * half


@wp.func
def retrace(tree: SplatTree, rays: Rays, i: int, slot: int, radius2: wp.array[float], margin: float, noise: float):
    j = rays.order[i]
    o = rays.origins[j]
    d = rays.hits[j] - o
    length = wp.length(d)
    end = wp.max(margin * length, noise)
    if length <= 2.0 * end:
        return 0
    return shrink_crossed(tree, o, d / length, length, end, i, slot, radius2)


@wp.kernel
def shrink_splats(
    offset: int,
    slot: int,
    tree: SplatTree,
    rays: Rays,
    margin: float,
    noise: float,
    first: int,
    step: int,
    radius2: wp.array[float],
):
    """One thread retraces one input ray and shrinks, in its slot, the splats that it crosses before its end."""
    retrace(tree, rays, first + (offset + wp.tid()) * step, slot, radius2, margin, noise)


@wp.kernel
def shrink_by_escaped(
    offset: int, slot: int, tree: SplatTree, rays: Rays, escaped: wp.array[int], margin: float, radius2: wp.array[float]
):
    """One thread retraces one input ray that left the scene and shrinks what it crosses."""
    j = escaped[offset + wp.tid()]
    o = rays.origins[j]
    d = wp.normalize((rays.hits[j] - o) * 1.0e-11)  # the squares of its coordinates may be beyond float32
    shrink_crossed(tree, o, d, 0.1 * FAR, margin, -1, slot, radius2)


@wp.kernel
def count_crossed(
    offset: int, tree: SplatTree, rays: Rays, margin: float, noise: float, none: wp.array[float], crossed: wp.array[int]
):
    """One thread counts the splats that one input ray crosses before its end."""
    i = offset + wp.tid()
    crossed[i] = retrace(tree, rays, i, -1, none, margin, noise)


@wp.struct
class Receivers:
    """Where light is gathered."""

    sample: wp.array[int]  # number of the sample whose origin it is
    origins: wp.array[wp.vec3]
    normals: wp.array[wp.vec3]
    spp: int  # samples of a pixel, which are neighbours; 0: `pixels` and `places` say which is which
    pixels: wp.array[int]
    places: wp.array[int]  # number of a sample in its pixel


@wp.struct
class Gathered:
    """Sums over the rays of each receiver so far."""

    radiance: wp.array[wp.vec3]
    near: wp.array[float]  # rays that met a surface within reach
    inverse_distance: wp.array[float]  # one over the length of each ray, 0 to the sky; empty where nobody asked
    counts: wp.array[wp.vec4i]  # rays without support, to the sky, cut short; undersampled surfaces passed through


@wp.struct
class Incident:
    """What one reconstruction ray finds."""

    radiance: wp.vec3
    distance: float  # of the surface, FAR: the sky, below 0: nothing is known there
    near: float  # share of the surface within reach
    counts: wp.vec4i  # as in Gathered


@wp.func
def incident(
    tree: SplatTree,
    sky: Sky,
    o: wp.vec3,
    d: wp.vec3,
    noise: float,
    reach: float,
    keep_one: float,
    keep_two: float,
):
    result = Incident()
    s = first_surface(tree, o, d, noise, reach, keep_one, keep_two)
    splat = int(-1)
    if s[8] > 0.0:
        splat = nearest_facing(tree, o + s[8] * d, d)
    if splat >= 0:
        # what faces away belongs to the other side of something thin, whose light may be quite another
        result.radiance = splat_radiance(tree, splat)
    elif s[3] > 0.0:
        result.radiance = wp.vec3(s[0], s[1], s[2]) / s[3]
    elif sky.size > 0:
        result.radiance = sky_radiance(sky, d)
        result.counts[1] = 1
    else:
        result.counts[0] = 1
    if splat >= 0 or s[3] > 0.0:
        result.distance = s[9] / s[3]
        result.near = s[4] / s[3]
    else:
        result.distance = wp.where(sky.size > 0, FAR, -1.0)
    result.counts[2] = int(s[6])
    result.counts[3] = int(s[7])
    return result


@wp.kernel
def reconstruct(
    offset: int,
    tree: SplatTree,
    sky: Sky,
    receivers: Receivers,
    rays_each: int,
    first_ray: int,
    ray_count: int,
    seed: int,
    noise: float,
    reach: float,
    keep_one: float,
    keep_two: float,
    gathered: Gathered,
):
    """One thread owns a receiver and sends `ray_count` of its `rays_each` cosine-distributed reconstruction rays."""
    i = offset + wp.tid()
    j = receivers.sample[i]
    o = receivers.origins[j]
    frame = make_frame(receivers.normals[j])
    pixel = int(0)
    place = int(0)
    if receivers.spp > 0:
        pixel = j // receivers.spp
        place = j % receivers.spp
    else:
        pixel = receivers.pixels[j]
        place = receivers.places[j]
    total = gathered.radiance[i]
    near = gathered.near[i]
    inverse = float(0.0)
    counts = gathered.counts[i]
    for ray in range(first_ray, first_ray + ray_count):
        # one sequence a pixel, cut into the shares of its samples
        sampler = make_sampler(seed, pixel, place * rays_each + ray, SOBOL)
        d = to_world(frame, square_to_cosine_hemisphere(sample_2d(sampler, GATHER_PAIR)))
        found = incident(tree, sky, o, d, noise, reach, keep_one, keep_two)
        total = total + found.radiance
        near = near + found.near
        counts = counts + found.counts
        if found.distance > 0.0 and found.distance < FAR:
            inverse = inverse + 1.0 / found.distance
    gathered.radiance[i] = total
    gathered.near[i] = near
    if gathered.inverse_distance.shape[0] > 0:
        gathered.inverse_distance[i] = gathered.inverse_distance[i] + inverse
    gathered.counts[i] = counts


@wp.kernel
def reconstruct_strata(
    offset: int,
    tree: SplatTree,
    sky: Sky,
    hemispheres: Hemispheres,
    seed: int,
    noise: float,
    keep_one: float,
    keep_two: float,
    strata: wp.array[wp.vec4],
    counts: wp.array[wp.vec4i],
):
    """One thread owns a point and fills the strata of its hemisphere by reconstruction rays: radiance and distance."""
    i = offset + wp.tid()
    frame = make_frame(hemispheres.normals[i])
    size = hemispheres.rings * hemispheres.sectors
    total = wp.vec4i(0)
    for k in range(size):
        d = to_world(frame, stratum_direction(hemispheres, i, k, seed))
        found = incident(tree, sky, hemispheres.points[i], d, noise, FAR, keep_one, keep_two)
        strata[i * size + k] = wp.vec4(found.radiance[0], found.radiance[1], found.radiance[2], found.distance)
        total = total + found.counts
    counts[i] = total


@wp.func
def mean_radiance(gathered: Gathered, i: int, ray_count: int):
    """Mean over the rays that found support or the sky."""
    return gathered.radiance[i] / float(wp.max(ray_count - gathered.counts[i][0], 1))


@wp.kernel
def gathered_irradiance(offset: int, gathered: Gathered, ray_count: int, irradiance: wp.array[wp.vec3]):
    """One thread writes one receiver's irradiance: pi times the mean, as rays follow the cosine."""
    i = offset + wp.tid()
    irradiance[i] = mean_radiance(gathered, i, ray_count) * PI


@wp.kernel
def relight_splats(
    offset: int,
    receivers: Receivers,
    gathered: Gathered,
    ray_count: int,
    hit_direct: wp.array[wp.vec3],
    throughput: wp.array[wp.vec3],
    radiance: wp.array[wp.vec3],
):
    """One thread replaces one sample's radiance by its direct light and what was reconstructed (section 4)."""
    i = offset + wp.tid()
    j = receivers.sample[i]
    radiance[j] = hit_direct[j] + wp.cw_mul(throughput[j], mean_radiance(gathered, i, ray_count))


@wp.kernel
def reflect(
    offset: int,
    receivers: Receivers,
    gathered: Gathered,
    ray_count: int,
    albedo: wp.array[wp.vec3],
    reflected: wp.array[wp.vec3],
):
    """One thread writes the radiance that one receiver reflects: albedo times the mean, as rays follow the cosine."""
    i = offset + wp.tid()
    j = receivers.sample[i]
    reflected[j] = wp.cw_mul(albedo[j], mean_radiance(gathered, i, ray_count))


@wp.kernel
def add_reflected(offset: int, film: Film, reflected: wp.array[wp.vec3], spp: int):
    """One thread owns one pixel of the band and adds the mean of its samples to the film's indirect light."""
    i = offset + wp.tid()
    total = wp.vec3(0.0)
    for k in range(spp):
        total = total + reflected[(film.first_pixel + i) * spp + k]
    film.indirect[i] = film.indirect[i] + total / float(spp)
