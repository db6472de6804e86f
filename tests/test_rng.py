"""Random numbers: uniform, independent where they claim it, stratified where they claim it."""

from __future__ import annotations

import itertools

import numpy as np
import pytest
import warp as wp

from warpgi.kernels.rng import GOLDEN_GAMMA, INDEPENDENT, SOBOL, SOBOL_PAIRS, make_sampler, sample_2d, to_unit

wp.set_module_options({"enable_backward": False})

# Chance of a false alarm of one test function, shared out over the comparisons that it makes.
LEVEL = 1e-4
MODES = pytest.mark.parametrize("mode", [int(INDEPENDENT), int(SOBOL)], ids=["independent", "sobol"])


@wp.kernel
def draw(seed: int, first_pixel: int, mode: int, first_dimension: int, pairs: wp.array3d[wp.vec2]):
    pixel, index = wp.tid()
    sampler = make_sampler(seed, first_pixel + pixel, index, mode)
    for k in range(pairs.shape[2]):
        pairs[pixel, index, k] = sample_2d(sampler, first_dimension + k)


@wp.kernel
def read_keys(first_seed: int, first_pixel: int, first_sample: int, keys: wp.array3d[wp.uint64]):
    i, j, k = wp.tid()
    keys[i, j, k] = make_sampler(first_seed + i, first_pixel + j, first_sample + k, 0).key


@wp.kernel
def units(bits: wp.array[wp.uint32], values: wp.array[float]):
    i = wp.tid()
    values[i] = to_unit(bits[i])


def numbers(pixels: int, samples: int, dimensions: int, mode: int, seed: int = 1, pixel: int = 0, dimension: int = 0):
    """Shape (pixels, samples, dimensions, 2)."""
    pairs = wp.zeros((pixels, samples, dimensions), dtype=wp.vec2, device="cpu")
    wp.launch(draw, (pixels, samples), inputs=[seed, pixel, mode, dimension], outputs=[pairs], device="cpu")
    return pairs.numpy()


def keys(seeds: tuple[int, int], pixels: tuple[int, int], samples: tuple[int, int]) -> np.ndarray:
    """Stream keys of three ranges (first, count)."""
    result = wp.zeros((seeds[1], pixels[1], samples[1]), dtype=wp.uint64, device="cpu")
    inputs = [seeds[0], pixels[0], samples[0]]
    wp.launch(read_keys, result.shape, inputs=inputs, outputs=[result], device="cpu")
    return result.numpy().ravel()


def test_every_bit_pattern_lands_below_one():
    """The largest 32 bits give 1 - 2^-24, the smallest 0: a result is never 1, which would index past an array."""
    bits = wp.array(np.array([0, 255, 256, 2**31, 2**32 - 1], np.uint32), dtype=wp.uint32, device="cpu")
    values = wp.zeros(5, dtype=float, device="cpu")
    wp.launch(units, 5, inputs=[bits], outputs=[values], device="cpu")
    assert values.numpy().tolist() == [0.0, 0.0, 2.0**-24, 0.5, 1.0 - 2.0**-24]


@MODES
def test_uniform(mode, chi_square):
    """Over pixels, every pair fills the unit square evenly, in its leading and in its trailing bits."""
    pixels, dimensions = 100_000, 5
    p_values = []
    for first in (0, int(SOBOL_PAIRS) - 3):
        u = numbers(pixels, 2, dimensions, mode, dimension=first).astype(np.float64)
        assert u.min() >= 0.0
        assert u.max() < 1.0
        for index, k in itertools.product(range(2), range(dimensions)):
            x = (u[:, index, k] * 2**24).astype(np.int64)
            assert np.array_equal(x, u[:, index, k] * 2**24)
            for shift in (19, 12, 0):  # five bits each
                cells = (x >> shift) & 31
                counts = np.bincount(cells[:, 0] * 32 + cells[:, 1], minlength=1024)
                p_values.append(chi_square(counts, np.full(1024, pixels / 1024)))
    assert min(p_values) > LEVEL / len(p_values)


