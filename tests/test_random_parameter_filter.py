"""Random parameter filtering: its statistics against direct evaluation, its energy, its neighbourhoods."""

from __future__ import annotations

import numpy as np
import pytest
from buffers import halves, plane

import warpgi as gi
from warpgi.kernels import random_parameter_filter as kernels

BINS, OUTPUTS = 5, 15
FIRST = 24 * 12 + 4  # in the middle of the picture, where every sample meets a wall


@pytest.fixture(scope="module")
def state():
    """The filter after its first box on the first pixels of a small Cornell box."""
    samples = gi.sample(gi.scenes.cornell_box(), spp=4, size=(24, 24), seed=2)
    method = gi.RandomParameterFilter(neighbours=256, boxes=(17,), variance=0.3)
    filtering = method.reconstruction(samples, gi.Device("cpu"), 5)
    filtering._filter(0, FIRST, FIRST + 16)
    return filtering


def columns(filtering):
    """The 19 columns of every sample, as float64."""
    s = filtering.struct
    vectors = (
        filtering.rows.value,
        *(getattr(s, name).numpy() for name in ("position", "normal", "hit", "hit_normal")),
    )
    return np.concatenate([*vectors, s.parameters.numpy()], axis=1).astype(np.float64)


def neighbourhood(filtering, i):
    found = filtering.found
    return found.sample.numpy()[i * found.size : i * found.size + found.count.numpy()[i]]


def mutual_information(a, b):
    """In nats, less the mean of what chance gives (Miller 1955)."""
    joint = np.zeros((BINS, BINS))
    np.add.at(joint, (a, b), 1)
    p = joint / joint.sum()
    independent = p.sum(axis=1, keepdims=True) * p.sum(axis=0, keepdims=True)
    full = p > 0
    value = (p[full] * np.log(p[full] / independent[full])).sum()
    used = [np.count_nonzero(joint.sum(axis=axis)) for axis in (0, 1)]
    return max(0.0, value - (used[0] - 1) * (used[1] - 1) / (2 * joint.sum()))


