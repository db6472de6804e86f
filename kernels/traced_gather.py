"""Gathering over rays that the scene stops and splats light: exact visibility, and the light field where it is met."""

import warp as wp

from warpgi.kernels.bsdf import sample
from warpgi.kernels.glossy_light_field import Surfaces
from warpgi.kernels.hemisphere import Hemispheres, stratum_direction
from warpgi.kernels.lanes import POINT_WALK
from warpgi.kernels.light_field import GATHER_PAIR, Gathered, Incident, Receivers
from warpgi.kernels.path import PathSettings
from warpgi.kernels.path_strata import incident_light
from warpgi.kernels.rng import SOBOL, make_sampler, sample_2d
from warpgi.kernels.sampling import make_frame, square_to_cosine_hemisphere, to_world
from warpgi.kernels.scene import DIFFUSE, FAR, Scene, closest_hit, offset_origin
from warpgi.kernels.splats import SplatTree

wp.set_module_options({"enable_backward": False})

vec5 = wp.types.vector(length=5, dtype=wp.float32)

# A ray shorter than this part of the radius of the splats at its end ends in detail that they do not resolve, such as a
# crevice or the next leaf.
NEAR = wp.constant(0.5)

# Radiance times weight of the splats that cover x, on a surface with normal n, the weight, and their squared radius
# times it: a tent, as for reconstruction rays. Splats turned by more than 45 degrees, or whose plane is far, are of
# another surface. The tree's boxes are those of balls.
COVERING = (
    "    float r = 0.0f, g = 0.0f, b = 0.0f, weight = 0.0f, square = 0.0f;\n"
    + POINT_WALK
    + """
            float w[8];
            for (int k = 0; k < 8; ++k) {
                const float dx = x[0] - p[k], dy = x[1] - p[8 + k], dz = x[2] - p[16 + k];
                const float nx = p[24 + k], ny = p[32 + k], nz = p[40 + k], r2 = p[48 + k];
                const float d2 = dx * dx + dy * dy + dz * dz;
                const float plane = dx * nx + dy * ny + dz * nz;
                const bool same =
                    (nx * n[0] + ny * n[1] + nz * n[2] > 0.7f) & (plane * plane <= 0.1f * r2 + noise * noise);
                const float tent = 1.0f - wp::sqrt(d2 / larger(r2, 1.0e-30f));
                w[k] = (same & (d2 < r2)) ? tent : 0.0f;
            }
            for (int k = 0; k < 8; ++k) {
                r += w[k] * p[56 + k];
                g += w[k] * p[64 + k];
                b += w[k] * p[72 + k];
                weight += w[k];
                square += w[k] * p[48 + k];
            }
        }
    }
    wp::vec_t<5, wp::float32> result;
    result[0] = r; result[1] = g; result[2] = b; result[3] = weight; result[4] = square;
    return result;
"""
)


@wp.func_native(COVERING)
def covering_splats(tree: SplatTree, x: wp.vec3, n: wp.vec3, noise: float) -> vec5: ...


@wp.struct
class Light:
    """What light rays find where the scene stops them."""

    tree: SplatTree
    paths: PathSettings  # of paths from where splats do not tell
    step: float  # from a surface to where its rays start
    noise: float


@wp.func
def traced(scene: Scene, light: Light, p: wp.vec3, n: wp.vec3, d: wp.vec3, key: int, number: int):
    """What a ray from a surface finds: light of splats where the scene stops it, or of a path where they do not tell.

    `key` and `number` are of the path's random numbers.
    """
    result = Incident()
    o = offset_origin(p, n, light.step, d)
    hit = closest_hit(scene, o, d)
    if hit.face < 0:
        # what the environment sends is direct light
        result.distance = FAR
        result.counts[1] = 1
        return result
    x = o + d * hit.t
    ng = scene.face_normals[hit.face]
    result.distance = hit.t
    found = covering_splats(light.tree, x, wp.where(wp.dot(ng, d) < 0.0, ng, -ng), light.noise)
    if hit.t * hit.t * found[3] > NEAR * NEAR * found[4]:
        result.radiance = wp.vec3(found[0], found[1], found[2]) / found[3]
        return result
    result.counts[3] = 1
    path = incident_light(scene, light.paths, p, n, d, light.step, key, number)
    result.radiance = wp.vec3(path[0], path[1], path[2])
    return result


@wp.kernel
def trace_splat_strata(
    offset: int,
    scene: Scene,
    light: Light,
    hemispheres: Hemispheres,
    seed: int,
    strata: wp.array[wp.vec4],
    counts: wp.array[wp.vec4i],
):
    """One thread owns a point and fills the strata of its hemisphere: radiance and distance."""
    i = offset + wp.tid()
    n = hemispheres.normals[i]
    frame = make_frame(n)
    size = hemispheres.rings * hemispheres.sectors
    total = wp.vec4i(0)
    for k in range(size):
        d = to_world(frame, stratum_direction(hemispheres, i, k, seed))
        found = traced(scene, light, hemispheres.points[i], n, d, hemispheres.keys[i], k)
        strata[i * size + k] = wp.vec4(found.radiance[0], found.radiance[1], found.radiance[2], found.distance)
        total = total + found.counts
    counts[i] = total


@wp.kernel
def gather_traced(
    offset: int,
    scene: Scene,
    light: Light,
    surfaces: Surfaces,
    receivers: Receivers,
    rays_each: int,
    first_ray: int,
    ray_count: int,
    seed: int,
    gathered: Gathered,
):
    """One thread owns a receiver and sends `ray_count` of its `rays_each` rays, drawn by its BSDF."""
    i = offset + wp.tid()
    j = receivers.sample[i]
    n = receivers.normals[j]
    frame = make_frame(n)
    pixel = j // receivers.spp
    total = gathered.radiance[i]
    counts = gathered.counts[i]
    for ray in range(first_ray, first_ray + ray_count):
        # one sequence a pixel, cut into the shares of its samples
        number = (j % receivers.spp) * rays_each + ray
        sampler = make_sampler(seed, pixel, number, SOBOL)
        u = sample_2d(sampler, GATHER_PAIR)
        d = to_world(frame, square_to_cosine_hemisphere(u))
        weight = wp.vec3(1.0)
        if surfaces.material.shape[0] > 0:
            shape = surfaces.records[surfaces.material[j]]
            if shape.kind != DIFFUSE:
                b = sample(shape, surfaces.reflectance[j], n, surfaces.wo[j], u)
                d = b.wi
                weight = b.weight
        if wp.max(weight) <= 0.0:
            continue
        found = traced(scene, light, receivers.origins[j], n, d, pixel, number)
        total = total + wp.cw_mul(weight, found.radiance)
        counts = counts + found.counts
    gathered.radiance[i] = total
    gathered.counts[i] = counts
