"""Photons (Jensen 1996): light emitted by power, scattered with Russian roulette, written down where it lands."""

import warp as wp

from warpgi.kernels.bsdf import base_entry, base_share, has_base, has_wide_lobe, sample
from warpgi.kernels.direct import facing_normal, reflects
from warpgi.kernels.film import is_finite
from warpgi.kernels.lights import light_probability, pick_light
from warpgi.kernels.rng import Sampler, make_sampler, sample_2d
from warpgi.kernels.sampling import (
    PI,
    make_frame,
    square_to_cosine_hemisphere,
    square_to_disc,
    square_to_triangle,
    to_world,
)
from warpgi.kernels.scene import (
    COATED,
    DIELECTRIC,
    DIFFUSE,
    Hit,
    Scene,
    closest_hit,
    offset_origin,
    ray_offset,
    surface_at,
)

wp.set_module_options({"enable_backward": False})

# How light came to a photon's place; D is a diffuse surface or the base of a coated one, S any other.
DIRECT = wp.constant(0)  # L D
CAUSTIC = wp.constant(1)  # L S+ D
INDIRECT = wp.constant(2)  # any other
ECHO = wp.constant(3)  # L S+ D S* D: indirect too, and last reflected by a diffuse surface from a caustic on it

# Pairs of random numbers: cell and light, point on it, aim, side of it; then two for each scattering.
EMISSION_PAIRS = wp.constant(4)
SCATTER_PAIRS = wp.constant(2)

# Light that loses nothing, such as between mirrors, ends some day: from here on it survives with this probability.
LONG_PATH = wp.constant(24)
LONG_SURVIVAL = wp.constant(0.9)

# Cells of the aim's unit square, along an axis, and of the lights' running sum of power.
AIM_CELLS = wp.constant(32)
LIGHT_CELLS = wp.constant(8)


@wp.struct
class Start:
    """Where a path leaves its light, where that is not drawn at random."""

    light: int  # of the scene's records, -1: the environment
    weight: float  # share of all light, as if lights were picked by power
    u: wp.vec2  # point of a lamp's triangle; direction of the environment's light
    aim: wp.vec2
    side: float  # of a lamp that emits on both, 1 or -1
    key: int  # stands for the path's number in what is drawn


@wp.struct
class Emission:
    """How photons leave the lights."""

    seed: int
    map: int  # number of the map, with a random sequence of its own
    sampler: int  # INDEPENDENT or SOBOL
    part: float  # of the light that a photon carries: 1 / number of paths
    radius: float  # of a sphere around the scene
    environment: float  # probability that the environment emits
    caustics: int  # 1: only what reaches a diffuse surface over others; a path ends there
    sharpest: float  # exponent up to which glossy lobes leave photons too, 0: none do
    aim_cdf: wp.array[float]  # running sum over cells of their probability; empty: all alike
    starts: wp.array[Start]  # of each path; empty: they are drawn


@wp.struct
class Photons:
    position: wp.array[wp.vec3]
    normal: wp.array[wp.vec3]  # of the real surface, on the side that the light came from
    flux: wp.array[wp.vec3]  # [W]
    kind: wp.array[int]  # DIRECT, CAUSTIC, INDIRECT or ECHO
    # for those who read them as lights; empty for others
    face: wp.array[int]
    bary: wp.array[wp.vec2]  # of the triangle's first and second corner
    incident: wp.array[wp.vec3]  # towards where the light came from


@wp.struct
class Beam:
    o: wp.vec3
    d: wp.vec3
    flux: wp.vec3
    cell: int


@wp.func
def pick_cell(cdf: wp.array[float], u: float):
    low = int(0)
    high = cdf.shape[0] - 1
    while low < high:
        middle = (low + high) // 2
        if u < cdf[middle]:
            high = middle
        else:
            low = middle + 1
    return low


@wp.func
def square_to_sphere(u: wp.vec2):
    z = 1.0 - 2.0 * u[0]
    r = wp.sqrt(wp.max(0.0, 1.0 - z * z))
    return wp.vec3(r * wp.cos(2.0 * PI * u[1]), r * wp.sin(2.0 * PI * u[1]), z)


