"""Reflection and refraction: evaluate, pdf, sample. wo points to the viewer, wi to the light.

`n` is the shading normal on the side of wo for reflecting materials; a value always carries the cosine of wi.
Opaque materials reflect alike on both sides.
"""

import warp as wp

from warpgi.kernels.sampling import (
    INV_PI,
    PI,
    make_frame,
    square_to_blinn_half_vector,
    square_to_cosine_hemisphere,
    to_world,
)
from warpgi.kernels.scene import COATED, CONDUCTOR, DIELECTRIC, DIFFUSE, MIRROR, ShapeRecord

wp.set_module_options({"enable_backward": False})


# Layers of Coated.
BASE = wp.constant(0)
COAT = wp.constant(1)


# Stands for the exponent of a lobe without width, where one is asked for.
DELTA_EXPONENT = wp.constant(1.0e6)


@wp.struct
class BsdfSample:
    wi: wp.vec3
    weight: wp.vec3  # f cos / pdf, for delta lobes the lobe's reflectance over its probability; 0: absorbed
    pdf: float  # per solid angle; 0 for a delta lobe
    transmitted: int  # 1: it went through the surface
    eta: float  # index of refraction crossed, 1 for reflection
    layer: int  # of Coated: COAT or BASE, the one that was drawn from


@wp.func
def is_delta(kind: int):
    return kind == MIRROR or kind == DIELECTRIC


@wp.func
def bandwidth(shape: ShapeRecord):
    """Blinn exponent of the sharpest lobe, 0 where all is diffuse: LALD12's kappa is four times its square root."""
    if is_delta(shape.kind):
        return DELTA_EXPONENT
    if shape.kind == DIFFUSE:
        return 0.0
    return shape.exponent


@wp.func
def fresnel_conductor(cos_i: float, eta: float, k: float):
    """Unpolarised reflectance of a conductor, exact (Pharr, Humphreys 2010, sec. 8.2.1 cites the same optics)."""
    c2 = cos_i * cos_i
    s2 = 1.0 - c2
    t0 = eta * eta - k * k - s2
    a2b2 = wp.sqrt(wp.max(0.0, t0 * t0 + 4.0 * eta * eta * k * k))
    a = wp.sqrt(wp.max(0.0, 0.5 * (a2b2 + t0)))
    t1 = a2b2 + c2
    t2 = 2.0 * cos_i * a
    rs = (t1 - t2) / (t1 + t2)
    t3 = c2 * a2b2 + s2 * s2
    t4 = t2 * s2
    rp = rs * (t3 - t4) / (t3 + t4)
    return 0.5 * (rs + rp)


@wp.func
def fresnel_schlick(cos_i: float, reflectance: wp.vec3):
    """Schlick 1994."""
    m = 1.0 - cos_i
    m2 = m * m
    return reflectance + (wp.vec3(1.0) - reflectance) * (m2 * m2 * m)


@wp.func
def conductor_reflectance(shape: ShapeRecord, albedo: wp.vec3, cos_i: float):
    if shape.eta[0] > 0.0:
        return wp.vec3(
            fresnel_conductor(cos_i, shape.eta[0], shape.k[0]),
            fresnel_conductor(cos_i, shape.eta[1], shape.k[1]),
            fresnel_conductor(cos_i, shape.eta[2], shape.k[2]),
        )
    return fresnel_schlick(cos_i, albedo)


@wp.func
def fresnel_dielectric(cos_i: float, eta: float):
    """Unpolarised reflectance at an interface whose far side has `eta` times the near side's index."""
    cos_t2 = (eta * eta - 1.0 + cos_i * cos_i) / (eta * eta)  # 1 - sin^2 by Snell, without cancellation
    if cos_t2 <= 0.0:
        return 1.0  # total internal reflection
    cos_t = wp.sqrt(cos_t2)
    rp = (eta * cos_i - cos_t) / (eta * cos_i + cos_t)
    rs = (cos_i - eta * cos_t) / (cos_i + eta * cos_t)
    return 0.5 * (rs * rs + rp * rp)


