"""Light-field reconstruction of glossy surfaces, against closed forms, path tracing and the diffuse reconstruction."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

import warpgi as gi
from warpgi.glossy_reconstruction import GlossyReconstruction
from warpgi.samples import SampleBuffer, unit

# Two parts of a floor, each seen from its own eye: both look at the ceiling, the second at half of what the first sees.
EYES = np.array([(0.0, -4.0, 3.0), (3.0, -3.0, 3.0)])
MIDDLES = np.array([(0.0, 0.0, 0.0), (1.75, 0.25, 0.0)])
FLOOR = gi.Conductor(2e-3, (0.9, 0.7, 0.5))
CEILING_EXPONENT = 900.0
SIZE, SPP = 40, 8


def reflect(d, n):
    return d - 2.0 * (d * n).sum(-1, keepdims=True) * n


def blinn_rays(normal, wo, material, u):
    """Directions and f cos / pdf of a rough metal by its half vectors, in numpy; shapes (..., 3)."""
    e = 1.0 / material.roughness
    cos_h = u[..., 0] ** (1.0 / (e + 1.0))
    sin_h, phi = np.sqrt(1.0 - cos_h**2), 2.0 * np.pi * u[..., 1]
    h = np.stack([sin_h * np.cos(phi), sin_h * np.sin(phi), cos_h], axis=-1)  # about the normal +z
    oh = (wo * h).sum(-1)
    d = 2.0 * oh[..., None] * h - wo
    cos_o, cos_i = (wo * normal).sum(-1), (d * normal).sum(-1)
    g = np.minimum(1.0, 2.0 * cos_h * np.minimum(cos_o, cos_i) / oh)
    f = np.asarray(material.reflectance) + (1.0 - np.asarray(material.reflectance)) * (1.0 - oh[..., None]) ** 5
    return d, f * (g * (e + 2.0) / (e + 1.0) * oh / cos_o)[..., None]


def highlight(d, sun):
    """Light that a glossy ceiling sends against rays along d: one lobe about the mirrored sun, as its BSDF would."""
    away = (reflect(d, np.array([0.0, 0.0, 1.0])) * sun).sum(-1) - 1.0
    return np.exp(0.25 * CEILING_EXPONENT * away)[..., None] * np.array([1.0, 0.8, 0.6])


@pytest.fixture(scope="module")
def ceiling():
    """A buffer of a rough metal floor that sees a glossy ceiling, and its first part's picture by quadrature."""
    rng = np.random.default_rng(3)
    up = np.array([0.0, 0.0, 1.0])
    sun = unit(np.array([[0.0, 0.8, -0.6]]))[0].astype(np.float64)
    pixel = np.arange(2 * SIZE * SIZE * SPP) // SPP
    x, y = pixel % (2 * SIZE), pixel // (2 * SIZE)
    part = x // SIZE
    origin = np.zeros((len(pixel), 3))
    origin[:, :2] = 2.0 * (np.stack([x % SIZE, y], axis=-1) + rng.random((len(pixel), 2))) / SIZE - 1.0
    origin += MIDDLES[part]
    wo = unit(EYES[part] - origin).astype(np.float64)
    d, _ = blinn_rays(up, wo, FLOOR, rng.random((len(pixel), 2)))
    samples = SampleBuffer(
        2 * SIZE,
        SIZE,
        SPP,
        radiance=highlight(d, sun).astype(np.float32),
        origin=origin.astype(np.float32),
        hit=(origin + d / d[:, 2:]).astype(np.float32),
        origin_normal=np.broadcast_to(up, origin.shape).astype(np.float32),
        hit_normal=np.broadcast_to(-up, origin.shape).astype(np.float32),
        albedo=np.ones(origin.shape, np.float32),
        bandwidth=np.full(len(pixel), CEILING_EXPONENT, np.float32),
        wo=wo.astype(np.float32),
        material=np.zeros(len(pixel), np.int32),
        reflectance=np.broadcast_to(FLOOR.reflectance, origin.shape).astype(np.float32),
        materials=(FLOOR,),
    )
    side = 24
    strata = (np.stack(np.meshgrid(np.arange(side), np.arange(side)), axis=-1).reshape(-1, 1, 2) + 0.5) / side
    rays, weight = blinn_rays(up, wo[None, part == 0][:, ::2], FLOOR, strata)
    truth = (highlight(rays, sun) * weight).mean(axis=0)
    return samples, truth.reshape(SIZE, SIZE, SPP // 2, 3).mean(axis=2)


def shape_of(picture):
    """Centroid and standard deviation of a highlight, both in pixels, shape (2,)."""
    weight = picture.sum(axis=-1, dtype=np.float64)
    at = np.stack(np.meshgrid(np.arange(SIZE), np.arange(SIZE)), axis=-1) + 0.5
    centre = (at * weight[..., None]).sum(axis=(0, 1)) / weight.sum()
    return centre, np.sqrt((np.square(at - centre) * weight[..., None]).sum(axis=(0, 1)) / weight.sum())


def test_a_highlight_keeps_place_and_width(ceiling):
    """Light that varies with direction is put where it belongs: to half a pixel, as wide as it is to 5 %.

    Taken for diffuse, the same samples blur and shift it by more.
    """
    samples, truth = ceiling
    centre, width = shape_of(truth)
    found = {}
    for bandwidth in (True, False):
        picture = gi.reconstruct(samples, gi.LightField(rays=512, bandwidth=bandwidth)).layers["indirect"][:, :SIZE]
        found[bandwidth] = shape_of(picture)
        print(bandwidth, found[bandwidth], centre, width, gi.compare(picture, truth.astype("f4")))
    assert np.abs(found[True][0] - centre).max() < 0.5
    assert np.abs(found[True][1] / width - 1.0).max() < 0.05
    assert np.abs(found[False][0] - centre).max() > 0.5
    assert np.abs(found[False][1] / width - 1.0).max() > 0.05


def test_no_bandwidth_at_all_is_the_diffuse_path():
    """A buffer whose bandwidths are 0 gives the same bits as one without: no lobe is made, and none is looked for."""
    for samples in (
        gi.sample(gi.scenes.cornell_box(), spp=4, size=(16, 16), recursive=True),
        gi.sample(gi.scenes.furnace(albedo=0.5, shape="blocks")[0], spp=4, size=(12, 12), recursive=True),
    ):
        for recursive in (0, 1):
            method = gi.LightField(rays=256, recursive=recursive)
            plain = gi.reconstruct(samples, method)
            zero = replace(samples, bandwidth=np.zeros(len(samples), np.float32))
            state = method.reconstruction(zero, gi.Device("cpu"), 0)
            assert isinstance(state, GlossyReconstruction)
            glossy = gi.reconstruct(zero, method)
            np.testing.assert_array_equal(glossy.layers["indirect"].view("u4"), plain.layers["indirect"].view("u4"))
            assert glossy.counts.pop("lobes") == 0 and glossy.counts == plain.counts
