"""Reflection and refraction: samplers follow their pdf, BSDFs are reciprocal and keep energy, Fresnel is exact."""

from __future__ import annotations

import numpy as np
import pytest
import warp as wp

from warpgi.coat import POWERS, coat_albedo, fit_coat
from warpgi.coat import fresnel as fresnel_outside
from warpgi.kernels import bsdf as kernels
from warpgi.kernels.scene import COATED, CONDUCTOR, DIELECTRIC, DIFFUSE, MIRROR, ShapeRecord

wp.set_module_options({"enable_backward": False})

# Chance of a false alarm of the chi-square tests of this file, of which there are fewer than thirty.
LEVEL = 1e-4 / 30
COUNT = 400_000
ULP = 2.0**-24

# eta, k of a metal, roughly gold's
ETA, K = np.array([0.14, 0.37, 1.44]), np.array([3.98, 2.45, 1.6])
CONDUCTORS = [1.0, 0.05, 0.01]
CASES = ["diffuse", *map(str, CONDUCTORS), *(f"coated {roughness}" for roughness in CONDUCTORS)]
ANGLES = [0.0, 30.0, 60.0, 85.0, 89.5]


@wp.kernel
def sample_bsdf(
    shape: ShapeRecord,
    albedo: wp.vec3,
    n: wp.vec3,
    wo: wp.array[wp.vec3],
    u: wp.array[wp.vec2],
    wi: wp.array[wp.vec3],
    weight: wp.array[wp.vec3],
    rest: wp.array[wp.vec3],
):
    i = wp.tid()
    s = kernels.sample(shape, albedo, n, wo[i], u[i])
    wi[i] = s.wi
    weight[i] = s.weight
    rest[i] = wp.vec3(s.pdf, float(s.transmitted), s.eta)


@wp.kernel
def evaluate_bsdf(
    shape: ShapeRecord,
    albedo: wp.vec3,
    n: wp.vec3,
    wo: wp.array[wp.vec3],
    wi: wp.array[wp.vec3],
    value: wp.array[wp.vec3],
    pdf: wp.array[float],
):
    i = wp.tid()
    value[i] = kernels.evaluate(shape, albedo, n, wo[i], wi[i])
    pdf[i] = kernels.pdf(shape, n, wo[i], wi[i])


@wp.kernel
def fresnel(cos: wp.array[float], eta: wp.array[float], k: wp.array[float], result: wp.array[wp.vec3]):
    i = wp.tid()
    r = kernels.fresnel_schlick(cos[i], wp.vec3(k[i]))[0]
    result[i] = wp.vec3(kernels.fresnel_conductor(cos[i], eta[i], k[i]), kernels.fresnel_dielectric(cos[i], eta[i]), r)


def vectors(values: np.ndarray) -> wp.array:
    return wp.array(np.ascontiguousarray(values, np.float32), dtype=wp.vec3, device="cpu")


def record(kind: wp.constant, roughness: float = 1.0, measured: bool = False, ior: float = 1.5) -> ShapeRecord:
    shape = ShapeRecord()
    shape.kind = int(kind)
    shape.exponent = 1.0 / roughness
    shape.ior = ior
    if measured:
        shape.eta, shape.k = wp.vec3(*ETA), wp.vec3(*K)
    if kind == COATED:
        coat = fit_coat(roughness, ior)
        shape.eta, shape.k = wp.vec3(*coat.coefficients[:3]), wp.vec3(*coat.coefficients[3:])
        shape.coat = wp.vec3(coat.excess, 1.0 / coat.transmitted, coat.internal)
    return shape


def unit(v: np.ndarray) -> np.ndarray:
    v = np.asarray(v, np.float64)
    return v / np.linalg.norm(v, axis=-1, keepdims=True)


def sample(shape: ShapeRecord, wo: np.ndarray, n: np.ndarray, count: int = COUNT, albedo: float = 1.0, seed: int = 0):
    """wi (N, 3), weight (N, 3), pdf, transmitted and eta (N,), float64; `wo` is one direction or one for each."""
    wo = np.broadcast_to(wo, (count, 3))
    u = wp.array(np.random.default_rng(seed).random((count, 2), dtype=np.float32), dtype=wp.vec2, device="cpu")
    out = [wp.zeros(count, dtype=wp.vec3, device="cpu") for _ in range(3)]
    inputs = [shape, wp.vec3(albedo), wp.vec3(*n), vectors(wo), u]
    wp.launch(sample_bsdf, count, inputs=inputs, outputs=out, device="cpu")
    wi, weight, rest = (x.numpy().astype(np.float64) for x in out)
    for values in (weight, rest, wi):
        assert np.isfinite(values).all()
    return wi, weight, rest[:, 0], rest[:, 1], rest[:, 2]


