"""Hierarchical meshless basis (Lehtinen et al. 2008): device side."""

import warp as wp

from warpgi.kernels.poisson_disc import disc_distance2
from warpgi.kernels.sampling import INV_PI

wp.set_module_options({"enable_backward": False})

# Cosine of the normals at which a weight falls to 0: 60 degrees, beyond those of one disc.
EDGE_ON = wp.constant(0.5)


@wp.struct
class Surface:
    """The primary hits, of which basis functions and receivers are."""

    position: wp.array[wp.vec3]
    normal: wp.array[wp.vec3]


@wp.struct
class Level:
    """Points of one level."""

    grid: wp.uint64  # of their positions
    points: wp.array[int]  # their numbers among the primary hits
    support: float  # distance at which weights fall to 0


@wp.func
def basis_weight(d: wp.vec3, n: wp.vec3, m: wp.vec3, support: float):
    """w(|x - x_i|, n.n_i), smooth in the distance and 0 at `support`."""
    q2 = disc_distance2(d, n, m) / (support * support)
    facing = wp.max(0.0, (wp.dot(n, m) - EDGE_ON) / (1.0 - EDGE_ON))
    fall = wp.max(0.0, 1.0 - q2)
    return fall * fall * facing


@wp.kernel
def add_level(
    offset: int,
    surface: Surface,
    level: Level,
    receivers: wp.array[int],
    coefficient: wp.array[wp.vec3],
    value: wp.array[wp.vec3],
    weight: wp.array[float],
):
    """One thread owns one receiver and adds the level's sum of coefficients times normalised basis functions.

    It writes the sum of weights, by which they were made a partition of unity, too; where that is 0 it adds nothing.
    """
    i = offset + wp.tid()
    h = receivers[i]
    x = surface.position[h]
    n = surface.normal[h]
    total = wp.vec3(0.0)
    sum = float(0.0)
    for j in wp.hash_grid_query(level.grid, x, level.support):
        p = level.points[j]
        w = basis_weight(x - surface.position[p], n, surface.normal[p], level.support)
        total = total + coefficient[j] * w
        sum = sum + w
    if sum > 0.0:
        value[h] = value[h] + total / sum
    weight[i] = sum


@wp.kernel
def find_near(offset: int, surface: Surface, level: Level, receivers: wp.array[int], near: wp.array[int]):
    """One thread owns one receiver: 2 if it is in the support of a point of the level, 1 if within twice that, else 0.

    In the support of a point light varies. What is around it belongs to the next level too, with coefficients of 0, so
    that it fades out there.
    """
    i = offset + wp.tid()
    h = receivers[i]
    x = surface.position[h]
    found = int(0)
    for j in wp.hash_grid_query(level.grid, x, 2.0 * level.support):
        p = level.points[j]
        d = x - surface.position[p]
        if wp.length_sq(d) < 4.0 * level.support * level.support:
            found = wp.max(found, 1)
            if basis_weight(d, surface.normal[h], surface.normal[p], level.support) > 0.0:
                found = 2
                break
    near[i] = found


@wp.kernel
def reflect_irradiance(offset: int, value: wp.array[wp.vec3], albedo: wp.array[wp.vec3], reflected: wp.array[wp.vec3]):
    """One thread writes the radiance that one primary hit reflects; irradiance is never below 0."""
    i = offset + wp.tid()
    e = wp.max(value[i], wp.vec3(0.0))
    reflected[i] = wp.cw_mul(albedo[i], e) * INV_PI
