"""Statistical tests of pictures: is a difference noise?"""

from __future__ import annotations

import numpy as np

# Two-sided, 1e-5 for one normal variable: a thousand such tests fail by chance once in a hundred choices of seeds.
Z_LIMIT = 4.4


def mean_z(image, variance, expected):
    """How many standard errors the mean of an image, over pixels, is away from the expected value, per channel.

    `variance` is that of each pixel's mean; pixels are independent.
    """
    image, variance = (np.asarray(x, dtype=np.float64).reshape(-1, x.shape[-1]) for x in (image, variance))
    standard_error = np.sqrt(variance.sum(axis=0)) / len(image)
    return (image.mean(axis=0) - expected) / np.maximum(standard_error, 1e-7 * np.abs(expected))


def two_sample_z(a, b, block=8):
    """Largest z of the difference of two renders over blocks of pixels, as a standard normal's 1e-5 quantile scale.

    Blocks make the means near normal; the limit is raised for their number by Bonferroni, so that the result is to be
    compared with Z_LIMIT.
    """
    from scipy.stats import norm

    height, width = (n // block * block for n in a.image.shape[:2])

    def blocks(x):
        x = x[:height, :width].astype(np.float64)
        return x.reshape(height // block, block, width // block, block, 3).mean(axis=(1, 3))

    difference = blocks(a.image) - blocks(b.image)
    variance = (blocks(a.layers["variance"]) + blocks(b.layers["variance"])) / block**2
    scale = 1e-6 * max(float(np.abs(a.image).mean()), 1e-30)
    z = np.abs(difference) / np.sqrt(np.maximum(variance, scale**2))
    p = min(1.0, 2.0 * norm.sf(z.max()) * z.size)
    return float(norm.isf(p / 2.0))