def evaluate(shape: ShapeRecord, wo: np.ndarray, wi: np.ndarray, n: np.ndarray, albedo: float = 1.0):
    """f cos (N, 3) and pdf (N,), float64."""
    value = wp.zeros(len(wi), dtype=wp.vec3, device="cpu")
    pdf = wp.zeros(len(wi), dtype=float, device="cpu")
    wo = np.broadcast_to(wo, wi.shape)
    inputs = [shape, wp.vec3(albedo), wp.vec3(*n), vectors(wo), vectors(wi)]
    wp.launch(evaluate_bsdf, len(wi), inputs=inputs, outputs=[value, pdf], device="cpu")
    return value.numpy().astype(np.float64), pdf.numpy().astype(np.float64)


# A normal along no axis, and two tangents, so that no test is of a special frame.
N = unit(np.array([0.3, -0.8, -0.52]))
S = unit(np.cross(N, [0.2, 0.3, 0.9]))
T = np.cross(N, S)


def around(theta: np.ndarray, phi: np.ndarray) -> np.ndarray:
    """Directions by angle from the normal and azimuth, shape (..., 3)."""
    x, y, z = np.sin(theta) * np.cos(phi), np.sin(theta) * np.sin(phi), np.cos(theta)
    return x[..., None] * S + y[..., None] * T + z[..., None] * N


def towards(degrees: float) -> np.ndarray:
    """A viewer at this angle from the normal; the mirror direction then lies at azimuth 0."""
    return around(np.radians(degrees), np.array(np.pi))


def edges(values: np.ndarray, low: float, high: float, count: int) -> np.ndarray:
    """Cell borders that hold about equal parts of pilot `values`, and ever wider steps where there are few or none."""
    inner = np.quantile(values, np.linspace(0.0, 1.0, count + 1))
    lower, upper = inner[0] - low, high - inner[-1]
    steps = np.array([1.0, 0.5, 0.2, 0.08, 0.03])
    return np.unique(np.concatenate([inner[0] - lower * steps, inner, inner[-1] + upper * steps, [low, high]]))


def integrate(function, theta: np.ndarray, phi: np.ndarray, order: int) -> np.ndarray:
    """Solid-angle integral of `function` of directions over each cell, by Gauss-Legendre, shape (theta, phi)."""
    x, w = np.polynomial.legendre.leggauss(order)
    t = 0.5 * (theta[:-1, None] + theta[1:, None] + x * np.diff(theta)[:, None])
    p = 0.5 * (phi[:-1, None] + phi[1:, None] + x * np.diff(phi)[:, None])
    weight = (0.5 * np.diff(theta)[:, None] * w * np.sin(t))[:, :, None, None] * (0.5 * np.diff(phi)[:, None] * w)
    grid = np.broadcast_arrays(t[:, :, None, None], p[None, None])
    values = function(around(*(g.ravel() for g in grid))).reshape(grid[0].shape)
    return (values * weight).sum(axis=(1, 3))


def case(name: str) -> ShapeRecord:
    if name.startswith("coated"):
        return record(COATED, float(name.split()[1]))
    return record(DIFFUSE) if name == "diffuse" else record(CONDUCTOR, float(name))


