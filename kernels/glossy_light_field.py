"""Light-field reconstruction of glossy surfaces (Lehtinen et al. 2012, sections 2.2 to 2.4): sizing and rays."""

import warp as wp

from warpgi.kernels.bsdf import sample
from warpgi.kernels.bvh import BLOCK_STRIDE, EMPTY, LANES
from warpgi.kernels.glossy_splats import (
    AXIS_STRIDE,
    CONE_STRIDE,
    glossy_surface,
    largest_lobe,
    nearest_alike_distance2,
)
from warpgi.kernels.light_field import GATHER_PAIR, Gathered, Receivers, Sky, sky_radiance
from warpgi.kernels.rng import SOBOL, make_sampler, sample_2d
from warpgi.kernels.sampling import make_frame, square_to_cosine_hemisphere, to_world
from warpgi.kernels.scene import DIFFUSE, ShapeRecord
from warpgi.kernels.splats import SplatTree, nearest_facing, splat_radiance

wp.set_module_options({"enable_backward": False})

KEY_BITS = wp.constant(10)  # of the curve's key, a dimension

# Lobes look for others of like direction no farther than where a flat surface has this many samples: beyond, directions
# have to be less alike (the authors' program counts the samples that it has looked at).
LOOKED_AT = wp.constant(1000.0)

vec6i = wp.types.vector(length=6, dtype=wp.int32)


@wp.struct
class Lobes:
    """Glossy splats by place and direction: how the part of their radiance that no diffuse layer sent varies."""

    tree: SplatTree  # radiance of the lobes alone
    axes: wp.array[float]
    cones: wp.array[float]
    stretch: float
    kappa: wp.array[float]  # of the splats in the tree that resolves visibility, 0: it is no lobe
    radiance: wp.array[wp.vec3]  # of their lobes


@wp.struct
class Surfaces:
    """What the BSDF at each receiver is; empty where all are diffuse."""

    records: wp.array[ShapeRecord]
    material: wp.array[int]  # number of the receiver's record
    wo: wp.array[wp.vec3]
    reflectance: wp.array[wp.vec3]


@wp.struct
class Beyond:
    """What mirrors show: splats of the segments after them, in a tree of their own; empty where none was met."""

    mirror: wp.array[wp.vec3]  # what splats in the tree that resolves visibility reflect as mirrors, 0: they are none
    tree: SplatTree
    lobes: Lobes
    sky: Sky
    none: wp.array[wp.vec3]  # a mirror behind the mirror is read as a very sharp lobe
    shift: wp.vec3  # from positions in this tree to positions in that one
    noise: float


@wp.struct
class Seen:
    """What a reconstruction ray found."""

    light: wp.vec3
    mirror: wp.vec3  # what reflects the rest, 0: there is none
    p: wp.vec3  # on the mirror
    n: wp.vec3
    input: wp.vec3  # that the input saw in it, for where nothing is found beyond
    counts: wp.vec4i


@wp.func
def mirrored(d: wp.vec3, n: wp.vec3):
    return d - n * (2.0 * wp.dot(d, n))


@wp.func
def hilbert_code_6d(point: vec6i):
    """Place on the six-dimensional Hilbert curve (Skilling 2004, transposed axes interleaved)."""
    x = point
    q = int(1) << (KEY_BITS - 1)
    while q > 1:
        p = q - 1
        for i in range(6):
            if (x[i] & q) != 0:
                x[0] = x[0] ^ p
            else:
                t = (x[0] ^ x[i]) & p
                x[0] = x[0] ^ t
                x[i] = x[i] ^ t
        q = q >> 1
    for i in range(1, 6):
        x[i] = x[i] ^ x[i - 1]
    flip = int(0)
    q = int(1) << (KEY_BITS - 1)
    while q > 1:
        if (x[5] & q) != 0:
            flip = flip ^ (q - 1)
        q = q >> 1
    code = wp.int64(0)
    for bit in range(KEY_BITS):
        for i in range(6):
            code = (code << wp.int64(1)) | wp.int64(((x[i] ^ flip) >> (KEY_BITS - 1 - bit)) & 1)
    return code


@wp.kernel
def order_lobes(
    offset: int,
    hits: wp.array[wp.vec3],
    axes: wp.array[wp.vec3],
    source: wp.array[int],
    low: wp.vec3,
    cell: float,
    axis_cell: float,
    keys: wp.array[wp.int64],
    values: wp.array[int],
):
    """One thread writes the curve's key of one sample, by where it lies and where its axis points."""
    i = offset + wp.tid()
    j = source[i]
    p = (hits[j] - low) / cell
    a = (axes[j] + wp.vec3(1.0)) / axis_cell
    last = (int(1) << KEY_BITS) - 1
    x = vec6i()
    for k in range(3):
        x[k] = wp.clamp(int(p[k]), 0, last)
        x[3 + k] = wp.clamp(int(a[k]), 0, last)
    keys[i] = hilbert_code_6d(x)
    values[i] = j


