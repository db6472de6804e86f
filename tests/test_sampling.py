"""Warps of the unit square have the densities that they state; frames are orthonormal; weights share out one."""

from __future__ import annotations

import numpy as np
import pytest
import warp as wp

from warpgi.kernels.sampling import (
    make_frame,
    power_heuristic,
    square_to_blinn_half_vector,
    square_to_cosine_hemisphere,
    square_to_disc,
    square_to_triangle,
    to_world,
)

wp.set_module_options({"enable_backward": False})

# Chance of a false alarm of one chi-square test; there are nine of them.
LEVEL = 1e-4 / 9
COUNT = 1_000_000
ULP = 2.0**-24  # half a unit in the last place of 1

DISC, HEMISPHERE, TRIANGLE, BLINN = (wp.constant(i) for i in range(4))


@wp.kernel
def warp_square(kind: int, exponent: float, u: wp.array[wp.vec2], result: wp.array[wp.vec3]):
    i = wp.tid()
    if kind == DISC:
        d = square_to_disc(u[i])
        result[i] = wp.vec3(d[0], d[1], 0.0)
    elif kind == HEMISPHERE:
        result[i] = square_to_cosine_hemisphere(u[i])
    elif kind == TRIANGLE:
        result[i] = square_to_triangle(u[i])
    else:
        result[i] = square_to_blinn_half_vector(u[i], exponent)


@wp.kernel
def make_frames(n: wp.array[wp.vec3], v: wp.vec3, s: wp.array[wp.vec3], t: wp.array[wp.vec3], w: wp.array[wp.vec3]):
    i = wp.tid()
    f = make_frame(n[i])
    s[i] = f.s
    t[i] = f.t
    w[i] = to_world(f, v)


@wp.kernel
def weigh(a: wp.array[float], b: wp.array[float], weight: wp.array[float]):
    i = wp.tid()
    weight[i] = power_heuristic(a[i], b[i])


def square(seed: int = 0) -> np.ndarray:
    """Uniform float32 points, multiples of 2^-24, with the corners of the square among them."""
    u = np.random.default_rng(seed).random((COUNT, 2), dtype=np.float32)
    edge = [0.0, 0.5, 1.0 - 2.0**-24]
    u[:9] = np.stack(np.meshgrid(edge, edge), axis=-1).reshape(9, 2)
    return u


def warped(kind: wp.constant, exponent: float = 0.0) -> np.ndarray:
    u = wp.array(square(), dtype=wp.vec2, device="cpu")
    result = wp.zeros(COUNT, dtype=wp.vec3, device="cpu")
    wp.launch(warp_square, COUNT, inputs=[int(kind), exponent, u], outputs=[result], device="cpu")
    values = result.numpy().astype(np.float64)
    assert np.isfinite(values).all()
    return values


def even(chi_square, height: np.ndarray, azimuth: np.ndarray, rows: int = 32, columns: int = 32) -> float:
    """p-value of (height, azimuth) being uniform over [0, 1] x [-pi, pi]."""
    counts = np.histogram2d(height, azimuth, bins=(rows, columns), range=[[0.0, 1.0], [-np.pi, np.pi]])[0]
    assert counts.sum() == len(height)
    return chi_square(counts, np.full(counts.size, len(height) / counts.size))


def test_disc_is_uniform(chi_square):
    """Points fill the unit disc evenly: r^2 and the angle are uniform."""
    p = warped(DISC)
    r2 = np.square(p[:, :2]).sum(axis=1)
    assert r2.max() < 1.0 + 8 * ULP
    assert even(chi_square, np.minimum(r2, 1.0), np.arctan2(p[:, 1], p[:, 0])) > LEVEL


def test_disc_keeps_strata_together():
    """Neighbours in the square are neighbours on the disc: the concentric map stretches by pi/2 at most.

    Shirley, Chiu 1997. A polar map, whose seam tears neighbours apart, fails.
    """
    n = 512
    grid = (np.stack(np.meshgrid(np.arange(n), np.arange(n)), axis=-1) + 0.5) / n
    u = wp.array(grid.reshape(-1, 2).astype(np.float32), dtype=wp.vec2, device="cpu")
    result = wp.zeros(n * n, dtype=wp.vec3, device="cpu")
    wp.launch(warp_square, n * n, inputs=[int(DISC), 0.0, u], outputs=[result], device="cpu")
    p = result.numpy().astype(np.float64).reshape(n, n, 3)
    # along x at (a, b), |b| > |a|: |d/da (b cos, b sin)(pi a / 4 b)| = pi/4, and b <= 1; doubled by the square's side 2
    step = max(np.linalg.norm(np.diff(p, axis=axis), axis=2).max() for axis in (0, 1))
    assert step < np.sqrt(1.0 + (np.pi / 4) ** 2) * 2.0 / n * 1.001


def test_cosine_hemisphere(chi_square):
    """Directions have pdf cos / pi: sin^2 theta and the azimuth are uniform; none lies below the horizon."""
    w = warped(HEMISPHERE)
    assert w[:, 2].min() >= 0.0
    assert np.abs(np.square(w).sum(axis=1) - 1.0).max() < 8 * ULP
    assert even(chi_square, 1.0 - np.minimum(np.square(w[:, 2]), 1.0), np.arctan2(w[:, 1], w[:, 0])) > LEVEL


