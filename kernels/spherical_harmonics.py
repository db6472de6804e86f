"""Spherical harmonics of the light at points (after Kristensen et al. 2005), and what glossy surfaces reflect of it.

Real orthonormal harmonics; coefficient l, m is at l (l + 1) + m. Directions are those of the rest pose, so that light
that moves along with a surface stays the same. No light comes from below a surface: it is continued there as its mirror
image, which leaves no edge at the horizon for harmonics to ring at.
"""

import warp as wp

from warpgi.kernels.bsdf import sample
from warpgi.kernels.path import PathSettings
from warpgi.kernels.path_strata import incident_light
from warpgi.kernels.rng import INDEPENDENT, SOBOL, SOBOL_PAIRS, make_sampler, sample_2d
from warpgi.kernels.sampling import PI, make_frame, to_world
from warpgi.kernels.scene import DIFFUSE, Scene, triangle_at

wp.set_module_options({"enable_backward": False})

# Beside the pairs that paths use, which are 0 and up.
DIRECTION_PAIR = wp.constant(-2)
# Of reflection: none that places a primary hit.
LOBE_PAIR = wp.constant(SOBOL_PAIRS - 1)


@wp.struct
class Lobes:
    """Primary hits on glossy surfaces, by their numbers among all."""

    hits: wp.array[int]
    normal: wp.array[wp.vec3]  # of all primary hits
    wo: wp.array[wp.vec3]
    reflectance: wp.array[wp.vec3]
    albedo: wp.array[wp.vec3]  # what multiplies the BSDF
    face: wp.array[int]
    material: wp.array[int]
    per_pixel: int


@wp.func
def fill_harmonics(values: wp.array[float], start: int, order: int, d: wp.vec3):
    """Writes the harmonics up to l = order in the direction d, from `start` on.

    Legendre functions are normalised and without their factor sin^m, which is in the sines and cosines of azimuth.
    """
    c = float(1.0)
    s = float(0.0)
    top = float(0.28209479)  # of l = m
    for m in range(order + 1):
        if m > 0:
            top = -top * wp.sqrt((2.0 * float(m) + 1.0) / (2.0 * float(m)))
            turned = c * d[0] - s * d[1]
            s = c * d[1] + s * d[0]
            c = turned
        before = float(0.0)
        value = top
        for k in range(m, order + 1):
            if k > m:
                k2 = float(k * k)
                m2 = float(m * m)
                p2 = float((k - 1) * (k - 1))
                b = wp.sqrt((p2 - m2) / (4.0 * p2 - 1.0))
                following = wp.sqrt((4.0 * k2 - 1.0) / (k2 - m2)) * (d[2] * value - b * before)
                before = value
                value = following
            at = start + k * (k + 1)
            if m == 0:
                values[at] = value
            else:
                values[at + m] = 1.41421356 * value * c
                values[at - m] = 1.41421356 * value * s


@wp.func
def to_rest(scene: Scene, rest: Scene, face: int, d: wp.vec3):
    """A direction as a triangle's rest pose has it: turned as the triangle's first edge and normal are."""
    now = triangle_at(scene, face)
    then = triangle_at(rest, face)
    s = wp.normalize(now.b - now.a)
    t = wp.cross(now.ng, s)
    u = wp.normalize(then.b - then.a)
    return u * wp.dot(s, d) + wp.cross(then.ng, u) * wp.dot(t, d) + then.ng * wp.dot(now.ng, d)


