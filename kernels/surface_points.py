"""Points fixed to surfaces: a triangle and a place on it, which go where the surface goes (Meyer, Anderson 2006, 3.1).

Distances between points are those of a rest pose, one frame's, so that they stay the same whatever moves or deforms.
"""

import warp as wp

from warpgi.kernels.bsdf import is_delta, is_wide, sample
from warpgi.kernels.camera import Camera
from warpgi.kernels.direct import facing_normal
from warpgi.kernels.lanes import POINT_WALK
from warpgi.kernels.meshless_hierarchy import EDGE_ON
from warpgi.kernels.path import CAMERA_PAIRS, VERTEX_PAIRS, pixel_ray
from warpgi.kernels.poisson_disc import disc_distance2
from warpgi.kernels.rng import SOBOL, make_sampler, sample_2d
from warpgi.kernels.samples import MAX_CHAIN
from warpgi.kernels.scene import DIELECTRIC, Hit, Scene, closest_hit, offset_origin, surface_at, triangle_at
from warpgi.kernels.splats import SplatTree

wp.set_module_options({"enable_backward": False})

# Pixels seen at a glancing angle are long and thin; the root of their area stands for their width, down to this cosine.
GLANCING = wp.constant(0.1)
# Points that a lookup takes at most, those of the largest weights.
MOST = wp.constant(24)


@wp.struct
class Places:
    """What camera rays met, one a ray; positions, normals and widths as in the rest pose."""

    face: wp.array[int]  # -1: nothing that scatters light
    bary: wp.array[wp.vec2]  # of the triangle's first and second corner
    side: wp.array[float]  # 1 on the side of the triangle's normal, else -1
    position: wp.array[wp.vec3]
    normal: wp.array[wp.vec3]
    width: wp.array[float]  # of a pixel


@wp.func
def place(scene: Scene, face: int, bary: wp.vec2):
    h = Hit()
    h.face = face
    h.u = bary[0]
    h.v = bary[1]
    return surface_at(scene, h, scene.shapes[scene.face_shapes[face]])


@wp.func
def triangle_area(scene: Scene, face: int):
    t = triangle_at(scene, face)
    return wp.length(wp.cross(t.b - t.a, t.c - t.a))


@wp.kernel
def trace_places(
    offset: int,
    scene: Scene,
    rest: Scene,
    camera: Camera,
    seed: int,
    per_pixel: int,
    exponent: float,
    places: Places,
):
    """One thread owns one camera ray: the first surface that scatters its light, behind mirrors and glass too, but not
    where its Blinn exponent is above `exponent`."""
    i = offset + wp.tid()
    places.face[i] = -1
    pixel = i // per_pixel
    sampler = make_sampler(seed, pixel, i % per_pixel, SOBOL)
    ray = pixel_ray(camera, sampler, pixel)
    o = ray.o
    d = ray.d
    travelled = float(0.0)
    for depth in range(MAX_CHAIN):
        hit = closest_hit(scene, o, d)
        if hit.face < 0:
            break
        travelled = travelled + hit.t
        shape = scene.shapes[scene.face_shapes[hit.face]]
        s = surface_at(scene, hit, shape)
        if not is_delta(shape.kind):
            if not is_wide(shape, exponent):
                break
            side = wp.where(wp.dot(s.ng, d) < 0.0, 1.0, -1.0)
            bary = wp.vec2(hit.u, hit.v)
            at = place(rest, hit.face, bary)
            cos = wp.max(wp.abs(wp.dot(s.ng, d)), GLANCING)
            width = travelled * 2.0 * camera.tan_y / float(camera.height) / wp.sqrt(cos)
            places.face[i] = hit.face
            places.bary[i] = bary
            places.side[i] = side
            places.position[i] = at.p
            places.normal[i] = at.n * side
            places.width[i] = width * wp.sqrt(triangle_area(rest, hit.face) / triangle_area(scene, hit.face))
            break
        n = s.n
        if shape.kind != DIELECTRIC:
            n = facing_normal(s, -d)
        b = sample(shape, s.albedo, n, -d, sample_2d(sampler, CAMERA_PAIRS + VERTEX_PAIRS * depth + 1))
        if b.weight[0] + b.weight[1] + b.weight[2] <= 0.0:
            break
        o = offset_origin(s.p, s.ng, s.offset, b.wi)
        d = b.wi


@wp.kernel
def place_points(
    offset: int,
    scene: Scene,
    face: wp.array[int],
    bary: wp.array[wp.vec2],
    side: wp.array[float],
    position: wp.array[wp.vec3],
    normal: wp.array[wp.vec3],
):
    """One thread owns one point and writes where it is in a scene, and its normal."""
    i = offset + wp.tid()
    s = place(scene, face[i], bary[i])
    position[i] = s.p
    normal[i] = s.n * side[i]