@wp.kernel
def mirror_rays(
    offset: int,
    origins: wp.array[wp.vec3],
    hits: wp.array[wp.vec3],
    normals: wp.array[wp.vec3],
    axes: wp.array[wp.vec3],
):
    """One thread writes one sample's ray, mirrored where it ends."""
    i = offset + wp.tid()
    axes[i] = mirrored(wp.normalize(hits[i] - origins[i]), normals[i])


@wp.kernel
def fill_axes(
    offset: int,
    axes: wp.array[wp.vec3],
    kappa: wp.array[float],
    order: wp.array[int],
    count: int,
    rows: wp.array[float],
):
    """One thread writes one lobe's axis and concentration, beside its splat in the tree."""
    i = offset + wp.tid()
    place = (i // LANES) * AXIS_STRIDE + i % LANES
    if i < count:
        j = order[i]
        for axis in range(3):
            rows[place + axis * LANES] = axes[j][axis]
        rows[place + 3 * LANES] = kappa[j]


@wp.kernel
def fit_leaf_cones(
    offset: int, rows: wp.array[float], count: int, block_count: int, first_node: int, cones: wp.array[float]
):
    """One thread owns a node of the lowest level: the boxes of the axes in its eight blocks, and their least kappa."""
    i = offset + wp.tid()
    for child in range(LANES):
        low = wp.vec3(EMPTY)
        high = wp.vec3(-EMPTY)
        kappa = float(EMPTY)
        block = i * LANES + child
        if block < block_count:
            for lane in range(LANES):
                if block * LANES + lane < count:
                    place = block * AXIS_STRIDE + lane
                    axis = wp.vec3(rows[place], rows[place + 8], rows[place + 16])
                    low = wp.min(low, axis)
                    high = wp.max(high, axis)
                    kappa = wp.min(kappa, rows[place + 24])
        write_cone(cones, first_node + i, child, low, high, kappa)


@wp.kernel
def fit_level_cones(offset: int, first_node: int, first_below: int, count_below: int, cones: wp.array[float]):
    """One thread owns a node: what bounds its eight children."""
    i = offset + wp.tid()
    for child in range(LANES):
        low = wp.vec3(EMPTY)
        high = wp.vec3(-EMPTY)
        kappa = float(EMPTY)
        below = i * LANES + child
        if below < count_below:
            p = (first_below + below) * CONE_STRIDE
            for k in range(LANES):
                low = wp.min(low, wp.vec3(cones[p + k], cones[p + 8 + k], cones[p + 16 + k]))
                high = wp.max(high, wp.vec3(cones[p + 24 + k], cones[p + 32 + k], cones[p + 40 + k]))
                kappa = wp.min(kappa, cones[p + 48 + k])
        write_cone(cones, first_node + i, child, low, high, kappa)


@wp.func
def write_cone(cones: wp.array[float], node: int, child: int, low: wp.vec3, high: wp.vec3, kappa: float):
    p = node * CONE_STRIDE + child
    for axis in range(3):
        cones[p + axis * LANES] = low[axis]
        cones[p + (3 + axis) * LANES] = high[axis]
    cones[p + 6 * LANES] = kappa


@wp.kernel
def size_lobes(offset: int, lobes: Lobes, k: int, radius2: wp.array[float]):
    """One thread finds one lobe's squared radius: the distance of its k-th neighbour of like direction.

    It comes as that of its k-th neighbour of any direction.
    """
    i = offset + wp.tid()
    near2 = radius2[i]
    r2 = float(-1.0)
    if near2 >= 0.0:
        farthest2 = near2 * (LOOKED_AT / float(k)) * (1.0 + 1.0e-3)
        r2 = nearest_alike_distance2(lobes.tree, lobes.axes, lobes.cones, i, k, lobes.stretch, farthest2)
    # nothing is alike: as if direction did not matter
    radius2[i] = wp.where(r2 < 0.0, wp.max(near2, 0.0), r2)


@wp.func
def look(
    tree: SplatTree,
    lobes: Lobes,
    sky: Sky,
    mirror: wp.array[wp.vec3],
    o: wp.vec3,
    d: wp.vec3,
    noise: float,
    keep_one: float,
    keep_two: float,
):
    """Light that comes along a ray, from the first surface or the sky; of a mirror, what it is and where it was met."""
    seen = Seen()
    s = glossy_surface(tree, lobes.kappa, o, d, noise, keep_one, keep_two)
    seen.counts[2] = int(s[4])
    seen.counts[3] = int(s[5])
    share = float(0.0)  # of the surface that is glossy
    distance = float(0.0)
    normal = d
    splat = int(-1)
    if s[6] > 0.0:
        splat = nearest_facing(tree, o + s[6] * d, d)
    if splat >= 0:
        # what faces away belongs to the other side of something thin, whose light may be quite another
        seen.light = splat_radiance(tree, splat)
        if lobes.kappa[splat] > 0.0:
            share = 1.0
            distance = s[6]
            normal = splat_normal(tree, splat)
    elif s[3] > 0.0:
        seen.light = wp.vec3(s[0], s[1], s[2]) / s[3]
        if s[7] > 0.0:
            share = s[7] / s[3]
            distance = s[8] / s[7]
            normal = wp.normalize(wp.vec3(s[9], s[10], s[11]))
            splat = wp.cast(s[12], wp.int32)
    elif sky.size > 0:
        seen.light = sky_radiance(sky, d)
        seen.counts[1] = 1
    else:
        seen.counts[0] = 1
    if share > 0.0:
        if wp.dot(normal, d) > 0.0:
            normal = -normal
        seen.p = o + distance * d
        seen.n = normal
        if mirror.shape[0] > 0:
            seen.mirror = mirror[splat] * share
            seen.input = lobes.radiance[splat] * share
        if seen.mirror[0] + seen.mirror[1] + seen.mirror[2] <= 0.0:
            axis = mirrored(d, normal)
            lobe = largest_lobe(lobes.tree, lobes.axes, lobes.cones, seen.p, normal, d, axis, distance, lobes.stretch)
            if lobe >= 0:
                seen.light = seen.light + splat_radiance(lobes.tree, lobe) * share
            else:
                seen.light = seen.light + lobes.radiance[splat] * share
    return seen


@wp.kernel
def reconstruct_glossy(
    offset: int,
    tree: SplatTree,
    lobes: Lobes,
    beyond: Beyond,
    surfaces: Surfaces,
    sky: Sky,
    receivers: Receivers,
    rays_each: int,
    first_ray: int,
    ray_count: int,
    seed: int,
    noise: float,
    keep_one: float,
    keep_two: float,
    gathered: Gathered,
):
    """One thread owns a receiver and sends `ray_count` of its `rays_each` reconstruction rays, drawn by its BSDF.

    Radiance in `tree` is what diffuse layers sent. Where a ray meets a mirror it is reconstructed at the next segment
    (section 4): mirrored there, in the tree of what lies beyond.
    """
    i = offset + wp.tid()
    j = receivers.sample[i]
    o = receivers.origins[j]
    n = receivers.normals[j]
    frame = make_frame(n)
    shape = ShapeRecord()
    shape.kind = DIFFUSE
    wo = n
    reflectance = wp.vec3(1.0)
    if surfaces.material.shape[0] > 0:
        shape = surfaces.records[surfaces.material[j]]
        if shape.kind != DIFFUSE:
            wo = surfaces.wo[j]
            reflectance = surfaces.reflectance[j]
    pixel = int(0)
    place = int(0)
    if receivers.spp > 0:
        pixel = j // receivers.spp
        place = j % receivers.spp
    else:
        pixel = receivers.pixels[j]
        place = receivers.places[j]
    total = gathered.radiance[i]
    counts = gathered.counts[i]
    for ray in range(first_ray, first_ray + ray_count):
        # one sequence a pixel, cut into the shares of its samples
        sampler = make_sampler(seed, pixel, place * rays_each + ray, SOBOL)
        u = sample_2d(sampler, GATHER_PAIR)
        d = wp.vec3(0.0)
        weight = wp.vec3(1.0)
        if shape.kind == DIFFUSE:
            d = to_world(frame, square_to_cosine_hemisphere(u))
        else:
            b = sample(shape, reflectance, n, wo, u)
            d = b.wi
            weight = b.weight
            if weight[0] + weight[1] + weight[2] <= 0.0:
                continue
        first = look(tree, lobes, sky, beyond.mirror, o, d, noise, keep_one, keep_two)
        light = first.light
        counts = counts + first.counts
        if first.mirror[0] + first.mirror[1] + first.mirror[2] > 0.0:
            p = first.p - beyond.shift
            way = mirrored(d, first.n)
            second = look(beyond.tree, beyond.lobes, beyond.sky, beyond.none, p, way, beyond.noise, keep_one, keep_two)
            if second.counts[0] > 0:
                light = light + first.input
            else:
                light = light + wp.cw_mul(first.mirror, second.light)
            counts = counts + second.counts
        total = total + wp.cw_mul(weight, light)
    gathered.radiance[i] = total
    gathered.counts[i] = counts


@wp.func
def splat_normal(tree: SplatTree, splat: int):
    at = (splat // LANES) * BLOCK_STRIDE + splat % LANES + 24
    return wp.vec3(tree.blocks[at], tree.blocks[at + 8], tree.blocks[at + 16])