@wp.func
def glossy_lobe(shape: ShapeRecord, n: wp.vec3, wo: wp.vec3, wi: wp.vec3, h: wp.vec3, oh: float):
    """D G / (4 cos_o) of Torrance-Sparrow with the Blinn distribution, the cosine of wi cancelled."""
    cos_o = wp.dot(n, wo)
    cos_h = wp.dot(n, h)
    d = (shape.exponent + 2.0) * 0.5 * INV_PI * wp.pow(wp.max(cos_h, 0.0), shape.exponent)
    g = wp.min(1.0, wp.min(2.0 * cos_h * cos_o / oh, 2.0 * cos_h * wp.dot(n, wi) / oh))
    return d * g / (4.0 * cos_o)


@wp.func
def glossy_pdf(shape: ShapeRecord, n: wp.vec3, wo: wp.vec3, wi: wp.vec3):
    """Density of a direction drawn by the Blinn distribution's half vectors."""
    h = wp.normalize(wo + wi)
    cos_h = wp.max(wp.dot(n, h), 0.0)
    return (shape.exponent + 1.0) * wp.pow(cos_h, shape.exponent) / (8.0 * PI * wp.max(wp.dot(wo, h), 1.0e-12))


@wp.func
def coat_albedo(shape: ShapeRecord, cos: float):
    """Bound of the share of light from this angle that the coat of Coated reflects: see `warpgi.coat`."""
    m = 1.0 - cos
    m2 = m * m
    m5 = m2 * m2 * m
    m10 = m5 * m5
    fit = shape.eta[0] + shape.eta[1] * m + shape.eta[2] * m2
    fit = fit + shape.k[0] * m5 + shape.k[1] * m10 + shape.k[2] * (m10 * m10 * m2 * m2)
    return wp.min(wp.min(fit, fresnel_dielectric(cos, shape.ior) + shape.coat[0]), 1.0)


@wp.func
def coat_value(shape: ShapeRecord, n: wp.vec3, wo: wp.vec3, wi: wp.vec3):
    """f cos of the coat of Coated alone; both directions on the side of n."""
    h = wp.normalize(wo + wi)
    oh = wp.max(wp.dot(wo, h), 1.0e-12)
    return fresnel_dielectric(oh, shape.ior) * glossy_lobe(shape, n, wo, wi, h, oh)


@wp.func
def base_albedo(shape: ShapeRecord, albedo: wp.vec3):
    """What the base of Coated reflects of light that got through the coat, thrown back and forth below it included."""
    r = shape.coat[2]
    return wp.vec3(
        albedo[0] * (1.0 - r) / (1.0 - albedo[0] * r),
        albedo[1] * (1.0 - r) / (1.0 - albedo[1] * r),
        albedo[2] * (1.0 - r) / (1.0 - albedo[2] * r),
    )


@wp.func
def base_value(shape: ShapeRecord, albedo: wp.vec3, n: wp.vec3, wo: wp.vec3, wi: wp.vec3):
    """f cos of the base of Coated, seen through its coat; both directions on the side of n."""
    cos_i = wp.dot(n, wi)
    through = (1.0 - coat_albedo(shape, wp.dot(n, wo))) * (1.0 - coat_albedo(shape, cos_i)) * shape.coat[1]
    return base_albedo(shape, albedo) * (through * cos_i * INV_PI)


@wp.func
def base_share(shape: ShapeRecord, albedo: wp.vec3, n: wp.vec3, wo: wp.vec3, wi: wp.vec3):
    """Part of the light from wi that comes to wo by way of a diffuse layer."""
    if shape.kind == DIFFUSE:
        return wp.vec3(1.0)
    if shape.kind != COATED or wp.dot(n, wi) <= 0.0:
        return wp.vec3(0.0)
    base = base_value(shape, albedo, n, wo, wi)
    coat = wp.max(coat_value(shape, n, wo, wi), 1.0e-30)
    return wp.cw_div(base, base + wp.vec3(coat))


