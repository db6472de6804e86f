"""Emission, light sampling and the first hit's features: what every method shares."""

import warp as wp

from warpgi.kernels.bsdf import evaluate, pdf
from warpgi.kernels.film import PathSample
from warpgi.kernels.lights import area_to_solid_angle, sample_light
from warpgi.kernels.sampling import power_heuristic
from warpgi.kernels.scene import Scene, ShapeRecord, Surface, occluded, offset_origin

wp.set_module_options({"enable_backward": False})

# Keeps the end of a shadow ray before the light's surface where rounding in its length would reach it.
SHADOW_SHORTER = wp.constant(0.999999)


@wp.struct
class DirectLight:
    radiance: wp.vec3  # reflected towards wo
    wi: wp.vec3  # towards the light
    shadow_rays: int


@wp.func
def emitted(shape: ShapeRecord, ng: wp.vec3, wo: wp.vec3):
    """Radiance that the surface sends towards wo of itself."""
    if shape.two_sided != 0 or wp.dot(ng, wo) > 0.0:
        return shape.emission
    return wp.vec3(0.0)


@wp.func
def found_light_weight(pdf_area: float, ng: wp.vec3, d: wp.vec3, distance: float, bsdf_pdf: float):
    """Weight of emission met by a ray that BSDF sampling sent along d, where light sampling picks with `pdf_area`."""
    if bsdf_pdf <= 0.0 or pdf_area <= 0.0:
        return 1.0
    light_pdf = area_to_solid_angle(pdf_area, distance * distance, wp.abs(wp.dot(ng, d)))
    return power_heuristic(bsdf_pdf, light_pdf)


@wp.func
def emission_weight(shape: ShapeRecord, ng: wp.vec3, d: wp.vec3, distance: float, bsdf_pdf: float):
    """The same on a shape that is still; `bsdf_pdf` is 0 after a delta lobe."""
    return found_light_weight(shape.light_pdf, ng, d, distance, bsdf_pdf)


@wp.func
def facing_normal(s: Surface, wo: wp.vec3):
    """Shading normal on the side of wo; the geometric one where interpolation has turned it away."""
    n = wp.where(wp.dot(s.ng, wo) >= 0.0, s.n, -s.n)
    if wp.dot(n, wo) <= 0.0:
        n = wp.where(wp.dot(s.ng, wo) >= 0.0, s.ng, -s.ng)
    return n


@wp.func
def reflects(s: Surface, wo: wp.vec3, wi: wp.vec3):
    """Whether wo and wi lie on one side of the real surface, whatever the shading normal says."""
    return wp.dot(s.ng, wo) * wp.dot(s.ng, wi) > 0.0


@wp.func
def direct_light(
    scene: Scene, shape: ShapeRecord, s: Surface, n: wp.vec3, wo: wp.vec3, u: wp.vec2, choice: float, share: float
):
    """Light of one sampled light, reflected at s.

    `share` is the number of BSDF samples for each light sample that look for the same light, 0 if none does.
    """
    result = DirectLight()
    result.radiance = wp.vec3(0.0)
    light = sample_light(scene, s.p, u, choice)
    result.wi = light.wi
    if light.weight[0] + light.weight[1] + light.weight[2] <= 0.0 or not reflects(s, wo, light.wi):
        return result
    f = evaluate(shape, s.albedo, n, wo, light.wi)
    if f[0] + f[1] + f[2] <= 0.0:
        return result
    o = offset_origin(s.p, s.ng, s.offset, light.wi)
    d = light.wi
    distance = float(1.0e38)
    if light.distant == 0:
        # aim anew from the moved origin, or the ray passes beside small lights
        d = light.target - o
        distance = wp.length(d)
        d = d / distance
    result.shadow_rays = 1
    if not occluded(scene, o, d, distance * SHADOW_SHORTER):
        w = float(1.0)
        if share > 0.0 and light.pdf > 0.0:
            w = power_heuristic(light.pdf, share * pdf(shape, n, wo, light.wi))
        result.radiance = wp.cw_mul(f, light.weight) * w
    return result


@wp.func
def add_features(sample: PathSample, s: Surface, wo: wp.vec3, t: float):
    """The first hit's albedo, normal, position and depth for the feature layers."""
    result = sample
    result.albedo = s.albedo
    result.normal = wp.where(wp.dot(s.ng, wo) >= 0.0, s.n, -s.n)
    result.position = s.p
    result.depth = t
    return result
