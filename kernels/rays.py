"""Rays for their own sake: made, traced and written out, to be counted and compared.

The functions that make them are the path tracer's own, so that what is measured is what a path does.
"""

import warp as wp

from warpgi.kernels.camera import Camera, camera_ray
from warpgi.kernels.direct import SHADOW_SHORTER
from warpgi.kernels.lights import sample_light
from warpgi.kernels.rng import INDEPENDENT, Sampler, make_sampler, sample_2d
from warpgi.kernels.sampling import make_frame, square_to_cosine_hemisphere, square_to_triangle, to_world
from warpgi.kernels.scene import FAR, Hit, Scene, closest_hit, occluded, offset_origin, surface_at

wp.set_module_options({"enable_backward": False})


@wp.struct
class Hits:
    t: wp.array[float]
    u: wp.array[float]  # barycentric, of the triangle's first and second corner
    v: wp.array[float]
    face: wp.array[int]  # -1: none


@wp.func
def point_on(scene: Scene, face: int, sampler: Sampler):
    """A uniform point of a triangle."""
    bary = square_to_triangle(sample_2d(sampler, 0))
    h = Hit()
    h.face = face
    h.u = bary[0]
    h.v = bary[1]
    return surface_at(scene, h, scene.shapes[scene.face_shapes[face]])


@wp.kernel
def make_secondary_rays(
    offset: int,
    scene: Scene,
    seed: int,
    faces: wp.array[int],
    origins: wp.array[wp.vec3],
    directions: wp.array[wp.vec3],
):
    """Ray i leaves a uniform point of triangle `faces[i]` on its normal's side, with pdf cos / pi."""
    i = offset + wp.tid()
    sampler = make_sampler(seed, i, 0, INDEPENDENT)
    s = point_on(scene, faces[i], sampler)
    d = to_world(make_frame(s.ng), square_to_cosine_hemisphere(sample_2d(sampler, 1)))
    origins[i] = offset_origin(s.p, s.ng, s.offset, d)
    directions[i] = d


@wp.kernel
def make_shadow_rays(
    offset: int,
    scene: Scene,
    seed: int,
    faces: wp.array[int],
    origins: wp.array[wp.vec3],
    directions: wp.array[wp.vec3],
    distances: wp.array[float],
):
    """Ray i goes from a uniform point of triangle `faces[i]` to a light; distance -1 where none would be sent."""
    i = offset + wp.tid()
    sampler = make_sampler(seed, i, 0, INDEPENDENT)
    s = point_on(scene, faces[i], sampler)
    light = sample_light(scene, s.p, sample_2d(sampler, 1), sample_2d(sampler, 2)[0])
    distances[i] = -1.0
    if light.weight[0] + light.weight[1] + light.weight[2] <= 0.0 or wp.dot(s.ng, light.wi) <= 0.0:
        return
    o = offset_origin(s.p, s.ng, s.offset, light.wi)
    d = light.wi
    distance = float(FAR)
    if light.distant == 0:
        d = light.target - o
        distance = wp.length(d)
        d = d / distance
    origins[i] = o
    directions[i] = d
    distances[i] = distance * SHADOW_SHORTER


@wp.kernel
def make_camera_rays(
    offset: int,
    camera: Camera,
    seed: int,
    rays_per_pixel: int,
    origins: wp.array[wp.vec3],
    directions: wp.array[wp.vec3],
):
    """Rays in the order of the pixels, those of a pixel one after the other."""
    i = offset + wp.tid()
    pixel = i // rays_per_pixel
    sampler = make_sampler(seed, pixel, i % rays_per_pixel, INDEPENDENT)
    u = sample_2d(sampler, 0)
    x = float(pixel % camera.width) + u[0]
    y = float(pixel // camera.width) + u[1]
    ray = camera_ray(camera, x, y, sample_2d(sampler, 1))
    origins[i] = ray.o
    directions[i] = ray.d


@wp.kernel
def trace_closest_hits(
    offset: int,
    scene: Scene,
    origins: wp.array[wp.vec3],
    directions: wp.array[wp.vec3],
    hits: Hits,
):
    """The nearest triangle along each ray."""
    i = offset + wp.tid()
    h = closest_hit(scene, origins[i], directions[i])
    hits.t[i] = h.t
    hits.u[i] = h.u
    hits.v[i] = h.v
    hits.face[i] = h.face


@wp.kernel
def trace_mesh(
    offset: int,
    mesh: wp.uint64,
    origins: wp.array[wp.vec3],
    directions: wp.array[wp.vec3],
    hits: Hits,
):
    """The same by `wp.mesh_query_ray`, the yardstick."""
    i = offset + wp.tid()
    query = wp.mesh_query_ray(mesh, origins[i], directions[i], FAR)
    hits.t[i] = query.t
    hits.u[i] = query.u
    hits.v[i] = query.v
    hits.face[i] = wp.where(query.result, query.face, -1)


@wp.kernel
def trace_shadow_rays(
    offset: int,
    scene: Scene,
    origins: wp.array[wp.vec3],
    directions: wp.array[wp.vec3],
    distances: wp.array[float],
    blocked: wp.array[int],
):
    """1 where something stands before the end of the ray."""
    i = offset + wp.tid()
    blocked[i] = wp.where(occluded(scene, origins[i], directions[i], distances[i]), 1, 0)