@pytest.mark.parametrize("degrees", ANGLES)
@pytest.mark.parametrize("name", CASES)
def test_sample_follows_pdf(chi_square, name, degrees):
    """Directions fall into cells of the hemisphere as pdf says; what falls below the horizon is what pdf leaves out.

    Cells come from pilot samples, so that narrow lobes are resolved; the last cell is "absorbed". The pdf is smooth
    over a cell, and the horizon is a cell's border.
    """
    shape, wo = case(name), towards(degrees)
    wi, weight, pdf, _, _ = sample(shape, wo, N)
    above = (wi @ N > -4 * ULP) & (pdf > 0.0)  # at the horizon the kernel rounds its cosine
    assert (weight[~above] == 0.0).all()
    theta = np.arccos(np.clip(wi @ N, -1.0, 1.0))
    phi = np.arctan2(wi @ T, wi @ S)
    pilot, rest = np.flatnonzero(above)[:20_000], slice(40_000, None)
    theta_edges = edges(theta[pilot], 0.0, np.pi / 2, 12)
    phi_edges = edges(phi[pilot], -np.pi, np.pi, 12)
    mass, coarser = (
        integrate(lambda w: evaluate(shape, wo, w, N)[1], theta_edges, phi_edges, order) for order in (22, 16)
    )
    drawn = COUNT - 40_000
    # the integral errs by less than a tenth of a cell's standard deviation, or of one sample
    assert (np.abs(mass - coarser) * drawn < 0.1 * np.sqrt(mass * drawn + 1.0)).all()
    assert mass.sum() < 1.0 + 1e-4
    if name == "diffuse":
        assert mass.sum() == pytest.approx(1.0, abs=1e-6)
        assert above.mean() > 1.0 - 1e-5
    keep = np.arange(COUNT)[rest][above[rest]]
    counts = np.histogram2d(theta[keep], phi[keep], bins=(theta_edges, phi_edges))[0]
    counts = np.append(counts.ravel(), drawn - counts.sum())
    assert chi_square(counts, np.append(mass.ravel(), max(1.0 - mass.sum(), 0.0)) * drawn) > LEVEL


@pytest.mark.parametrize("degrees", [20.0, 80.0])
@pytest.mark.parametrize("roughness", [1e-4, 1e-5])
def test_sharp_highlight_follows_pdf(chi_square, roughness, degrees):
    """At the smallest roughness allowed, half vectors fall into rings around the normal as (e+1)/(2 pi) cos^e says.

    Half vectors are found again in float64 from wo and wi; rings hold equal probability.
    """
    wo = towards(degrees).astype(np.float32).astype(np.float64)
    wi, _, pdf, _, _ = sample(record(CONDUCTOR, roughness), wo, N)
    h = unit(wo + wi)
    n = np.float32(N).astype(np.float64)
    sin2 = np.square(np.cross(h, n / np.linalg.norm(n))).sum(axis=1)
    height = np.exp(0.5 * (1.0 / roughness + 1.0) * np.log1p(-sin2))
    assert (pdf > 0.0).mean() > 0.999
    counts = np.histogram(height, bins=32, range=(0.0, 1.0))[0]
    assert chi_square(counts, np.full(32, COUNT / 32)) > LEVEL


@pytest.mark.parametrize("degrees", ANGLES)
@pytest.mark.parametrize("name", CASES)
def test_weight_is_value_over_pdf(name, degrees):
    """A sample's weight is f cos / pdf and its pdf the one that `pdf` gives, to float32."""
    shape, wo = case(name), towards(degrees)
    wi, weight, pdf, transmitted, eta = sample(shape, wo, N, 20_000, albedo=0.7)
    used = pdf > 0.0
    value, other = evaluate(shape, wo, wi, N, albedo=0.7)
    # rounding of the half vector's cosine is raised to the exponent; a cosine near 0 carries its own rounding
    cos = wi @ N
    used &= cos > 1e-3
    tolerance = 16 * ULP * (shape.exponent + 4.0) / np.minimum(cos[used], 1.0)
    assert used.any()
    assert (np.abs(other[used] / pdf[used] - 1.0) < tolerance).all()
    assert (np.abs(value[used] - weight[used] * pdf[used, None]) <= tolerance[:, None] * value[used]).all()
    assert (transmitted == 0.0).all()
    assert (eta == 1.0).all()


