"""Light sampling: one light by its share of the power, one point on it."""

import warp as wp

from warpgi.kernels.sampling import square_to_triangle
from warpgi.kernels.scene import Scene, ray_offset, triangle_at

wp.set_module_options({"enable_backward": False})


@wp.struct
class LightSample:
    target: wp.vec3  # end of the shadow ray, just off the light's surface; for parallel light a direction
    distant: int
    wi: wp.vec3  # towards the light
    weight: wp.vec3  # radiance over pdf; for delta lights irradiance across wi over probability
    pdf: float  # per solid angle; 0 for a delta light


@wp.func
def pick_light(scene: Scene, u: float):
    """Index of the light whose part of the running sum holds u."""
    low = int(0)
    high = scene.light_count - 1
    while low < high:
        middle = (low + high) // 2
        if u < scene.light_cdf[middle]:
            high = middle
        else:
            low = middle + 1
    return low


@wp.func
def light_probability(scene: Scene, index: int):
    if index == 0:
        return scene.light_cdf[0]
    return scene.light_cdf[index] - scene.light_cdf[index - 1]


@wp.func
def area_to_solid_angle(light_pdf: float, distance2: float, cos_light: float):
    """Density per solid angle of a density per area (Veach 1997, eq. 8.2)."""
    return light_pdf * distance2 / wp.max(cos_light, 1.0e-20)


@wp.func
def sample_light(scene: Scene, p: wp.vec3, u: wp.vec2, choice: float):
    """A direction from p to a light; weight 0 where that light cannot reach p."""
    index = pick_light(scene, choice)
    light = scene.lights[index]
    s = LightSample()
    s.weight = wp.vec3(0.0)
    if light.face >= 0:
        face = triangle_at(scene, light.face)
        bary = square_to_triangle(u)
        q = face.a * bary[0] + face.b * bary[1] + face.c * bary[2]
        to_light = q - p
        distance2 = wp.dot(to_light, to_light)
        if distance2 > 0.0:
            s.wi = to_light / wp.sqrt(distance2)
            n = face.ng
            shape = scene.shapes[scene.face_shapes[light.face]]
            cos_light = -wp.dot(n, s.wi)
            if cos_light < 0.0 and shape.two_sided != 0:
                cos_light = -cos_light
                n = -n
            if cos_light > 0.0:
                s.pdf = area_to_solid_angle(shape.light_pdf * face.stretch, distance2, cos_light)
                s.weight = shape.emission / s.pdf
                s.target = q + n * ray_offset(face.a, face.b, face.c)
        return s
    probability = light_probability(scene, index)
    if light.distant != 0:
        s.distant = 1
        s.wi = -light.direction
        s.target = s.wi
        s.weight = light.radiance / probability
        return s
    to_light = light.position - p
    distance2 = wp.dot(to_light, to_light)
    if distance2 > 0.0:
        s.wi = to_light / wp.sqrt(distance2)
        s.target = light.position
        cone = wp.clamp(-wp.dot(s.wi, light.direction) * light.cone_scale + light.cone_offset, 0.0, 1.0)
        s.weight = light.radiance * (cone * cone / (distance2 * probability))
    return s
