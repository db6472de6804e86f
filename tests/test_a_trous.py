"""The À-Trous filter against its formula."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from buffers import plane

import warpgi as gi
from warpgi.reconstruction import pixel_means

SPLINE = np.array([1.0, 4.0, 6.0, 4.0, 1.0]) / 16.0


@pytest.mark.parametrize("iterations", [1, 2, 3])
def test_impulse_response_is_the_spline_cascade(iterations):
    """Without features a white pixel becomes the product of B3 splines with 0, 1, 3, ... holes between their taps."""
    side = 2 * (2 ** (iterations + 1) - 2) + 1
    light = np.zeros((side, side, 3), np.float32)
    light[side // 2, side // 2] = 1.0
    method = gi.ATrous(iterations=iterations, sigma_normal=None, sigma_position=None, demodulate=False)
    # four times as large, or the taps that lie outside would be missing
    padded = np.pad(light, ((side, side), (side, side), (0, 0)))
    picture = gi.denoise({"image": padded}, method).image[side:-side, side:-side]
    cascade = np.ones(1)
    for i in range(iterations):
        taps = np.zeros(4 * 2**i + 1)
        taps[:: 2**i] = SPLINE
        cascade = np.convolve(cascade, taps)
    np.testing.assert_allclose(picture[..., 0], np.outer(cascade, cascade), rtol=1e-5, atol=1e-9)


def one_row(value, rows, step, sigmas, y, x, s):
    """One pass for sample s of pixel (x, y), as the paper writes it; features and sigmas by name."""
    height, width = value.shape[:2]
    total, weight = np.zeros(3), 0.0
    for dy in range(-2, 3):
        for dx in range(-2, 3):
            v, u = y + dy * step, x + dx * step
            if 0 <= v < height and 0 <= u < width:
                e = sum(
                    np.square(feature[v, u] - feature[y, x, s]).sum(axis=-1) / sigmas[name] ** 2
                    for name, feature in rows.items()
                )
                w = SPLINE[dy + 2] * SPLINE[dx + 2] * np.exp(-e)
                total += (w[:, None] * value[v, u]).sum(axis=0)
                weight += w.sum()
    return total / weight


def test_passes_follow_the_formula():
    """Two passes over random samples, with all four terms, are those of a direct evaluation in float64."""
    rng = np.random.default_rng(3)
    normal = rng.normal(size=(6 * 5 * 3, 3)) * 0.3 + (0, 0, 1)
    hit_normal = rng.normal(size=(6 * 5 * 3, 3)) * 0.3 - (0, 0, 1)
    samples = plane(6, 5, 3, origin_normal=normal.astype(np.float32), hit_normal=hit_normal.astype(np.float32))
    method = gi.ATrous(iterations=2, sigma_normal=0.7, sigma_position=2.0, sigma_color=1.5, sigma_hit_normal=1.1)
    grid = (5, 6, 3, 3)
    value = samples.radiance.reshape(grid).astype(np.float64)
    state = method.reconstruction(samples, gi.Device("cpu"), 0)
    footprint = state.rows.footprint().reshape(5, 6, 3, 1).astype(np.float64)
    assert np.ptp(footprint) > 0
    expected = value
    for i in range(2):
        # a row's own footprint is the scale of its distances
        sigmas = {"n": 0.7, "c": 1.5 * value.mean() / 2**i, "h": 1.1 / 2**i}
        rows = {
            "n": samples.unit_origin_normal.reshape(grid).astype(np.float64),
            "c": expected,
            "h": samples.unit_hit_normal.reshape(grid).astype(np.float64),
        }
        result = np.zeros(grid)
        for y, x, s in np.ndindex(5, 6, 3):
            with_position = rows | {"x": samples.origin.reshape(grid).astype(np.float64)}
            scaled = sigmas | {"x": 2.0 * footprint[y, x, s, 0]}
            result[y, x, s] = one_row(expected, with_position, 2**i, scaled, y, x, s)
        expected = result
    picture = gi.reconstruct(samples, method).layers["indirect"]
    np.testing.assert_allclose(picture, expected.mean(axis=2), rtol=2e-5)


def test_wide_passes_use_every_sample_once():
    """A wide pass looks at one sample of a tap, and no two samples of a pixel at the same: where features are alike,
    their mean is that of the pixels' means."""
    samples = plane(40, 40, 5)
    method = gi.ATrous(iterations=3, sigma_normal=None, sigma_position=None)
    one_by_one = method.reconstruction(samples, gi.Device("cpu"), 0)
    one_by_one.gather(2, 1, 3)
    mean = pixel_means(samples, samples.radiance)
    whole = replace(method, demodulate=False).on_layers({"image": mean}, "image", gi.Device("cpu"))
    whole.gather(2, 1, 3)
    np.testing.assert_allclose(one_by_one.picture(), whole.picture(), rtol=1e-5)
    # a sample by itself saw 25 others, not 125
    spread = one_by_one.value.numpy().reshape(40, 40, 5, 3)[10:30, 10:30].std(axis=2).mean()
    assert spread > 0.05


def test_the_secondary_normal_keeps_light_apart():
    """Samples that see another wall are another population: each keeps its mean, where without the term they mix."""
    count = 24 * 16 * 4
    ceiling = np.arange(count) % 2 == 0
    hit_normal = np.where(ceiling[:, None], (0.0, -1.0, 0.0), (1.0, 0.0, 0.0)).astype(np.float32)
    # left of the edge one wall glows, right of it the other
    left = (np.arange(count) // 4) % 24 < 12
    glow = np.where(ceiling == left, 1.0, 0.0)[:, None] * np.ones(3)
    samples = plane(radiance=lambda x, y: glow, hit_normal=hit_normal)
    state = gi.ATrous(iterations=3, sigma_hit_normal=0.2).reconstruction(samples, gi.Device("cpu"), 0)
    state.gather(0, 3, 3)
    value = state.value.numpy()[:, 0].reshape(16, 24, 4)
    # reach is 14 pixels, so at the far side there is one population's own light left
    apart = value[:, 0, 0], value[:, 0, 1], value[:, 23, 0], value[:, 23, 1]
    for values, expected in zip(apart, (1.0, 0.0, 0.0, 1.0), strict=True):
        assert np.abs(values - expected).max() < 0.2
    mixed = gi.ATrous(iterations=3).reconstruction(samples, gi.Device("cpu"), 0)
    mixed.gather(0, 3, 3)
    assert np.abs(mixed.value.numpy()[:, 0] - 0.5).max() < 0.2


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"iterations": 0}, "iterations is 0"),
        ({"iterations": 11}, "iterations is 11"),
        ({"sigma_normal": 0.0}, "sigma_normal is 0"),
        ({"sigma_position": -1.0}, "sigma_position is -1"),
        ({"sigma_color": float("nan")}, "sigma_color is nan"),
        ({"sigma_hit_normal": 0.0}, "sigma_hit_normal is 0"),
    ],
)
def test_settings_out_of_range(settings, message):
    """Each setting has its range."""
    with pytest.raises(ValueError, match=message):
        gi.ATrous(**settings)
