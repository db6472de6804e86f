"""Virtual point lights (Keller 1997): photons read as lights, and what a surface reflects of them."""

import warp as wp

from warpgi.kernels.bsdf import wide_value
from warpgi.kernels.direct import SHADOW_SHORTER, reflects
from warpgi.kernels.photons import Photons
from warpgi.kernels.rng import Sampler, sample_2d
from warpgi.kernels.sampling import INV_PI, PI, make_frame, square_to_cosine_hemisphere, to_world
from warpgi.kernels.scene import (
    DIFFUSE,
    Hit,
    Scene,
    ShapeRecord,
    Surface,
    closest_hit,
    occluded,
    offset_origin,
    surface_at,
)

wp.set_module_options({"enable_backward": False})

# What becomes of light that comes from near.
UNBOUNDED = wp.constant(0)
CLAMPED = wp.constant(1)
COMPENSATED = wp.constant(2)
SPHERICAL = wp.constant(3)

# Directions across a spherical light, where it is nearer than so many of its radii; one, to its centre, beyond.
SPHERE_SAMPLES = wp.constant(16)
SPHERE_NEAR = wp.constant(4.0)
SPHERE_PAIR = wp.constant(1 << 16)
# Part of a texel's width, and of a distance, by which a shadow map may be wrong before something is in shadow.
MAP_BIAS = wp.constant(1.0)
MAP_ROUNDING = wp.constant(1.0e-4)
# The plastic number's powers: points of Roberts' lattice are even in the square at any count.
LATTICE_X = wp.constant(0.7548776662466927)
LATTICE_Y = wp.constant(0.5698402909980532)


@wp.struct
class Vpls:
    """Lights on surfaces."""

    plain: int  # 1: all are diffuse, with no normals but their surfaces'
    target: wp.array[wp.vec3]  # position, just off the surface
    normal: wp.array[wp.vec3]  # of the real surface, on the lit side
    intensity: wp.array[wp.vec3]  # of a diffuse light, along its normal [W/sr]; else the flux across that [W]
    # of those that are not plain; empty where all are
    shape: wp.array[int]
    shading: wp.array[wp.vec3]  # normal on the lit side
    turned: wp.array[float]  # factor on a diffuse light's intensity seen from beyond its shading normal's horizon
    albedo: wp.array[wp.vec3]
    incident: wp.array[wp.vec3]  # towards where the light came from
    # shadow maps, one a light: distance of what is seen through the texels of a square over its hemisphere
    map_side: int  # texels, 0: visibility by shadow rays, below 0: all is seen, to measure what visibility costs
    depth: wp.array[float]


@wp.struct
class Joining:
    """How lights are joined with what they light."""

    near: int  # UNBOUNDED, CLAMPED, COMPENSATED or SPHERICAL
    bound: float  # of the geometry term [1/m^2] where light is clamped, 0: none
    radius: float  # of spherical lights
    sharpest: float  # exponent of glossy lobes up to which they take part


@wp.kernel
def light_up(
    offset: int,
    scene: Scene,
    photons: Photons,
    vpls: Vpls,
):
    """One thread makes one photon a light."""
    i = offset + wp.tid()
    hit = Hit()
    hit.face = photons.face[i]
    hit.u = photons.bary[i][0]
    hit.v = photons.bary[i][1]
    index = scene.face_shapes[hit.face]
    shape = scene.shapes[index]
    s = surface_at(scene, hit, shape)
    w = photons.incident[i]
    side = wp.where(wp.dot(s.ng, w) >= 0.0, 1.0, -1.0)
    vpls.target[i] = s.p + s.ng * (side * s.offset)
    vpls.normal[i] = s.ng * side
    flux = photons.flux[i]
    if shape.kind == DIFFUSE:
        flux = wp.cw_mul(flux, s.albedo) * INV_PI
    vpls.intensity[i] = flux
    if vpls.shape.shape[0] > 0:
        vpls.shape[i] = index
        vpls.shading[i] = s.n * side
        vpls.albedo[i] = s.albedo
        vpls.incident[i] = w
        cos = wp.dot(s.n * side, w)
        vpls.turned[i] = wp.where(cos > 0.0, wp.abs(wp.dot(s.ng, w)) / wp.max(cos, 1.0e-20), 1.0)


