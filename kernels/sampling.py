"""Warps of the unit square, and frames to put them in."""

import warp as wp

wp.set_module_options({"enable_backward": False})

PI = wp.constant(3.14159265358979)
INV_PI = wp.constant(0.318309886183791)


@wp.struct
class Frame:
    s: wp.vec3
    t: wp.vec3
    n: wp.vec3


@wp.func
def make_frame(n: wp.vec3):
    """Right-handed frame around the unit vector n without a branch (Duff et al. 2017)."""
    sign = wp.where(n[2] >= 0.0, 1.0, -1.0)
    a = -1.0 / (sign + n[2])
    b = n[0] * n[1] * a
    f = Frame()
    f.s = wp.vec3(1.0 + sign * n[0] * n[0] * a, sign * b, -sign * n[0])
    f.t = wp.vec3(b, sign + n[1] * n[1] * a, -n[1])
    f.n = n
    return f


@wp.func
def to_world(f: Frame, v: wp.vec3):
    return f.s * v[0] + f.t * v[1] + f.n * v[2]


@wp.func
def square_to_disc(u: wp.vec2):
    """Uniform point of the unit disc, concentric so that strata keep their shape (Shirley, Chiu 1997)."""
    a = 2.0 * u[0] - 1.0
    b = 2.0 * u[1] - 1.0
    r = float(0.0)
    phi = float(0.0)
    if wp.abs(a) > wp.abs(b):
        r = a
        phi = 0.25 * PI * b / a
    elif b != 0.0:
        r = b
        phi = 0.5 * PI - 0.25 * PI * a / b
    return wp.vec2(r * wp.cos(phi), r * wp.sin(phi))


@wp.func
def square_to_cosine_hemisphere(u: wp.vec2):
    """Direction around +z with pdf cos / pi: the disc, projected up (Malley's method)."""
    d = square_to_disc(u)
    return wp.vec3(d[0], d[1], wp.sqrt(wp.max(0.0, 1.0 - d[0] * d[0] - d[1] * d[1])))


@wp.func
def square_to_triangle(u: wp.vec2):
    """Uniform barycentric coordinates of a triangle, area-preserving square root warp."""
    r = wp.sqrt(u[0])
    return wp.vec3(1.0 - r, r * (1.0 - u[1]), r * u[1])


@wp.func
def square_to_blinn_half_vector(u: wp.vec2, exponent: float):
    """Half vector around +z with pdf (e+1)/(2 pi) cos^e (Pharr, Humphreys 2010, sec. 14.5)."""
    log_cos = wp.log(1.0 - u[0]) / (exponent + 1.0)
    cos_h = wp.exp(log_cos)
    sin_h = wp.sqrt(wp.max(0.0, -2.0 * cos_h * wp.sinh(log_cos)))  # 1 - cos^2 without cancellation
    phi = 2.0 * PI * u[1]
    return wp.vec3(sin_h * wp.cos(phi), sin_h * wp.sin(phi), cos_h)


@wp.func
def power_heuristic(pdf: float, other: float):
    """Weight of a sample drawn with `pdf` where `other` could have drawn it too (Veach 1997, beta = 2)."""
    a = pdf / wp.max(pdf, other)
    b = other / wp.max(pdf, other)
    return a * a / (a * a + b * b)