@pytest.mark.parametrize("measured", [False, True])
@pytest.mark.parametrize("name", CASES)
def test_reciprocity(name, measured):
    """f(wo, wi) = f(wi, wo) for directions that see the surface, Schlick's and exact Fresnel alike."""
    shape = case(name)
    if measured and shape.kind == CONDUCTOR:
        shape.eta, shape.k = wp.vec3(*ETA), wp.vec3(*K)
    rng = np.random.default_rng(4)
    a, b = (unit(rng.normal(size=(20_000, 3))) for _ in range(2))
    # half of the pairs near to each other's mirror direction, where narrow lobes are
    b[::2] = unit(2.0 * (a[::2] @ N)[:, None] * N - a[::2] + 0.1 * rng.normal(size=(10_000, 3)))
    a, b = a.astype(np.float32).astype(np.float64), b.astype(np.float32).astype(np.float64)
    keep = (a @ N > 0.02) & (b @ N > 0.02)
    a, b = a[keep], b[keep]
    forth = evaluate(shape, a, b, N, albedo=0.7)[0] / (b @ N)[:, None]
    back = evaluate(shape, b, a, N, albedo=0.7)[0] / (a @ N)[:, None]
    # each cosine is rounded by some ULP, and is 0.02 or more; below 1e-30 a power runs out of float32
    tolerance = 16 * ULP * (shape.exponent / (unit(a + b) @ N) + 1.0 / 0.02)[:, None]
    assert (np.abs(forth - back) <= tolerance * np.maximum(forth, back) + 1e-30).all()
    assert (forth >= 0.0).all()


@pytest.mark.parametrize("roughness", [1.0, 0.3, 0.05, 0.01, 1e-3])
def test_conductor_keeps_energy(roughness):
    """A conductor of reflectance 1 never reflects more than arrives, at any angle; smooth and seen from above, all.

    With G = min(1, a, b) <= min(1, a), the albedo is at most that of V-grooves without shadowing of wi, which is 1
    (Torrance, Sparrow 1967); it falls short by what grooves shadow.
    """
    angles = np.concatenate([[0.0], np.linspace(5.0, 85.0, 17), [88.0, 89.0, 89.9]])
    mean, error = [], []
    for i, degrees in enumerate(angles):
        _, weight, _, _, _ = sample(record(CONDUCTOR, roughness), towards(degrees), N, 50_000, seed=i)
        mean.append(weight[:, 0].mean())
        error.append(weight[:, 0].std() / np.sqrt(50_000))
    mean, error = np.array(mean), np.array(error)
    # one-sided, 1e-4 over a hundred angles and roughnesses
    assert (mean < 1.0 + 4.8 * error + 8 * ULP).all()
    assert (mean > 0.0).all()
    if roughness <= 0.01:
        assert (mean[:10] > 1.0 - 2.0 * np.sqrt(roughness)).all()


@pytest.mark.parametrize("ior", [1.0, 1.5, 2.5])
@pytest.mark.parametrize("roughness", [1.0, 0.3, 0.05, 0.01, 1e-3])
def test_coated_keeps_energy(roughness, ior):
    """Coat and white base together reflect 1 less what the bound of the coat's albedo lies above it, never more.

    The bound is off by less than 0.06 at any angle, where a sharp coat is grazed, and by 0.01 up to 80 degrees.
    """
    shape = record(COATED, roughness, ior=ior)
    fit = fit_coat(roughness, ior)
    for i, degrees in enumerate([0.0, 20.0, 40.0, 60.0, 75.0, 80.0, 86.0, 89.0, 89.8]):
        _, weight, _, _, _ = sample(shape, towards(degrees), N, 50_000, seed=i)
        mean, error = weight[:, 0].mean(), weight[:, 0].std() / np.sqrt(50_000)
        cos = np.cos(np.radians(degrees))
        bound = min((1.0 - cos) ** np.array(POWERS) @ fit.coefficients, fresnel_outside(cos, ior) + fit.excess)
        slack = bound - coat_albedo([cos], 1.0 / roughness, ior)[0]
        # the albedo's own quadrature, of 128 x 48 points, is good to a thousandth
        assert mean < 1.0 + 4.8 * error + 1e-3
        assert mean == pytest.approx(1.0 - slack, abs=4.8 * error + 1e-3)
        assert -1e-4 < slack < (0.01 if degrees <= 80.0 else 0.06)