@wp.func
def vpl_intensity(scene: Scene, vpls: Vpls, joining: Joining, j: int, wo: wp.vec3):
    """Intensity towards wo over the cosine of the real surface there: the light's flux times the BSDF."""
    if vpls.plain != 0:
        return vpls.intensity[j]
    ns = vpls.shading[j]
    seen = wp.dot(ns, wo) > 0.0
    shape = scene.shapes[vpls.shape[j]]
    if shape.kind == DIFFUSE:
        return vpls.intensity[j] * wp.where(seen, 1.0, vpls.turned[j])
    n = vpls.normal[j]
    w = vpls.incident[j]
    f = wide_value(shape, vpls.albedo[j], wp.where(seen, ns, n), wo, w, joining.sharpest)
    return wp.cw_mul(vpls.intensity[j], f) / wp.max(wp.dot(n, w), 1.0e-20)


@wp.func
def geometry_kept(joining: Joining, geometry: float):
    """Share of a geometry term that the lights bring."""
    if joining.bound > 0.0 and geometry > joining.bound:
        return joining.bound / geometry
    return 1.0


@wp.func
def from_sphere(
    scene: Scene,
    vpls: Vpls,
    joining: Joining,
    j: int,
    shape: ShapeRecord,
    s: Surface,
    n: wp.vec3,
    wo: wp.vec3,
    wi: wp.vec3,
    d2: float,
    u: wp.vec2,
):
    """Light of a virtual spherical light (Hasan et al. 2009, eq. 4), the mean over directions across it.

    It stands for a disc of its radius that faces the receiver wherever it is, with the surface's radiance.
    """
    r2 = joining.radius * joining.radius
    cos_max = float(-1.0)
    if d2 > r2:
        cos_max = wp.sqrt(1.0 - r2 / d2)
    samples = int(SPHERE_SAMPLES)
    width = 1.0 - cos_max
    if d2 > SPHERE_NEAR * SPHERE_NEAR * r2:
        samples = 1
        width = 0.5 * r2 / d2 * (1.0 + 0.25 * r2 / d2)  # without cancellation
    frame = make_frame(wi)
    total = wp.vec3(0.0)
    for k in range(samples):
        d = wi
        if samples > 1:
            x = u[0] + LATTICE_X * float(k)
            y = u[1] + LATTICE_Y * float(k)
            cos = 1.0 - (x - wp.floor(x)) * width
            sin = wp.sqrt(wp.max(0.0, 1.0 - cos * cos))
            d = to_world(frame, wp.vec3(sin * wp.cos(2.0 * PI * y), sin * wp.sin(2.0 * PI * y), cos))
        cos_light = -wp.dot(vpls.normal[j], d)
        if cos_light > 0.0 and reflects(s, wo, d):
            f = wide_value(shape, s.albedo, n, wo, d, joining.sharpest)
            total = total + wp.cw_mul(f, vpl_intensity(scene, vpls, joining, j, -d)) * cos_light
    return total * (2.0 * width / (r2 * float(samples)))


@wp.func
def disc_to_square(p: wp.vec2):
    """Inverse of the concentric map (Shirley, Chiu 1997)."""
    r = wp.length(p)
    a = float(0.0)
    b = float(0.0)
    if wp.abs(p[0]) > wp.abs(p[1]):
        a = wp.where(p[0] < 0.0, -r, r)
        b = a * wp.atan(p[1] / p[0]) * (4.0 * INV_PI)
    elif p[1] != 0.0:
        b = wp.where(p[1] < 0.0, -r, r)
        a = b * wp.atan(p[0] / p[1]) * (4.0 * INV_PI)
    return wp.vec2(0.5 * a + 0.5, 0.5 * b + 0.5)