def test_no_stream_repeats():
    """Eight million (seed, pixel, sample) keys, most of them neighbours, start streams that nowhere overlap.

    A stream steps by the golden gamma: two overlap where the keys, counted in such steps, are less than 256 apart. Of
    random keys one in a thousand such sets would hold a pair.
    """
    found = np.concatenate(
        [
            keys((100, 1), (0, 2000), (0, 2000)),
            keys((-50, 100), (0, 200), (0, 100)),
            keys((7, 1), (2**31 - 1000, 1000), (0, 1000)),
            keys((8, 1), (0, 1000), (2**31 - 1000, 1000)),
        ]
    )
    assert len(found) == 8_000_000
    steps = np.sort(found * np.uint64(pow(int(GOLDEN_GAMMA), -1, 2**64)))
    assert np.diff(steps).min() >= 256


def joint(chi_square, a: np.ndarray, b: np.ndarray) -> float:
    """p-value of two columns of numbers being independent and uniform, by a 16 x 16 table."""
    counts = np.histogram2d(a.ravel(), b.ravel(), bins=16, range=[[0, 1], [0, 1]])[0]
    return chi_square(counts, np.full(256, a.size / 256))


def test_independent_numbers_are_independent(chi_square):
    """Between dimensions, between neighbouring pixels, samples and seeds there is no dependence."""
    u = numbers(512, 256, 4, int(INDEPENDENT))
    other_seed = numbers(512, 256, 4, int(INDEPENDENT), seed=2)
    p_values = []
    flat = u.reshape(512, 256, 8)
    for a, b in itertools.combinations(range(8), 2):
        p_values.append(joint(chi_square, flat[..., a], flat[..., b]))
    for c in range(8):
        p_values.append(joint(chi_square, flat[::2, :, c], flat[1::2, :, c]))
        p_values.append(joint(chi_square, flat[:256, :, c], flat[256:, :, c]))
        p_values.append(joint(chi_square, flat[:, ::2, c], flat[:, 1::2, c]))
        p_values.append(joint(chi_square, flat[..., c], other_seed.reshape(512, 256, 8)[..., c]))
    p_values.append(joint(chi_square, flat[1:, :255, 0], flat[:-1, 1:, 0]))  # along the diagonal
    assert min(p_values) > LEVEL / len(p_values)


def test_sobol_pixels_and_pairs_are_independent(chi_square):
    """A given sample's numbers depend neither on those of the neighbouring pixel nor on those of another pair."""
    u = numbers(65536, 4, 4, int(SOBOL)).reshape(65536, 4, 8)
    p_values = []
    for index in range(4):
        for a, b in itertools.combinations(range(8), 2):
            p_values.append(joint(chi_square, u[:, index, a], u[:, index, b]))
        for c in range(8):
            p_values.append(joint(chi_square, u[::2, index, c], u[1::2, index, c]))
            p_values.append(joint(chi_square, u[:32768, index, c], u[32768:, index, c]))
    assert min(p_values) > LEVEL / len(p_values)


def test_sobol_pairs_are_uncorrelated_within_a_pixel():
    """Over one pixel's samples two pairs have no correlation, in the mean and beyond what shuffling allows.

    An Owen shuffle moves whole blocks: where the leading bits agree, both samples of a block agree. That doubles the
    variance of their correlation, so over n samples the variance of r lies between 1/n and 2/n.
    """
    pixels, n = 400, 256
    u = numbers(pixels, n, 6, int(SOBOL)).reshape(pixels, n, 12) - 0.5
    z = []
    for a, b in itertools.combinations(range(12), 2):
        if a // 2 == b // 2:
            continue
        r = 12.0 * (u[..., a] * u[..., b]).mean(axis=1)
        z.append(r.mean() / (r.std() / np.sqrt(pixels)))
        # a sample variance of so many values has a relative standard error of sqrt(2 / pixels)
        assert r.var() < 2.0 / n * (1.0 + 5.0 * np.sqrt(2.0 / pixels))
    assert np.abs(z).max() < 4.9  # 1e-6 each, 60 of them