def test_coated_is_its_layers():
    """Without a coat the base is Lambert's; a smooth coat over black is its Fresnel reflectance; colours saturate.

    The base of albedo a sends out a (1 - R) / (1 - a R) of what a white one does, R being the light thrown back.
    """
    rng = np.random.default_rng(8)
    wi = around(np.arccos(np.sqrt(rng.random(2000))), 7.0 * rng.random(2000))
    wo = towards(40.0)
    value, pdf = evaluate(record(COATED, 0.1, ior=1.0), wo, wi, N, albedo=0.6)
    np.testing.assert_allclose(value[:, 0], 0.6 * (wi @ N) / np.pi, rtol=1e-5)
    np.testing.assert_allclose(pdf, (wi @ N) / np.pi, rtol=1e-5)
    for degrees in (0.0, 40.0, 70.0):
        _, weight, _, _, _ = sample(record(COATED, 1e-4), towards(degrees), N, 100_000, albedo=0.0)
        error = weight[:, 0].std() / np.sqrt(100_000)
        smooth = fresnel_outside(np.cos(np.radians(degrees)), 1.5)
        assert weight[:, 0].mean() == pytest.approx(smooth, abs=4.8 * error + 1e-3)
    r = fit_coat(0.05, 1.5).internal
    assert r == pytest.approx(0.5963, abs=2e-3)  # Duderstadt, Martin 1979, for an index of 1.5
    coat = evaluate(record(COATED), wo, wi, N, albedo=0.0)[0]
    white, grey = (evaluate(record(COATED), wo, wi, N, albedo=a)[0] - coat for a in (1.0, 0.5))
    np.testing.assert_allclose(grey, white * 0.5 * (1.0 - r) / (1.0 - 0.5 * r), rtol=1e-4, atol=1e-7)


def test_conductor_matches_the_formula():
    """f cos is F D G / (4 cos_o) with D = (e+2)/(2 pi) cos_h^e and G = min(1, 2 n.h n.wo / wo.h, 2 n.h n.wi / wo.h)."""
    rng = np.random.default_rng(6)
    for roughness, measured in ((1.0, False), (0.05, True), (0.01, False)):
        e = 1.0 / roughness
        shape = record(CONDUCTOR, roughness, measured)
        wo = unit(rng.normal(size=(5000, 3)))
        wo *= np.sign(wo @ N)[:, None]
        wi = unit(2.0 * (wo @ N)[:, None] * N - wo + np.sqrt(roughness) * rng.normal(size=(5000, 3)))
        keep = (wi @ N > 0.02) & (wo @ N > 0.02)
        wo, wi = wo[keep], wi[keep]
        h = unit(wo + wi)
        cos_h, cos_o, cos_i, oh = h @ N, wo @ N, wi @ N, (wo * h).sum(axis=1)
        g = np.minimum(1.0, np.minimum(2 * cos_h * cos_o / oh, 2 * cos_h * cos_i / oh))
        f = 0.7 + 0.3 * (1.0 - oh[:, None]) ** 5 * np.ones(3)
        if measured:
            f = np.stack([exact_fresnel(oh, complex(a, b)) for a, b in zip(ETA, K, strict=True)], axis=1)
        expected = f * ((e + 2.0) / (2.0 * np.pi) * cos_h**e * g / (4.0 * cos_o))[:, None]
        value, pdf = evaluate(shape, wo, wi, N, albedo=0.7)
        density = (e + 1.0) * cos_h**e / (8.0 * np.pi * oh)
        tolerance = 16 * ULP * (e / cos_h + 1.0 / 0.02)
        assert (np.abs(value - expected) <= tolerance[:, None] * expected + 1e-30).all()
        assert (np.abs(pdf - density) <= tolerance * density + 1e-30).all()
        assert (expected > 1e-3).mean() > 0.1


def test_nothing_is_reflected_through_the_surface():
    """Value and pdf are 0 where wo or wi lies below the surface, and for the delta lobes anywhere."""
    rng = np.random.default_rng(7)
    wo, wi = (unit(rng.normal(size=(20_000, 3))) for _ in range(2))
    below = (np.minimum(wo @ N, wi @ N)) < -4 * ULP
    for shape in (record(DIFFUSE), record(CONDUCTOR, 0.3)):
        value, pdf = evaluate(shape, wo, wi, N)
        assert (value[below] == 0.0).all()
        assert (pdf[below] == 0.0).all()
        assert (pdf[(wo @ N > 1e-3) & (wi @ N > 1e-3)] > 0.0).all()
    for kind in (MIRROR, DIELECTRIC):
        value, pdf = evaluate(record(kind), wo, wi, N)
        assert not value.any()
        assert not pdf.any()


def exact_fresnel(cos: np.ndarray, index: complex) -> np.ndarray:
    """Unpolarised reflectance by complex Snell and Fresnel in float64."""
    cos_t = np.sqrt(1.0 - (1.0 - cos * cos) / (index * index) + 0j)
    rs = (cos - index * cos_t) / (cos + index * cos_t)
    rp = (index * cos - cos_t) / (index * cos + cos_t)
    return 0.5 * (np.abs(rs) ** 2 + np.abs(rp) ** 2)