@wp.func
def texel_direction(vpls: Vpls, j: int, texel: int):
    """Through the middle of a texel: texels are even in the cosine-weighted hemisphere."""
    u = wp.vec2(
        (float(texel % vpls.map_side) + 0.5) / float(vpls.map_side),
        (float(texel // vpls.map_side) + 0.5) / float(vpls.map_side),
    )
    return to_world(make_frame(vpls.normal[j]), square_to_cosine_hemisphere(u))


@wp.kernel
def render_maps(offset: int, scene: Scene, vpls: Vpls):
    """One thread owns one texel of one light's shadow map, and casts a ray for it."""
    i = offset + wp.tid()
    texels = vpls.map_side * vpls.map_side
    j = i // texels
    vpls.depth[i] = closest_hit(scene, vpls.target[j], texel_direction(vpls, j, i % texels)).t


@wp.func
def seen_in_map(vpls: Vpls, j: int, s: Surface, to_light: wp.vec3, distance: float):
    """Whether a light's shadow map says that it sees s.

    Where the ray of the texel meets the plane of s its depth is exact, so that flat surfaces do not shadow themselves;
    a surface as near as s itself, but for a texel's width, is taken for s: the bias of edges and corners.
    """
    frame = make_frame(vpls.normal[j])
    d = to_light * (-1.0 / distance)
    square = disc_to_square(wp.vec2(wp.dot(frame.s, d), wp.dot(frame.t, d)))
    x = wp.clamp(int(square[0] * float(vpls.map_side)), 0, vpls.map_side - 1)
    y = wp.clamp(int(square[1] * float(vpls.map_side)), 0, vpls.map_side - 1)
    texel = y * vpls.map_side + x
    ray = texel_direction(vpls, j, texel)
    needed = distance * (1.0 - MAP_BIAS / float(vpls.map_side))
    across = wp.dot(s.ng, ray)
    if across != 0.0:
        plane = -wp.dot(s.ng, to_light) / across
        if plane > 0.0:
            needed = wp.min(needed, plane * (1.0 - MAP_ROUNDING))
    return vpls.depth[j * vpls.map_side * vpls.map_side + texel] >= needed


@wp.struct
class Reflected:
    radiance: wp.vec3  # towards wo
    shadow_rays: int


@wp.func
def reflect_vpls(
    scene: Scene,
    vpls: Vpls,
    joining: Joining,
    shape: ShapeRecord,
    s: Surface,
    n: wp.vec3,
    wo: wp.vec3,
    first: int,
    stride: int,
    sampler: Sampler,
):
    """Light of every `stride`-th light from `first` on that wide lobes at s reflect, times the stride."""
    result = Reflected()
    result.radiance = wp.vec3(0.0)
    for j in range(first, vpls.target.shape[0], stride):
        to_light = vpls.target[j] - s.p
        d2 = wp.dot(to_light, to_light)
        if d2 <= 0.0:
            continue
        wi = to_light / wp.sqrt(d2)
        light = wp.vec3(0.0)
        if joining.near == SPHERICAL:
            u = sample_2d(sampler, SPHERE_PAIR + j)
            light = from_sphere(scene, vpls, joining, j, shape, s, n, wo, wi, d2, u)
        else:
            cos_light = -wp.dot(vpls.normal[j], wi)
            if cos_light <= 0.0 or not reflects(s, wo, wi):
                continue
            f = wide_value(shape, s.albedo, n, wo, wi, joining.sharpest)
            geometry = cos_light / d2
            geometry = geometry * geometry_kept(joining, geometry * wp.dot(n, wi))
            light = wp.cw_mul(f, vpl_intensity(scene, vpls, joining, j, -wi)) * geometry
        if wp.max(light) <= 0.0:
            continue
        seen = True
        if vpls.map_side > 0:
            seen = seen_in_map(vpls, j, s, to_light, wp.sqrt(d2))
        elif vpls.map_side == 0:
            o = offset_origin(s.p, s.ng, s.offset, wi)
            d = vpls.target[j] - o
            distance = wp.length(d)
            result.shadow_rays = result.shadow_rays + 1
            seen = not occluded(scene, o, d / distance, distance * SHADOW_SHORTER)
        if seen:
            result.radiance = result.radiance + light
    result.radiance = result.radiance * float(stride)
    return result