def test_sobol_prefixes_are_nets():
    """Of the first 2^m samples, and of each aligned block of so many, every elementary interval holds just one.

    Elementary intervals are the 2^-k x 2^-(m-k) cells, k = 0 to m (Niederreiter 1987): a (0, m, 2)-net in base 2.
    """
    pixels, size = 3, 10
    u = numbers(pixels, 2 ** (size + 1), int(SOBOL_PAIRS), int(SOBOL), pixel=1000)
    bits = (u.astype(np.float64) * 2**24).astype(np.int64).swapaxes(1, 2)  # (pixel, pair, sample, 2)
    for m in range(size + 1):
        blocks = bits.reshape(pixels, int(SOBOL_PAIRS), -1, 2**m, 2)
        for k in range(m + 1):
            cell = ((blocks[..., 0] >> (24 - k)) << (m - k)) | (blocks[..., 1] >> (24 - m + k))
            assert (np.sort(cell, axis=-1) == np.arange(2**m)).all(), (m, k)


def test_sobol_pixels_and_pairs_are_scrambled_apart():
    """No two of 4096 pixels, nor two pairs of one pixel, share the points of their first 16 samples."""
    u = numbers(4096, 16, int(SOBOL_PAIRS), int(SOBOL))
    bits = (u.astype(np.float64) * 2**24).astype(np.int64).swapaxes(1, 2).reshape(-1, 16, 2)
    as_sets = np.sort(bits[..., 0] << 24 | bits[..., 1], axis=1)
    assert len(np.unique(as_sets, axis=0)) == len(as_sets)
    # unscrambled, the 16 numbers of a block differ in their leading four bits alone, and an exclusive or by one number
    # leaves it so; Owen scrambling does not
    rest = np.sort(bits[..., 0] & 0xFFFFF, axis=1)
    assert (np.diff(rest, axis=1) == 0).mean() < 1e-3


def test_beyond_the_sobol_pairs_modes_agree():
    """A dimension past SOBOL_PAIRS is the independent number in both modes; one before it never is."""
    last = int(SOBOL_PAIRS)
    a = numbers(64, 64, last + 4, int(INDEPENDENT))
    b = numbers(64, 64, last + 4, int(SOBOL))
    assert np.array_equal(a[:, :, last:], b[:, :, last:])
    assert (a[:, :, :last] == b[:, :, :last]).mean() < 1e-5


def test_error_falls_at_the_stated_rates():
    """The RMS error of a smooth integral falls as n^-1/2 for independent samples, nearly as n^-3/2 for Sobol pairs.

    Owen 1997: the variance of a scrambled net is O(n^-3 log n), which over these n is a slope of about -1.4. With 400
    pixels an RMS is known to 1 / sqrt(800), a slope over six octaves to 0.02. The mean error is 0: no bias.
    """
    counts = 2 ** np.arange(4, 11)
    slopes = []
    for mode in (int(INDEPENDENT), int(SOBOL)):
        u = numbers(400, counts[-1], 2, mode)[:, :, 1].astype(np.float64)
        values = np.exp(u[..., 0] + u[..., 1] * u[..., 0])
        # int int e^(x + xy) dx dy, by Gauss-Legendre
        x, w = np.polynomial.legendre.leggauss(20)
        x, w = 0.5 * (x + 1.0), 0.5 * w
        exact = (np.exp(x[:, None] * (1.0 + x[None, :])) * w[:, None] * w[None, :]).sum()
        errors = np.stack([values[:, :n].mean(axis=1) - exact for n in counts])
        rms = np.sqrt(np.square(errors).mean(axis=1))
        assert (np.abs(errors.mean(axis=1)) < 4.9 * rms / np.sqrt(400)).all()
        slopes.append(np.polyfit(np.log(counts), np.log(rms), 1)[0])
    assert slopes[0] == pytest.approx(-0.5, abs=0.08)
    assert -1.6 < slopes[1] < -1.3