@wp.kernel
def nearest_points(
    offset: int,
    grid: wp.uint64,
    position: wp.array[wp.vec3],
    normal: wp.array[wp.vec3],
    candidate: wp.array[wp.vec3],
    candidate_normal: wp.array[wp.vec3],
    radius: float,
    cosine: float,
    nearest: wp.array[int],
    distance: wp.array[float],
):
    """One thread owns one candidate: the nearest point that faces its way within a radius, -1: none."""
    i = offset + wp.tid()
    x = candidate[i]
    n = candidate_normal[i]
    best = int(-1)
    least = radius * radius
    for j in wp.hash_grid_query(grid, x, radius):
        if wp.dot(n, normal[j]) > cosine:
            d2 = disc_distance2(x - position[j], n, normal[j])
            # of two as near the first, whatever the order of the walk
            if d2 < least or (d2 == least and (best < 0 or j < best)):
                least = d2
                best = j
    nearest[i] = best
    distance[i] = wp.sqrt(least)


# Points whose discs hold x, of one shape, with the weights of the meshless basis; the largest where there are too many.
FIND = (
    "    int found = 0;\n    float sum = 0.0f;\n"
    + POINT_WALK
    + """
            int met[8];
            for (int k = 0; k < 8; ++k) {
                const float dx = x[0] - p[k], dy = x[1] - p[8 + k], dz = x[2] - p[16 + k];
                met[k] = (int)(dx * dx + dy * dy + dz * dz < p[48 + k]);
            }
            unsigned mask = lane_mask(met);
            while (mask) {
                const int k = next_lane(mask);
                const int slot = block * 8 + k;
                if (slot >= tree.count || shapes.data[slot] != shape)
                    continue;
                const float dx = x[0] - p[k], dy = x[1] - p[8 + k], dz = x[2] - p[16 + k];
                const float nx = p[24 + k], ny = p[32 + k], nz = p[40 + k];
                const float a = dx * n[0] + dy * n[1] + dz * n[2], b = dx * nx + dy * ny + dz * nz;
                const float q2 = (dx * dx + dy * dy + dz * dz + 8.0f * larger(a * a, b * b)) / p[48 + k];
                const float facing = (nx * n[0] + ny * n[1] + nz * n[2] - edge_on) / (1.0f - edge_on);
                if (q2 >= 1.0f || facing <= 0.0f)
                    continue;
                const float w = (1.0f - q2) * (1.0f - q2) * facing;
                int at = found;
                if (found < most) {
                    ++found;
                } else {
                    at = 0;
                    for (int j = 1; j < most; ++j)
                        if (weights.data[start + j] < weights.data[start + at])
                            at = j;
                    if (weights.data[start + at] >= w)
                        continue;
                }
                points.data[start + at] = slot;
                weights.data[start + at] = w;
            }
        }
    }
    for (int j = 0; j < found; ++j)
        sum += weights.data[start + j];
    for (int j = 0; j < found; ++j)
        weights.data[start + j] /= sum;
    return found;
"""
)


@wp.func_native(FIND)
def find_around(
    tree: SplatTree,
    shapes: wp.array[int],
    x: wp.vec3,
    n: wp.vec3,
    shape: int,
    edge_on: float,
    most: int,
    start: int,
    points: wp.array[int],
    weights: wp.array[float],
) -> int: ...


@wp.struct
class Table:
    """Which points serve a place and how much, MOST to a place; weights add up to 1."""

    points: wp.array[int]  # in the tree's order
    weights: wp.array[float]
    count: wp.array[int]  # 0: none does


@wp.kernel
def find_points(
    offset: int,
    tree: SplatTree,
    shapes: wp.array[int],
    position: wp.array[wp.vec3],
    normal: wp.array[wp.vec3],
    shape: wp.array[int],
    table: Table,
):
    """One thread owns one place in the rest pose, of a shape, and writes its part of the table."""
    i = offset + wp.tid()
    table.count[i] = find_around(
        tree, shapes, position[i], normal[i], shape[i], EDGE_ON, MOST, i * MOST, table.points, table.weights
    )


@wp.kernel
def place_hits(
    offset: int,
    scene: Scene,
    rest: Scene,
    face: wp.array[int],
    bary: wp.array[wp.vec2],
    normal_now: wp.array[wp.vec3],
    position: wp.array[wp.vec3],
    normal: wp.array[wp.vec3],
    shape: wp.array[int],
):
    """One thread owns one primary hit of a frame: where it is in the rest pose, and of which shape."""
    i = offset + wp.tid()
    s = place(rest, face[i], bary[i])
    side = wp.where(wp.dot(triangle_at(scene, face[i]).ng, normal_now[i]) >= 0.0, 1.0, -1.0)
    position[i] = s.p
    normal[i] = s.n * side
    shape[i] = rest.face_shapes[face[i]]


@wp.kernel
def mix_values(offset: int, table: Table, width: int, values: wp.array[wp.vec3], mixed: wp.array[wp.vec3]):
    """One thread owns one of `width` values at one place: the mean of what the points around it have, 0 without any."""
    tid = offset + wp.tid()
    i = tid // width
    total = wp.vec3(0.0)
    for k in range(table.count[i]):
        total = total + values[table.points[i * MOST + k] * width + tid % width] * table.weights[i * MOST + k]
    mixed[tid] = total