@wp.func
def has_base(kind: int):
    """Whether a surface has a diffuse layer, of which an irradiance says all."""
    return kind == DIFFUSE or kind == COATED


@wp.func
def base_entry(shape: ShapeRecord, n: wp.vec3, wi: wp.vec3):
    """Part of the light from wi that comes to the diffuse layer, which reflects it by `base_reflectance`."""
    if shape.kind == COATED:
        return (1.0 - coat_albedo(shape, wp.dot(n, wi))) * shape.coat[1]
    return 1.0


@wp.func
def base_reflectance(shape: ShapeRecord, albedo: wp.vec3, n: wp.vec3, wo: wp.vec3):
    """pi times the radiance towards wo that the diffuse layer makes of each unit of irradiance that came to it."""
    if shape.kind == COATED:
        return base_albedo(shape, albedo) * (1.0 - coat_albedo(shape, wp.dot(n, wo)))
    return albedo


@wp.func
def coat_probability(shape: ShapeRecord, cos_o: float):
    """Chance that the coat of Coated is sampled, as if its base reflected half of what it gets."""
    e = coat_albedo(shape, cos_o)
    return e / (e + 0.5 * (1.0 - e))


@wp.func
def evaluate(shape: ShapeRecord, albedo: wp.vec3, n: wp.vec3, wo: wp.vec3, wi: wp.vec3):
    """f(wo, wi) cos(wi) [1/sr]; 0 for delta lobes, which no given direction meets."""
    cos_o = wp.dot(n, wo)
    cos_i = wp.dot(n, wi)
    if cos_o <= 0.0 or cos_i <= 0.0:
        return wp.vec3(0.0)
    if shape.kind == DIFFUSE:
        return albedo * (cos_i * INV_PI)
    if shape.kind == CONDUCTOR:
        h = wp.normalize(wo + wi)
        oh = wp.max(wp.dot(wo, h), 1.0e-12)
        return conductor_reflectance(shape, albedo, oh) * glossy_lobe(shape, n, wo, wi, h, oh)
    if shape.kind == COATED:
        return base_value(shape, albedo, n, wo, wi) + wp.vec3(coat_value(shape, n, wo, wi))
    return wp.vec3(0.0)


@wp.func
def is_wide(shape: ShapeRecord, exponent: float):
    """Whether all light is scattered by lobes no sharper than `exponent`."""
    if shape.kind == CONDUCTOR or shape.kind == COATED:
        return shape.exponent <= exponent
    return shape.kind == DIFFUSE


@wp.func
def has_wide_lobe(shape: ShapeRecord, exponent: float):
    """Whether some is; the base of Coated is such at any exponent."""
    return shape.kind == COATED or is_wide(shape, exponent)


@wp.func
def wide_share(shape: ShapeRecord, albedo: wp.vec3, n: wp.vec3, wo: wp.vec3, wi: wp.vec3, exponent: float):
    """Part of the light from wi that comes to wo by lobes no sharper than `exponent`."""
    if is_wide(shape, exponent):
        return wp.vec3(1.0)
    return base_share(shape, albedo, n, wo, wi)


@wp.func
def wide_value(shape: ShapeRecord, albedo: wp.vec3, n: wp.vec3, wo: wp.vec3, wi: wp.vec3, exponent: float):
    """f cos of these lobes alone."""
    if shape.kind == COATED and shape.exponent > exponent:
        if wp.dot(n, wo) <= 0.0 or wp.dot(n, wi) <= 0.0:
            return wp.vec3(0.0)
        return base_value(shape, albedo, n, wo, wi)
    if not has_wide_lobe(shape, exponent):
        return wp.vec3(0.0)
    return evaluate(shape, albedo, n, wo, wi)