def test_neighbourhoods(state):
    """Own samples come first; the others lie in the box, alike the pixel's mean, and crowd around it."""
    table, offsets = columns(state), []
    for i in range(16):
        pixel = FIRST + i
        chosen = neighbourhood(state, i)
        own = np.arange(4 * pixel, 4 * pixel + 4)
        np.testing.assert_array_equal(chosen[:4], own)
        mean, sigma = table[own].mean(axis=0), table[own].std(axis=0)
        spread = np.array(list(state.struct.spread))
        sigmas = np.repeat([30.0, 3.0, 30.0, 3.0], 3)
        limit = np.maximum(sigmas * sigma[3:15], 0.1 * spread[3:15])
        assert (np.abs(table[chosen] - mean)[:, 3:15] <= limit * (1 + 1e-4) + 1e-6).all()
        x, y = (chosen // 4) % 24 - pixel % 24, chosen // 4 // 24 - pixel // 24
        assert max(np.abs(x).max(), np.abs(y).max()) <= 8
        offsets.append(x[4:])
    # sigma is 17 / 4, cut at 8.5: 3.75; what features refuse makes it less
    assert 1.0 < np.concatenate(offsets).std() < 3.8


def test_dependencies_are_mutual_information(state):
    """Each output's dependency on random parameters, screen position and colours is that of numpy's histograms."""
    table, found = columns(state), state.found
    dependency = found.dependency.numpy().reshape(-1, OUTPUTS, 3)
    for i in (0, 7, 15):
        values = table[neighbourhood(state, i)]
        sigma = values.std(axis=0)
        normalised = np.where(sigma > 1e-4 * np.array(list(state.struct.spread)), values - values.mean(axis=0), 0.0)
        normalised = normalised / np.where(sigma > 0, sigma, 1.0)
        bins = np.clip(np.round((normalised + 2.0) / 4.0 * (BINS - 1)), 0, BINS - 1).astype(int)
        for k in range(OUTPUTS):
            groups = ((15, 16), (17, 18), (0, 1, 2) if k >= 3 else ())
            expected = [sum(mutual_information(bins[:, k], bins[:, c]) for c in group) for group in groups]
            # a value at the border of two bins may fall into either: one of some hundred samples
            np.testing.assert_allclose(dependency[i, k], expected, atol=0.04)


def test_weights_follow_the_formula(state):
    """Filtered samples are the weighted means of Sen, Darabi 2011, evaluated in float64 from the same statistics."""
    table, found = columns(state), state.found
    dependency = found.dependency.numpy().reshape(-1, OUTPUTS, 3).astype(np.float64)
    for i in (0, 7, 15):
        chosen = neighbourhood(state, i)
        inverse = found.inverse_sigma.numpy()[i].astype(np.float64)
        d = dependency[i]
        random, screen, features = d[:3, 0].sum(), d[:3, 1].sum(), d[3:, 2].sum()
        by_random = random / (random + screen)
        alpha = max(0.0, 1.0 - by_random)
        own = d[3:, 0] / np.maximum(d[3:, 0] + d[3:, 1], 1e-10)
        beta = d[3:, 2] / (random + screen + features) * np.maximum(0.0, 1.0 - own)
        # sigma^2 = 8 sigma_8^2 / spp / (1 - W)^2
        variance = 8.0 * 0.3 / 4.0 / (1.0 - by_random) ** 2
        normalised = table[:, :15] * inverse[:15]
        pixel = FIRST + i
        expected = []
        for row in range(4 * pixel, 4 * pixel + 4):
            squares = np.square(normalised[chosen] - normalised[row])
            e = (alpha * squares[:, :3].sum(axis=1) + squares[:, 3:] @ beta) / (2.0 * variance)
            w = np.exp(-e)
            expected.append((w[:, None] * table[chosen, :3]).sum(axis=0) / w.sum())
        device, filtered = state.device, state.device.zeros(len(table), kernels.wp.vec3)
        inputs = [4 * pixel, state.struct, state.value, found, 1.0, 4 / (16 * 0.3)]
        device.launch(kernels.filter_samples, 4, inputs, [filtered, state.filled])
        np.testing.assert_allclose(filtered.numpy()[4 * pixel : 4 * pixel + 4], expected, rtol=1e-4)


def test_outliers_are_clamped_and_given_back():
    """A sample beyond one standard deviation takes the mean; re-insertion keeps the pixel's mean, which else falls."""
    samples = plane(1, 1, 8, radiance=lambda x, y: np.arange(8)[:, None] ** 3 * np.ones(3) / 100.0)
    device = gi.Device("cpu")
    struct = gi.RandomParameterFilter().reconstruction(samples, device, 0).struct
    values = samples.radiance.copy()
    mean, sigma = values.mean(axis=0), values.std(axis=0)
    outlier = np.abs(values - mean)[:, 0] > sigma[0]
    assert 0 < outlier.sum() < 4
    clamped = np.where(outlier[:, None], mean, values)
    for reinsert, expected in ((0, clamped), (1, clamped + (mean - clamped.mean(axis=0)))):
        array = device.array(values, kernels.wp.vec3)
        device.launch(kernels.clamp_outliers, 1, [0, struct, reinsert], [array])
        np.testing.assert_allclose(array.numpy(), expected, rtol=1e-5)
    assert clamped.mean() < 0.9 * values.mean()


def test_energy_without_reinsertion():
    """With the paper's own weights, clamping loses a good part of the light, "up to 50 %" (Lehtinen et al. 2012)."""
    samples = gi.sample(gi.scenes.cornell_box(), spp=8, size=(24, 24))
    means = [
        gi.reconstruct(samples, gi.RandomParameterFilter(variance=0.02, reinsert=reinsert)).layers["indirect"].mean()
        for reinsert in (False, True)
    ]
    assert 0.5 * means[1] < means[0] < 0.9 * means[1]


def test_noise_goes_and_what_the_screen_shows_stays():
    """Radiance that only the random direction decides is blurred; a step over the screen is kept, at the same size."""
    noisy = plane(32, 24, 8, seed=4)
    up = noisy.direction[:, :1]
    by_direction = plane(32, 24, 8, seed=4, radiance=lambda x, y: np.where(up > 0, 1.0, 0.0) * np.ones(3))
    by_place = plane(32, 24, 8, seed=4, radiance=halves(0.0, 1.0, edge=16.0))
    method = gi.RandomParameterFilter()

    def rms(samples, expected):
        picture = gi.reconstruct(samples, method).layers["indirect"][..., 0]
        return float(np.sqrt(np.mean((picture - expected) ** 2)))

    before = gi.ATrous(iterations=1).reconstruction(by_direction, gi.Device("cpu"), 0).picture()[..., 0]
    assert rms(by_direction, 0.5) < 0.5 * np.sqrt(np.mean((before - 0.5) ** 2))
    step = (np.arange(32) >= 16).astype(float)
    assert rms(by_place, step) < 0.1


def test_the_seed_draws_the_neighbours():
    """Another seed gives another picture, the same seed the same."""
    samples = gi.sample(gi.scenes.cornell_box(), spp=2, size=(12, 12))
    one, again, other = (
        gi.reconstruct(samples, gi.RandomParameterFilter(), seed=seed).layers["indirect"] for seed in (1, 1, 2)
    )
    np.testing.assert_array_equal(one, again)
    assert (one != other).any()


def test_the_papers_neighbourhoods():
    """Without a limit a neighbourhood has half of the samples in the box."""
    method = gi.RandomParameterFilter(neighbours=None)
    assert [method.neighbourhood(box, 8) - 8 for box in method.boxes] == [12100, 4900, 1156, 196]
    assert gi.RandomParameterFilter(neighbours=300).neighbourhood(55, 8) == 308


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"boxes": ()}, "boxes is"),
        ({"boxes": (4,)}, "boxes holds 4"),
        ({"boxes": (1001,)}, "boxes is 1001"),
        ({"neighbours": 0}, "neighbours is 0"),
        ({"variance": 0.0}, "variance is 0"),
    ],
)
def test_settings_out_of_range(settings, message):
    """Each setting has its range."""
    with pytest.raises(ValueError, match=message):
        gi.RandomParameterFilter(**settings)
