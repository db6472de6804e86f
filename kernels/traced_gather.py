"""Gathering over rays that the scene stops and splats light: exact visibility, and the light field where it is met."""

import warp as wp

from warpgi.kernels.hemisphere import Hemispheres, stratum_direction
from warpgi.kernels.lanes import POINT_WALK
from warpgi.kernels.light_field import GATHER_PAIR, Gathered, Incident, Receivers
from warpgi.kernels.rng import SOBOL, make_sampler, sample_2d
from warpgi.kernels.sampling import make_frame, square_to_cosine_hemisphere, to_world
from warpgi.kernels.scene import FAR, Scene, closest_hit, offset_origin
from warpgi.kernels.splats import SplatTree, nearest_facing, splat_radiance

wp.set_module_options({"enable_backward": False})

# Radiance times weight of the splats that cover x, on a surface with normal n, and the weight: a tent, as for
# reconstruction rays. Splats turned by more than 45 degrees, or whose plane is far, are of another surface. The tree's
# boxes are those of balls.
COVERING = (
    "    float r = 0.0f, g = 0.0f, b = 0.0f, weight = 0.0f;\n"
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
            }
        }
    }
    return wp::vec_t<4, wp::float32>(r, g, b, weight);
"""
)


@wp.func_native(COVERING)
def covering_splats(tree: SplatTree, x: wp.vec3, n: wp.vec3, noise: float) -> wp.vec4: ...


@wp.func
def traced(scene: Scene, tree: SplatTree, p: wp.vec3, n: wp.vec3, d: wp.vec3, step: float, noise: float):
    """What a ray from a surface finds: light of splats where the scene stops it."""
    result = Incident()
    o = offset_origin(p, n, step, d)
    hit = closest_hit(scene, o, d)
    if hit.face < 0:
        # what the environment sends is direct light
        result.distance = FAR
        result.counts[1] = 1
        return result
    x = o + d * hit.t
    ng = scene.face_normals[hit.face]
    result.distance = hit.t
    found = covering_splats(tree, x, wp.where(wp.dot(ng, d) < 0.0, ng, -ng), noise)
    if found[3] > 0.0:
        result.radiance = wp.vec3(found[0], found[1], found[2]) / found[3]
        return result
    result.counts[3] = 1
    nearest = nearest_facing(tree, x, d)
    if nearest >= 0:
        result.radiance = splat_radiance(tree, nearest)
    return result


@wp.kernel
def trace_splat_strata(
    offset: int,
    scene: Scene,
    tree: SplatTree,
    hemispheres: Hemispheres,
    seed: int,
    step: float,
    noise: float,
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
        found = traced(scene, tree, hemispheres.points[i], n, d, step, noise)
        strata[i * size + k] = wp.vec4(found.radiance[0], found.radiance[1], found.radiance[2], found.distance)
        total = total + found.counts
    counts[i] = total


@wp.kernel
def gather_traced(
    offset: int,
    scene: Scene,
    tree: SplatTree,
    receivers: Receivers,
    rays_each: int,
    first_ray: int,
    ray_count: int,
    seed: int,
    step: float,
    noise: float,
    gathered: Gathered,
):
    """One thread owns a receiver and sends `ray_count` of its `rays_each` cosine-distributed rays."""
    i = offset + wp.tid()
    j = receivers.sample[i]
    n = receivers.normals[j]
    frame = make_frame(n)
    total = gathered.radiance[i]
    counts = gathered.counts[i]
    for ray in range(first_ray, first_ray + ray_count):
        # one sequence a pixel, cut into the shares of its samples
        sampler = make_sampler(seed, j // receivers.spp, (j % receivers.spp) * rays_each + ray, SOBOL)
        d = to_world(frame, square_to_cosine_hemisphere(sample_2d(sampler, GATHER_PAIR)))
        found = traced(scene, tree, receivers.origins[j], n, d, step, noise)
        total = total + found.radiance
        counts = counts + found.counts
    gathered.radiance[i] = total
    gathered.counts[i] = counts