def reflectances(cos: np.ndarray, eta: np.ndarray, k: np.ndarray) -> np.ndarray:
    """Conductor, dielectric and Schlick (with k as its reflectance), shape (N, 3)."""
    cos, eta, k = (np.ascontiguousarray(x, np.float32) for x in np.broadcast_arrays(cos, eta, k))
    result = wp.zeros(cos.size, dtype=wp.vec3, device="cpu")
    inputs = [wp.array(x.ravel(), dtype=float, device="cpu") for x in (cos, eta, k)]
    wp.launch(fresnel, cos.size, inputs=inputs, outputs=[result], device="cpu")
    return result.numpy().astype(np.float64)


def test_fresnel_of_a_conductor():
    """At normal incidence ((eta-1)^2 + k^2) / ((eta+1)^2 + k^2), grazing 1, and the complex formula between."""
    eta, k = np.float32([0.14, 0.37, 1.44, 0.04, 3.0]), np.float32([3.98, 2.45, 1.6, 4.8, 0.5])
    at_normal = ((eta - 1.0) ** 2 + k**2) / ((eta + 1.0) ** 2 + k**2)
    assert reflectances(1.0, eta, k)[:, 0] == pytest.approx(at_normal, abs=16 * ULP)
    assert reflectances(0.0, eta, k)[:, 0] == pytest.approx(1.0, abs=8 * ULP)
    cos = np.linspace(0.0, 1.0, 1001, dtype=np.float32).astype(np.float64)
    for a, b in zip(eta, k, strict=True):
        r = reflectances(cos, a, b)[:, 0]
        assert np.abs(r - exact_fresnel(cos, complex(a, b))).max() < 64 * ULP
        assert r.max() <= 1.0 + 4 * ULP


def test_fresnel_of_a_dielectric():
    """((n-1)/(n+1))^2 at normal incidence, 1 at grazing and beyond the critical angle, 0.5 rs^2 at Brewster's."""
    for n in (1.33, 1.5, 2.4):
        assert reflectances(1.0, n, 0.0)[0, 1] == pytest.approx(((n - 1) / (n + 1)) ** 2, abs=8 * ULP)
        assert reflectances(0.0, n, 0.0)[0, 1] == pytest.approx(1.0, abs=8 * ULP)
        # tan of Brewster's angle is n: p-polarised light is not reflected
        brewster = np.cos(np.arctan(n))
        rs = (1.0 - n * n) / (1.0 + n * n)
        assert reflectances(brewster, n, 0.0)[0, 1] == pytest.approx(0.5 * rs * rs, abs=8 * ULP)
        # from inside, and by Stokes' reversibility the same as outside at the refracted angle
        critical = np.sqrt(1.0 - 1.0 / (n * n))
        assert (reflectances(np.linspace(0.0, critical - 1e-5, 50), 1.0 / n, 0.0)[:, 1] == 1.0).all()
        assert reflectances(critical + 1e-3, 1.0 / n, 0.0)[0, 1] < 0.95
        cos = np.linspace(0.05, 1.0, 200)
        inside = np.sqrt(1.0 - (1.0 - cos * cos) / (n * n))
        # rounding of the inner cosine is stretched by up to n^2 / cos
        assert np.abs(reflectances(cos, n, 0.0)[:, 1] - reflectances(inside, 1.0 / n, 0.0)[:, 1]).max() < 400 * ULP
        assert np.abs(reflectances(cos, n, 0.0)[:, 1] - exact_fresnel(cos, n)).max() < 100 * ULP


def test_fresnel_of_nothing():
    """An interface between equal indices reflects nothing, up to the last degree before grazing."""
    cos = np.cos(np.radians(np.linspace(0.0, 89.0, 90)))
    assert reflectances(cos, 1.0, 0.0)[:, 1].max() < 1e-6