@wp.func
def pdf(shape: ShapeRecord, n: wp.vec3, wo: wp.vec3, wi: wp.vec3):
    """Density per solid angle with which `sample` returns wi; 0 for delta lobes."""
    cos_i = wp.dot(n, wi)
    if cos_i <= 0.0 or wp.dot(n, wo) <= 0.0:
        return 0.0
    if shape.kind == DIFFUSE:
        return cos_i * INV_PI
    if shape.kind == CONDUCTOR:
        return glossy_pdf(shape, n, wo, wi)
    if shape.kind == COATED:
        chance = coat_probability(shape, wp.dot(n, wo))
        return chance * glossy_pdf(shape, n, wo, wi) + (1.0 - chance) * cos_i * INV_PI
    return 0.0


@wp.func
def refract_or_reflect(shape: ShapeRecord, n: wp.vec3, wo: wp.vec3, choice: float):
    """Smooth glass: one of the two lobes, in proportion to Fresnel; n on the outside."""
    cos_o = wp.dot(n, wo)
    eta = wp.where(cos_o >= 0.0, shape.ior, 1.0 / shape.ior)
    m = wp.where(cos_o >= 0.0, n, -n)
    cos_o = wp.abs(cos_o)
    r = fresnel_dielectric(cos_o, eta)
    s = BsdfSample()
    s.eta = 1.0
    s.weight = wp.vec3(1.0)
    if choice < r:
        s.wi = m * (2.0 * cos_o) - wo
    else:
        cos_t = wp.sqrt(wp.max(0.0, (eta * eta - 1.0 + cos_o * cos_o) / (eta * eta)))
        s.wi = m * (cos_o / eta - cos_t) - wo / eta
        s.transmitted = 1
        s.eta = eta
        s.weight = wp.vec3(1.0 / (eta * eta))  # radiance is compressed into the denser side's smaller solid angle
    return s


@wp.func
def sample(shape: ShapeRecord, albedo: wp.vec3, n: wp.vec3, wo: wp.vec3, u: wp.vec2):
    """A direction with pdf as above; for Dielectric n may lie on either side of wo, else on its own."""
    s = BsdfSample()
    s.eta = 1.0
    s.weight = wp.vec3(0.0)
    if shape.kind == DIFFUSE:
        local = square_to_cosine_hemisphere(u)
        s.wi = to_world(make_frame(n), local)
        s.pdf = local[2] * INV_PI
        if s.pdf > 0.0:
            s.weight = albedo
    elif shape.kind == COATED:
        chance = coat_probability(shape, wp.dot(n, wo))
        if u[0] < chance:
            s.layer = COAT
            h = to_world(make_frame(n), square_to_blinn_half_vector(wp.vec2(u[0] / chance, u[1]), shape.exponent))
            oh = wp.dot(wo, h)
            if oh > 0.0:
                s.wi = h * (2.0 * oh) - wo
                s.pdf = pdf(shape, n, wo, s.wi)
        else:
            rest = wp.vec2((u[0] - chance) / (1.0 - chance), u[1])
            s.wi = to_world(make_frame(n), square_to_cosine_hemisphere(rest))
            s.pdf = pdf(shape, n, wo, s.wi)
        if s.pdf > 0.0:
            s.weight = evaluate(shape, albedo, n, wo, s.wi) / s.pdf
    elif shape.kind == CONDUCTOR:
        h = to_world(make_frame(n), square_to_blinn_half_vector(u, shape.exponent))
        oh = wp.dot(wo, h)
        s.wi = h * (2.0 * oh) - wo
        if oh > 0.0:
            s.pdf = pdf(shape, n, wo, s.wi)
            if s.pdf > 0.0:
                s.weight = evaluate(shape, albedo, n, wo, s.wi) / s.pdf
    elif shape.kind == MIRROR:
        s.wi = n * (2.0 * wp.dot(n, wo)) - wo
        s.weight = albedo
    else:
        s = refract_or_reflect(shape, n, wo, u[0])
    return s