@wp.func
def parallel_beam(d: wp.vec3, u: wp.vec2, radius: float):
    """From a disc that covers the scene."""
    disc = square_to_disc(u) * radius
    frame = make_frame(d)
    beam = Beam()
    beam.o = frame.s * disc[0] + frame.t * disc[1] - d * (1.01 * radius)
    beam.d = d
    return beam


@wp.func
def emit(scene: Scene, emission: Emission, path: int, sampler: Sampler):
    """A ray of light; its flux is that of the light over the density with which it was chosen.

    Cells cut the space of `choice` (which light) and `aim`: what decides most about where light goes, the direction of
    a lamp's and the place of parallel light (Jensen 1996's projection maps, for any light).
    """
    first = sample_2d(sampler, 0)
    choice = first[0]
    aim = sample_2d(sampler, 2)
    weight = emission.part
    cells = emission.aim_cdf.shape[0]
    cell = int(0)
    if cells > 0:
        cell = pick_cell(emission.aim_cdf, first[0])
        before = float(0.0)
        if cell > 0:
            before = emission.aim_cdf[cell - 1]
        weight = weight / ((emission.aim_cdf[cell] - before) * float(cells))
        aim = wp.vec2(
            (float(cell % AIM_CELLS) + aim[0]) / float(AIM_CELLS),
            (float((cell // AIM_CELLS) % AIM_CELLS) + aim[1]) / float(AIM_CELLS),
        )
        choice = (float(cell // (AIM_CELLS * AIM_CELLS)) + first[1]) / float(LIGHT_CELLS)
    else:
        x = wp.min(int(aim[0] * float(AIM_CELLS)), AIM_CELLS - 1)
        y = wp.min(int(aim[1] * float(AIM_CELLS)), AIM_CELLS - 1)
        z = wp.min(int(choice * float(LIGHT_CELLS)), LIGHT_CELLS - 1)
        cell = (z * AIM_CELLS + y) * AIM_CELLS + x
    u = sample_2d(sampler, 1)
    from_environment = choice < emission.environment
    choice = wp.min((choice - emission.environment) / wp.max(1.0 - emission.environment, 1.0e-30), 0.99999994)
    index = int(0)
    if emission.starts.shape[0] > 0:
        start = emission.starts[path]
        weight = start.weight
        u = start.u
        aim = start.aim
        index = start.light
        from_environment = index < 0
    elif not from_environment:
        index = pick_light(scene, choice)
    beam = Beam()
    if from_environment:
        beam = parallel_beam(square_to_sphere(u), aim, emission.radius)
        area = PI * emission.radius * emission.radius
        beam.flux = scene.environment * (4.0 * PI * area * weight / emission.environment)
        beam.cell = cell
        return beam
    weight = weight / (1.0 - emission.environment)
    light = scene.lights[index]
    if light.face >= 0:
        a = scene.points[scene.indices[3 * light.face]]
        b = scene.points[scene.indices[3 * light.face + 1]]
        c = scene.points[scene.indices[3 * light.face + 2]]
        bary = square_to_triangle(u)
        shape = scene.shapes[scene.face_shapes[light.face]]
        n = scene.face_normals[light.face]
        sides = float(1.0)
        if shape.two_sided != 0:
            sides = 2.0
            turned = sample_2d(sampler, 3)[0] < 0.5
            if emission.starts.shape[0] > 0:
                turned = emission.starts[path].side < 0.0
            if turned:
                n = -n
        beam.o = a * bary[0] + b * bary[1] + c * bary[2] + n * ray_offset(a, b, c)
        beam.d = to_world(make_frame(n), square_to_cosine_hemisphere(aim))
        beam.flux = shape.emission * (PI * sides * weight / shape.light_pdf)
    elif light.distant != 0:
        beam = parallel_beam(light.direction, aim, emission.radius)
        area = PI * emission.radius * emission.radius
        beam.flux = light.radiance * (area * weight / light_probability(scene, index))
    else:
        beam.o = light.position
        solid_angle = 4.0 * PI
        if light.cone_scale == 0.0:
            beam.d = square_to_sphere(aim)
        else:
            # the intensity falls from the inner to the outer cone as the square of a line in the cosine
            outer = -light.cone_offset / light.cone_scale
            width = 1.0 / light.cone_scale
            inner = outer + width
            total = (1.0 - inner) + width / 3.0
            v = aim[0] * total
            cos_d = 1.0 - v
            if v > 1.0 - inner:
                cos_d = outer + width * wp.pow(wp.max(0.0, (total - v) * 3.0 / width), 1.0 / 3.0)
            sin_d = wp.sqrt(wp.max(0.0, 1.0 - cos_d * cos_d))
            phi = 2.0 * PI * aim[1]
            beam.d = to_world(make_frame(light.direction), wp.vec3(sin_d * wp.cos(phi), sin_d * wp.sin(phi), cos_d))
            solid_angle = 2.0 * PI * total
        beam.flux = light.radiance * (solid_angle * weight / light_probability(scene, index))
    beam.cell = cell
    return beam


@wp.func
def store(photons: Photons, k: int, p: wp.vec3, ng: wp.vec3, flux: wp.vec3, kind: int, hit: Hit, wo: wp.vec3):
    photons.position[k] = p
    photons.normal[k] = ng
    photons.flux[k] = flux
    photons.kind[k] = kind
    if photons.face.shape[0] > 0:
        photons.face[k] = hit.face
        photons.bary[k] = wp.vec2(hit.u, hit.v)
        photons.incident[k] = wo


@wp.func
def reflected_kind(kind: int):
    """What a photon is once a diffuse surface reflected it."""
    return wp.where(kind == CAUSTIC, ECHO, INDIRECT)


@wp.struct
class Track:
    """What became of one path."""

    stored: int  # photons
    rays: int
    dropped: int  # photons that were not finite
    cell: int  # where its light was aimed
    first: Hit  # what it met first


@wp.func
def trace_photons(scene: Scene, emission: Emission, path: int, photons: Photons, place: int, room: int):
    """Follows one path and writes its first `room` photons from `place` on; the rest are counted alone.

    Roulette keeps the largest channel of the flux, so that photons stay about equal. Shading normals weigh the flux by
    the cosines that a path from the camera would have there (Veach 1997, eq. 5.19).
    """
    key = int(path)
    if emission.starts.shape[0] > 0:
        key = emission.starts[path].key
    sampler = make_sampler(emission.seed, emission.map, key, emission.sampler)
    beam = emit(scene, emission, path, sampler)
    track = Track()
    track.first.face = -1
    track.cell = beam.cell
    o = beam.o
    d = beam.d
    flux = beam.flux
    kind = int(DIRECT)
    depth = int(0)
    while wp.max(flux) > 0.0:
        hit = closest_hit(scene, o, d)
        track.rays = track.rays + 1
        if depth == 0:
            track.first = hit
        if hit.face < 0:
            break
        shape = scene.shapes[scene.face_shapes[hit.face]]
        s = surface_at(scene, hit, shape)
        wo = -d
        n = s.n
        if shape.kind != DIELECTRIC:
            n = facing_normal(s, wo)
        cos_real = wp.abs(wp.dot(s.ng, wo))
        if cos_real == 0.0:
            break
        pair = EMISSION_PAIRS + SCATTER_PAIRS * depth
        left = wp.vec3(0.0)
        d = wp.vec3(0.0)
        # the sides of the normals that the light came to
        side = wp.sign(wp.dot(s.ng, wo))
        ng = s.ng * side
        ns = s.n * side
        if shape.kind == DIFFUSE or (emission.sharpest == 0.0 and has_base(shape.kind)):
            arrived = flux * (wp.max(wp.dot(ns, wo), 0.0) / cos_real * base_entry(shape, n, wo))
            if not is_finite(flux):
                track.dropped = track.dropped + 1
                break
            if wp.max(arrived) > 0.0 and (emission.caustics == 0 or kind == CAUSTIC):
                if track.stored < room:
                    store(photons, place + track.stored, s.p, ng, arrived, kind, hit, wo)
                track.stored = track.stored + 1
        if shape.kind == DIFFUSE:
            if emission.caustics != 0:
                break
            kind = reflected_kind(kind)
            # away along the real surface; who looks from there sees the shading normal unless it is turned away
            d = to_world(make_frame(ng), square_to_cosine_hemisphere(sample_2d(sampler, pair)))
            seen = wp.where(wp.dot(ns, d) > 0.0, ns, ng)
            left = wp.cw_mul(flux, s.albedo) * (wp.max(wp.dot(seen, wo), 0.0) / cos_real)
        else:
            if emission.sharpest > 0.0 and has_wide_lobe(shape, emission.sharpest) and is_finite(flux):
                if track.stored < room:
                    store(photons, place + track.stored, s.p, ng, flux, kind, hit, wo)
                track.stored = track.stored + 1
            b = sample(shape, s.albedo, n, wo, sample_2d(sampler, pair))
            cos_shading = wp.abs(wp.dot(n, b.wi))
            if wp.max(b.weight) <= 0.0 or cos_shading == 0.0 or (b.transmitted == 0 and not reflects(s, wo, b.wi)):
                break
            d = b.wi
            left = wp.cw_mul(flux, b.weight) * (
                wp.abs(wp.dot(n, wo)) / cos_real * wp.abs(wp.dot(s.ng, d)) / cos_shading
            )
            if b.transmitted != 0:
                left = left * (b.eta * b.eta)  # radiance shrinks by that where it is refracted, flux does not
            by_base = int(0)
            if shape.kind == COATED and emission.sharpest == 0.0:
                # which of the layers it came from, so that every photon is of one kind
                share = base_share(shape, s.albedo, n, wo, d)
                part = (share[0] + share[1] + share[2]) / 3.0
                if emission.caustics != 0:
                    left = wp.cw_mul(left, wp.vec3(1.0) - share)
                elif sample_2d(sampler, pair + 1)[1] < part:
                    left = wp.cw_mul(left, share) / part
                    by_base = int(1)
                else:
                    left = wp.cw_mul(left, wp.vec3(1.0) - share) / (1.0 - part)
            if by_base == 1:
                kind = reflected_kind(kind)
            elif kind == DIRECT:
                kind = int(CAUSTIC)

        # roulette
        survival = wp.min(wp.max(left) / wp.max(flux), 1.0)
        if depth >= LONG_PATH:
            survival = wp.min(survival, LONG_SURVIVAL)
        if survival <= 0.0 or sample_2d(sampler, pair + 1)[0] >= survival:
            break
        flux = left / survival
        o = offset_origin(s.p, s.ng, s.offset, d)
        depth = depth + 1
    return track


@wp.struct
class Tracks:
    stored: wp.array[int]
    rays: wp.array[int]
    dropped: wp.array[int]
    cell: wp.array[int]
    # empty where nobody asked
    face: wp.array[int]  # that it met first, -1: none
    bary: wp.array[wp.vec2]


@wp.kernel
def shoot(offset: int, scene: Scene, emission: Emission, first_path: int, slots: int, photons: Photons, tracks: Tracks):
    """One thread owns one path of a batch: its first `slots` photons, and how many there are."""
    i = offset + wp.tid()
    track = trace_photons(scene, emission, first_path + i, photons, i * slots, slots)
    tracks.stored[i] = track.stored
    tracks.rays[i] = track.rays
    tracks.dropped[i] = track.dropped
    tracks.cell[i] = track.cell
    if tracks.face.shape[0] > 0:
        tracks.face[i] = track.first.face
        tracks.bary[i] = wp.vec2(track.first.u, track.first.v)


@wp.kernel
def pack(
    offset: int,
    scene: Scene,
    emission: Emission,
    first_path: int,
    slots: int,
    batch: Photons,
    ends: wp.array[int],
    photons: Photons,
):
    """One thread owns one path: puts its photons, which end before `ends[i]`, in a row with the others'.

    The few paths that stored more than they had slots for are traced again, which is cheaper than slots for all.
    """
    i = offset + wp.tid()
    start = int(0)
    if i > 0:
        start = ends[i - 1]
    count = ends[i] - start
    if count > slots:
        trace_photons(scene, emission, first_path + i, photons, start, count)
        return
    for j in range(count):
        photons.position[start + j] = batch.position[i * slots + j]
        photons.normal[start + j] = batch.normal[i * slots + j]
        photons.flux[start + j] = batch.flux[i * slots + j]
        photons.kind[start + j] = batch.kind[i * slots + j]
        if photons.face.shape[0] > 0:
            photons.face[start + j] = batch.face[i * slots + j]
            photons.bary[start + j] = batch.bary[i * slots + j]
            photons.incident[start + j] = batch.incident[i * slots + j]
