"""Final gathering for an irradiance cache (Jensen 1996): rays that read photon maps where they end."""

import warp as wp

from warpgi.kernels.film import is_finite
from warpgi.kernels.hemisphere import Hemispheres, stratum_direction
from warpgi.kernels.photon_map import Maps, View, gather_direction, incident_light
from warpgi.kernels.rng import make_sampler
from warpgi.kernels.sampling import PI, make_frame, to_world
from warpgi.kernels.scene import Scene, offset_origin

wp.set_module_options({"enable_backward": False})


@wp.func
def gathered_light(
    scene: Scene, maps: Maps, view: View, step: float, p: wp.vec3, n: wp.vec3, d: wp.vec3, key: int, number: int
):
    """Radiance along -d but for lights seen and caustics, and the distance of what was met; below 0: not finite."""
    sampler = make_sampler(view.seed, key, number, view.sampler)
    light = incident_light(scene, maps, sampler, key, number, offset_origin(p, n, step, d), d, 0.0)
    if not is_finite(light.radiance):
        return wp.vec4(0.0, 0.0, 0.0, -1.0)
    return wp.vec4(light.radiance[0], light.radiance[1], light.radiance[2], light.distance)


@wp.kernel
def gather_strata(
    offset: int,
    scene: Scene,
    maps: Maps,
    view: View,
    step: float,
    hemispheres: Hemispheres,
    strata: wp.array[wp.vec4],
):
    """One thread owns a point and fills the strata of its hemisphere with a ray each: radiance and distance."""
    i = offset + wp.tid()
    n = hemispheres.normals[i]
    frame = make_frame(n)
    size = hemispheres.rings * hemispheres.sectors
    for k in range(size):
        d = to_world(frame, stratum_direction(hemispheres, i, k, view.seed))
        strata[i * size + k] = gathered_light(
            scene, maps, view, step, hemispheres.points[i], n, d, hemispheres.keys[i], k
        )


@wp.kernel
def gather_at_hits(
    offset: int,
    scene: Scene,
    maps: Maps,
    view: View,
    step: float,
    hits: wp.array[int],
    origins: wp.array[wp.vec3],
    normals: wp.array[wp.vec3],
    per_pixel: int,
    rays: int,
    irradiance: wp.array[wp.vec3],
):
    """One thread owns one of the listed primary hits: irradiance from `rays` rays, which a pixel's hits share out."""
    i = offset + wp.tid()
    h = hits[i]
    key = h // per_pixel
    total = wp.vec3(0.0)
    known = int(0)
    for ray in range(rays):
        number = (h % per_pixel) * rays + ray
        d = gather_direction(view.seed, view.sampler, key, number, normals[h])
        found = gathered_light(scene, maps, view, step, origins[h], normals[h], d, key, number)
        if found[3] >= 0.0:
            total = total + wp.vec3(found[0], found[1], found[2])
            known = known + 1
    irradiance[i] = total * (PI / float(wp.max(known, 1)))