@wp.kernel
def trace_directions(
    offset: int,
    scene: Scene,
    rest: Scene,
    settings: PathSettings,
    step: float,
    positions: wp.array[wp.vec3],
    normals: wp.array[wp.vec3],
    faces: wp.array[int],
    keys: wp.array[int],
    rings: int,
    sectors: int,
    directions: wp.array[wp.vec3],
    strata: wp.array[wp.vec4],
):
    """One thread owns a point: light from uniform directions of its hemisphere, one in each stratum of equal solid
    angle, and the directions in the rest pose."""
    i = offset + wp.tid()
    n = normals[i]
    frame = make_frame(n)
    size = rings * sectors
    for k in range(size):
        u = sample_2d(make_sampler(settings.seed, keys[i], k, INDEPENDENT), DIRECTION_PAIR)
        z = 1.0 - (float(k % rings) + u[0]) / float(rings)
        phi = 2.0 * PI * (float(k // rings) + u[1]) / float(sectors)
        r = wp.sqrt(wp.max(0.0, 1.0 - z * z))
        d = to_world(frame, wp.vec3(r * wp.cos(phi), r * wp.sin(phi), z))
        strata[i * size + k] = incident_light(scene, settings, positions[i], n, d, step, keys[i], k)
        directions[i * size + k] = to_rest(scene, rest, faces[i], d)


@wp.kernel
def project_directions(
    offset: int,
    directions: wp.array[wp.vec3],
    strata: wp.array[wp.vec4],
    size: int,
    normals: wp.array[wp.vec3],
    order: int,
    harmonics: wp.array[float],
    coefficients: wp.array[wp.vec3],
):
    """One thread owns a point: coefficients of its light and the mirror image of that, from `size` directions of equal
    solid angle; what has a distance below 0 is left out.

    `harmonics` is room for as many numbers as there are coefficients.
    """
    i = offset + wp.tid()
    n = normals[i]
    count = (order + 1) * (order + 1)
    start = i * count
    known = int(0)
    for k in range(size):
        if strata[i * size + k][3] >= 0.0:
            known = known + 1
    share = 2.0 * PI / float(wp.max(known, 1))
    for k in range(size):
        s = strata[i * size + k]
        if s[3] >= 0.0:
            d = directions[i * size + k]
            light = wp.vec3(s[0], s[1], s[2]) * share
            for side in range(2):
                fill_harmonics(harmonics, start, order, wp.where(side == 0, d, d - n * (2.0 * wp.dot(d, n))))
                for j in range(start, start + count):
                    coefficients[j] = coefficients[j] + light * harmonics[j]


@wp.kernel
def reflect_harmonics(
    offset: int,
    scene: Scene,
    rest: Scene,
    lobes: Lobes,
    coefficients: wp.array[wp.vec3],
    order: int,
    rays: int,
    seed: int,
    harmonics: wp.array[float],
    reflected: wp.array[wp.vec3],
):
    """One thread owns one glossy hit: radiance that it reflects, from `rays` directions drawn by its BSDF.

    A pixel's hits share one sequence of directions. Light that ringing and noise make negative counts as it is, or the
    mean would be too large; the sum is 0 at least. `harmonics` is room for as many numbers as there are coefficients.
    """
    i = offset + wp.tid()
    h = lobes.hits[i]
    count = (order + 1) * (order + 1)
    start = i * count
    shape = scene.shapes[lobes.material[h]]
    # where a shape is diffuse in this frame its albedo is what multiplies, and is not in the BSDF as well
    reflectance = wp.where(shape.kind == DIFFUSE, wp.vec3(1.0), lobes.reflectance[h])
    total = wp.vec3(0.0)
    for ray in range(rays):
        number = (h % lobes.per_pixel) * rays + ray
        u = sample_2d(make_sampler(seed, h // lobes.per_pixel, number, SOBOL), LOBE_PAIR)
        b = sample(shape, reflectance, lobes.normal[h], lobes.wo[h], u)
        if b.weight[0] + b.weight[1] + b.weight[2] > 0.0:
            fill_harmonics(harmonics, start, order, to_rest(scene, rest, lobes.face[h], b.wi))
            light = wp.vec3(0.0)
            for j in range(start, start + count):
                light = light + coefficients[j] * harmonics[j]
            total = total + wp.cw_mul(b.weight, light)
    reflected[h] = wp.cw_mul(lobes.albedo[h], wp.max(total, wp.vec3(0.0))) / float(rays)
