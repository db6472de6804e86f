"""The film on the device: running means per pixel, one thread owns one pixel.

Means are updated sample by sample (Welford 1962), so that a picture does not depend on how its samples are cut into
passes.
"""

import warp as wp

wp.set_module_options({"enable_backward": False})


@wp.struct
class Film:
    first_pixel: int  # of the band of the image that is on the device
    count: wp.array[int]  # finite samples
    surface_count: wp.array[int]  # of these, camera rays that met a surface
    emission: wp.array[wp.vec3]
    direct: wp.array[wp.vec3]
    indirect: wp.array[wp.vec3]
    squares: wp.array[wp.vec3]  # sum of squared deviations of the whole radiance
    albedo: wp.array[wp.vec3]
    normal: wp.array[wp.vec3]
    position: wp.array[wp.vec3]  # mean over `surface_count`, relative to the scene's centre
    depth: wp.array[float]  # likewise
    ray_count: wp.array[int]  # finite samples that sent a ray on from the first hit
    inverse_distance: wp.array[float]  # mean over `ray_count` of one over the distance to what it met, 0 for nothing
    closest_hit_rays: wp.array[int]
    shadow_rays: wp.array[int]
    nonfinite: wp.array[int]  # dropped samples


@wp.struct
class PathSample:
    emission: wp.vec3  # light seen directly
    direct: wp.vec3  # light after one scattering
    indirect: wp.vec3  # light after more
    albedo: wp.vec3
    normal: wp.vec3
    position: wp.vec3
    depth: float  # distance along the camera ray, below 0: nothing was met
    has_ray: int  # 1: a ray went on from the first hit
    inverse_distance: float  # one over its length, 0: it met nothing
    bandwidth: float  # Blinn exponent of what was met first, 0: diffuse
    motion: wp.vec3  # how far that point goes from time 0 to 1
    base: wp.vec3  # part of direct and indirect light that left it by way of a diffuse layer
    closest_hit_rays: int
    shadow_rays: int


@wp.func
def is_finite(v: wp.vec3):
    return wp.isfinite(v[0]) and wp.isfinite(v[1]) and wp.isfinite(v[2])


@wp.func
def add_sample(film: Film, i: int, s: PathSample):
    """Folds one path into pixel i of the band."""
    film.closest_hit_rays[i] = film.closest_hit_rays[i] + s.closest_hit_rays
    film.shadow_rays[i] = film.shadow_rays[i] + s.shadow_rays
    radiance = s.emission + s.direct + s.indirect
    if not is_finite(radiance):
        film.nonfinite[i] = film.nonfinite[i] + 1
        return
    n = film.count[i] + 1
    film.count[i] = n
    part = 1.0 / float(n)
    emission = film.emission[i]
    direct = film.direct[i]
    indirect = film.indirect[i]
    before = radiance - (emission + direct + indirect)
    emission = emission + (s.emission - emission) * part
    direct = direct + (s.direct - direct) * part
    indirect = indirect + (s.indirect - indirect) * part
    after = radiance - (emission + direct + indirect)
    film.emission[i] = emission
    film.direct[i] = direct
    film.indirect[i] = indirect
    film.squares[i] = film.squares[i] + wp.cw_mul(before, after)
    film.albedo[i] = film.albedo[i] + (s.albedo - film.albedo[i]) * part
    film.normal[i] = film.normal[i] + (s.normal - film.normal[i]) * part
    if s.depth >= 0.0:
        m = film.surface_count[i] + 1
        film.surface_count[i] = m
        film.position[i] = film.position[i] + (s.position - film.position[i]) / float(m)
        film.depth[i] = film.depth[i] + (s.depth - film.depth[i]) / float(m)
    if s.has_ray != 0:
        k = film.ray_count[i] + 1
        film.ray_count[i] = k
        film.inverse_distance[i] = film.inverse_distance[i] + (s.inverse_distance - film.inverse_distance[i]) / float(k)