def test_triangle_is_uniform(chi_square):
    """Barycentric coordinates are positive, sum to 1 and fill 1024 congruent parts of the triangle evenly."""
    b = warped(TRIANGLE)
    assert b.min() >= 0.0
    assert np.abs(b.sum(axis=1) - 1.0).max() < 4 * ULP
    n = 32
    cell = np.minimum(np.floor(b[:, :2] * n).astype(int), n - 1)
    # each small parallelogram of the grid has an upward and a downward half
    down = (b[:, :2] * n - cell).sum(axis=1) > 1.0
    counts = np.bincount((cell[:, 0] * n + cell[:, 1]) * 2 + down, minlength=2 * n * n).reshape(n, n, 2)
    i, j = np.indices((n, n))
    inside = np.stack([i + j < n, i + j < n - 1], axis=-1)
    assert inside.sum() == n * n
    assert counts[~inside].sum() <= 10  # rounding at the hypotenuse
    assert chi_square(counts[inside], np.full(n * n, counts[inside].sum() / n**2)) > LEVEL


@pytest.mark.parametrize("exponent", [1.0, 20.0, 1000.0])
def test_blinn_half_vector(chi_square, exponent):
    """Half vectors have pdf (e+1)/(2 pi) cos^e: cos^(e+1) and the azimuth are uniform."""
    h = warped(BLINN, exponent)
    assert h[:, 2].min() >= 0.0
    assert np.abs(np.square(h).sum(axis=1) - 1.0).max() < 8 * ULP
    # rounding of cos moves the height by (e+1) ulps, far less than a cell
    height = np.minimum(h[:, 2], 1.0) ** (exponent + 1.0)
    assert even(chi_square, height, np.arctan2(h[:, 1], h[:, 0])) > LEVEL


@pytest.mark.parametrize("exponent", [1e4, 1e5])
def test_sharp_blinn_half_vector_has_no_rings(chi_square, exponent):
    """At the smallest roughness that Conductor allows, sin theta of the half vector still follows the pdf.

    1 - cos^2 of a rounded cosine comes in steps of 2^-23: rings around the highlight, each (e+1) 2^-24 of the
    probability.
    """
    h = warped(BLINN, exponent)
    height = np.exp(0.5 * (exponent + 1.0) * np.log1p(-np.square(h[:, :2]).sum(axis=1)))
    assert even(chi_square, height, np.arctan2(h[:, 1], h[:, 0])) > LEVEL


def normals() -> np.ndarray:
    """Random unit vectors, the axes, and vectors closer and closer to both poles; float32, both signs of zero."""
    rng = np.random.default_rng(3)
    n = rng.normal(size=(100_000, 3))
    near = np.zeros((400, 3))
    near[:, :2] = rng.normal(size=(400, 2)) * np.logspace(-10, -1, 400)[:, None]
    near[:, 2] = 1.0
    axes = np.concatenate([np.eye(3), -np.eye(3)])
    flat = rng.normal(size=(1000, 3)) * [1.0, 1.0, 0.0]
    n = np.concatenate([n, near, -near, axes, flat, -flat])
    return (n / np.linalg.norm(n, axis=1, keepdims=True)).astype(np.float32)


def test_frames_are_orthonormal_and_right_handed():
    """s, t, n are unit vectors at right angles with s x t = n for every normal, near -z as well."""
    n = normals()
    s, t, w = (wp.zeros(len(n), dtype=wp.vec3, device="cpu") for _ in range(3))
    v = np.array([0.25, -0.5, 2.0])
    inputs = [wp.array(n, dtype=wp.vec3, device="cpu"), wp.vec3(*v)]
    wp.launch(make_frames, len(n), inputs=inputs, outputs=[s, t, w], device="cpu")
    f = np.stack([s.numpy(), t.numpy(), n], axis=1).astype(np.float64)
    # n itself is rounded by half an ulp per component; the frame multiplies and adds about ten such numbers
    assert np.abs(f @ f.swapaxes(1, 2) - np.eye(3)).max() < 20 * ULP
    assert np.abs(np.cross(f[:, 0], f[:, 1]) - f[:, 2]).max() < 20 * ULP
    assert np.abs(w.numpy() - v @ f).max() < 20 * ULP


def test_power_heuristic_shares_out_one():
    """w(a, b) = a^2 / (a^2 + b^2), w(a, b) + w(b, a) = 1, for densities from 1e-30 to 1e30 and for one of them 0."""
    values = np.concatenate([[0.0], np.logspace(-30, 30, 121)]).astype(np.float32)
    a, b = (x.ravel()[1:] for x in np.meshgrid(values, values))  # without 0, 0: no technique finds such a sample
    weights = []
    for x, y in ((a, b), (b, a)):
        w = wp.zeros(len(a), dtype=float, device="cpu")
        inputs = [wp.array(x, dtype=float, device="cpu"), wp.array(y, dtype=float, device="cpu")]
        wp.launch(weigh, len(a), inputs=inputs, outputs=[w], device="cpu")
        weights.append(w.numpy())
    assert np.isfinite(weights).all()
    assert np.min(weights) >= 0.0
    assert np.max(weights) <= 1.0
    assert np.abs(weights[0] + weights[1] - 1.0).max() < 4 * ULP
    a, b = a.astype(np.float64), b.astype(np.float64)
    assert np.abs(weights[0] - a * a / (a * a + b * b)).max() < 8 * ULP