def test_schlick_stays_near():
    """Schlick's formula is exact at both ends, never leaves [r, 1], and for gold is off by less than 0.05."""
    cos = np.linspace(0.0, 1.0, 501)
    for r in (0.0, 0.04, 0.5, 1.0):
        value = reflectances(cos, 1.0, r)[:, 2]
        assert value[0] == pytest.approx(1.0, abs=2 * ULP)
        assert value[-1] == pytest.approx(r, abs=2 * ULP)
        assert (np.diff(value) <= 2 * ULP).all()
    for eta, k in zip(ETA, K, strict=True):
        r = exact_fresnel(np.array([1.0]), complex(eta, k))[0]
        assert np.abs(reflectances(cos, 1.0, r)[:, 2] - exact_fresnel(cos, complex(eta, k))).max() < 0.05


def test_mirror_reflects_exactly():
    """The angle of reflection is the angle of incidence, wo, n and wi lie in a plane, the weight is the reflectance."""
    wo = around(np.linspace(0.0, np.radians(89.9), 2000), np.linspace(0.0, 40.0, 2000))
    wi, weight, pdf, _, _ = sample(record(MIRROR), wo, N, 2000, albedo=0.6)
    assert np.abs(wi - (2.0 * (wo @ N)[:, None] * N - wo)).max() < 8 * ULP
    assert (weight == np.float32(0.6)).all()
    assert (pdf == 0.0).all()


@pytest.mark.parametrize("ior", [1.0, 1.33, 1.5, 2.4])
@pytest.mark.parametrize("inside", [False, True])
def test_dielectric_obeys_snell_and_fresnel(ior, inside):
    """Refraction has sines in the ratio of indices, is chosen with probability 1 - F, and weighs radiance by 1/eta^2.

    From outside and from inside; where nothing can be refracted all is reflected, with weight 1.
    """
    side = -1.0 if inside else 1.0
    eta = 1.0 / ior if inside else ior
    per_angle, angles = 40_000, np.radians([0.0, 20.0, 35.0, 50.0, 65.0, 80.0, 88.0])
    wo = np.repeat(around(angles, 0.7 + angles), per_angle, axis=0) * side
    wi, weight, pdf, transmitted, crossed = sample(record(DIELECTRIC, ior=ior), wo, N, len(wo))
    through = transmitted == 1.0
    assert (pdf == 0.0).all()
    assert np.abs(np.linalg.norm(wi, axis=1) - 1.0).max() < 32 * ULP
    # reflection
    assert np.abs(wi - (2.0 * (wo @ N)[:, None] * N - wo))[~through].max(initial=0.0) < 16 * ULP
    assert (weight[~through] == 1.0).all()
    assert (crossed[~through] == 1.0).all()
    # refraction: tangential parts differ by eta alone, the sides differ
    tangent_o, tangent_i = wo - (wo @ N)[:, None] * N, wi - (wi @ N)[:, None] * N
    assert np.abs(tangent_i * eta + tangent_o)[through].max(initial=0.0) < 32 * ULP * max(eta, 1.0)
    assert ((wi @ N) * (wo @ N) < 0.0)[through].all()
    assert np.abs(weight[through] * eta**2 - 1.0).max(initial=0.0) < 8 * ULP
    assert np.abs(crossed[through] / eta - 1.0).max(initial=0.0) < 4 * ULP
    # probabilities; 14 angles for each of 4 indices share the level
    share = 1.0 - through.reshape(len(angles), per_angle).mean(axis=1)
    expected = exact_fresnel(np.cos(angles), eta)
    sigma = np.sqrt(np.maximum(expected * (1.0 - expected), 0.0) / per_angle)
    assert (np.abs(share - expected) <= 4.9 * sigma + 1e-6).all()


def test_dielectric_slab_keeps_radiance():
    """Into glass and out of it again multiplies radiance by eta^-2 eta^2 = 1 and leaves the direction as it was."""
    shape = record(DIELECTRIC, ior=1.5)
    wo = np.repeat(around(np.linspace(0.0, np.radians(85.0), 200), np.linspace(0.0, 7.0, 200)), 50, axis=0)
    first, weight, _, through, _ = sample(shape, wo, N, len(wo))
    entered = through == 1.0
    # the far side of the slab has its normal the other way
    last, out, _, left, _ = sample(shape, -first[entered], -N, int(entered.sum()), seed=1)
    left = left == 1.0
    assert left.mean() > 0.9
    assert np.abs((weight[entered] * out)[left] - 1.0).max() < 8 * ULP
    # at 85 degrees the cosine loses a digit
    assert np.abs(last + wo[entered])[left].max() < 64 * ULP / np.cos(np.radians(85.0))
