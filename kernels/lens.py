"""Defocus and motion from primary rays (Lehtinen et al. 2012, section 3.4): reconstruction rays through a lens."""

import warp as wp

from warpgi.kernels.lens_splats import lens_surface
from warpgi.kernels.light_field import Sky, sky_radiance
from warpgi.kernels.rng import SOBOL, make_sampler, sample_2d
from warpgi.kernels.sampling import square_to_disc
from warpgi.kernels.splats import SplatTree

wp.set_module_options({"enable_backward": False})

ANY_REACH = wp.constant(1.0e30)


@wp.struct
class Lens:
    """A thin lens about the origin of camera space."""

    width: int  # of the picture
    radius: float  # 0: a pinhole
    stop: float  # part of it that rays of the picture take, 0: its centre alone
    corner: wp.vec3  # of the picture's first pixel, on the focal plane
    right: wp.vec3  # to the next pixel
    down: wp.vec3
    moving: int  # 1: rays have times


@wp.struct
class LensRay:
    x: float  # film position [pixels]
    y: float
    uv: wp.vec2  # lens coordinates, in the unit disc
    time: float
    o: wp.vec3
    d: wp.vec3


@wp.struct
class LensSums:
    """What the rays of each pixel found so far."""

    radiance: wp.array[wp.vec3]
    counts: wp.array[wp.vec4i]  # rays without support, to the sky, cut short; undersampled surfaces passed through


@wp.func
def lens_ray(lens: Lens, seed: int, pixel: int, index: int):
    """A ray through a random point of a pixel and of the lens, at a random time."""
    sampler = make_sampler(seed, pixel, index, SOBOL)
    # pairs that the input's camera rays do not take
    film = sample_2d(sampler, 3)
    r = LensRay()
    r.x = float(pixel % lens.width) + film[0]
    r.y = float(pixel // lens.width) + film[1]
    r.o = wp.vec3(0.0)
    if lens.radius > 0.0:
        r.uv = square_to_disc(sample_2d(sampler, 4)) * lens.stop
        r.o = wp.vec3(lens.radius * r.uv[0], lens.radius * r.uv[1], 0.0)
    if lens.moving != 0:
        r.time = sample_2d(sampler, 5)[0]
    r.d = wp.normalize(lens.corner + lens.right * r.x + lens.down * r.y - r.o)
    return r


@wp.kernel
def reconstruct_still_lens(
    offset: int,
    tree: SplatTree,
    free2: wp.array[float],
    sky: Sky,
    lens: Lens,
    first_ray: int,
    ray_count: int,
    seed: int,
    noise: float,
    part2: float,
    slope2: float,
    sums: LensSums,
):
    """One thread owns a pixel and sends `ray_count` of its rays into splats that are still."""
    i = offset + wp.tid()
    total = sums.radiance[i]
    counts = sums.counts[i]
    for ray in range(first_ray, first_ray + ray_count):
        r = lens_ray(lens, seed, i, ray)
        s = lens_surface(tree, free2, r.o, r.d, noise, ANY_REACH, part2, slope2, wp.min(sky.size, 1))
        if s[3] > 0.0:
            total = total + wp.vec3(s[0], s[1], s[2]) / s[3]
        elif sky.size > 0:
            total = total + sky_radiance(sky, r.d)
            counts[1] = counts[1] + 1
        else:
            counts[0] = counts[0] + 1
        counts[2] = counts[2] + int(s[6])
        counts[3] = counts[3] + int(s[7])
    sums.radiance[i] = total
    sums.counts[i] = counts


@wp.kernel
def lens_means(
    offset: int,
    sums: LensSums,
    ray_count: int,
    first: wp.array[int],
    seen: wp.array[wp.vec3],
    image: wp.array[wp.vec3],
):
    """One thread writes one pixel: the mean of the rays that found something; the input's where none did.

    `seen` holds the radiance of the samples, those of pixel i from `first[i]` on.
    """
    i = offset + wp.tid()
    found = ray_count - sums.counts[i][0]
    if found > 0:
        image[i] = sums.radiance[i] / float(found)
    else:
        total = wp.vec3(0.0)
        for k in range(first[i], first[i + 1]):
            total = total + seen[k]
        image[i] = total / float(wp.max(first[i + 1] - first[i], 1))
