"""Error measures against closed forms."""

from __future__ import annotations

import math
import sys

import numpy as np
import pytest

from warpgi.image import encode_srgb
from warpgi.metrics import compare

SHAPE = (12, 16, 3)


def noise(seed: int = 0) -> np.ndarray:
    return np.random.default_rng(seed).random(SHAPE)


def test_equal_pictures_have_no_error():
    """A picture against itself: 0, 0, infinite and 0, for noise, black and light above 1."""
    for picture in (noise(), np.zeros(SHAPE), 50.0 * noise(1).astype(np.float32)):
        assert compare(picture, picture) == {"relmse": 0.0, "rmse": 0.0, "psnr": math.inf, "flip": 0.0}


@pytest.mark.parametrize("level", [0.05, 0.5, 40.0])
def test_constant_offset(level):
    """Reference c and picture c + d: relMSE = (0.5 d / c)^2 / (0.25 + 0.01) and RMSE = |d|."""
    offset = -0.1 * level
    errors = compare(np.full(SHAPE, level + offset), np.full(SHAPE, level))
    assert errors["relmse"] == pytest.approx((0.5 * offset / level) ** 2 / 0.26, rel=1e-12)
    assert errors["rmse"] == pytest.approx(-offset, rel=1e-12)


def test_relmse_of_two_levels():
    """Half the reference at 0, half at 2, picture 0.2 above: scaled by a half, 0.01 / 0.01 and 0.01 / 1.01, halved."""
    reference = np.zeros(SHAPE)
    reference[:6] = 2.0
    assert compare(reference + 0.2, reference)["relmse"] == pytest.approx((1.0 + 0.01 / 1.01) / 2, rel=1e-12)


def test_relmse_is_blind_to_exposure():
    """Scaling both pictures by one factor leaves relMSE as it was; RMSE goes with the factor."""
    image, reference = noise(), noise(1)
    errors, scaled = compare(image, reference), compare(image * 1e3, reference * 1e3)
    assert scaled["relmse"] == pytest.approx(errors["relmse"], rel=1e-12)
    assert scaled["rmse"] == pytest.approx(1e3 * errors["rmse"], rel=1e-12)


@pytest.mark.parametrize("level", [0.0, -0.1])
def test_black_reference_is_not_scaled(level):
    """A reference without light has no scale to give: relMSE = d^2 / (ref^2 + 0.01)."""
    errors = compare(np.full(SHAPE, level + 0.3), np.full(SHAPE, level))
    assert errors["relmse"] == pytest.approx(0.09 / (level**2 + 0.01), rel=1e-12)
    assert all(math.isfinite(value) for value in errors.values())


def test_psnr_of_a_known_error():
    """An sRGB difference of 0.1 everywhere is 20 dB; one of 1, black to white, is 0 dB."""

    def decode(v):
        return ((v + 0.055) / 1.055) ** 2.4

    errors = compare(np.full(SHAPE, decode(0.6)), np.full(SHAPE, decode(0.5)))
    assert errors["psnr"] == pytest.approx(20.0, abs=1e-9)
    assert compare(np.ones(SHAPE), np.zeros(SHAPE))["psnr"] == pytest.approx(0.0, abs=1e-9)


def test_psnr_and_flip_clamp_at_white():
    """Differences above 1 are not shown, so PSNR is infinite and FLIP 0, while RMSE sees them."""
    errors = compare(np.full(SHAPE, 3.0), np.full(SHAPE, 2.0))
    assert errors["psnr"] == math.inf
    assert errors["flip"] == 0.0
    assert errors["rmse"] == pytest.approx(1.0)


def test_flip_is_a_fraction_that_grows_with_noise():
    """FLIP of unlike pictures is in (0, 1], grows with the noise, and is what the package says of the sRGB values."""
    flip_evaluator = pytest.importorskip("flip_evaluator")
    reference = 0.5 * noise()
    flips = [compare(reference + amount * noise(1), reference)["flip"] for amount in (0.01, 0.1, 0.5)]
    assert 0.0 < flips[0] < flips[1] < flips[2] <= 1.0
    pair = [encode_srgb(picture).astype(np.float32) for picture in (reference, reference + 0.5 * noise(1))]
    assert flips[2] == flip_evaluator.evaluate(*pair, "LDR")[1]


def test_flip_is_none_without_its_package(monkeypatch):
    """Where flip-evaluator cannot be imported, the key is there with None, and the rest is unchanged."""
    image, reference = noise(), noise(1)
    errors = compare(image, reference)
    monkeypatch.setitem(sys.modules, "flip_evaluator", None)
    assert compare(image, reference) == errors | {"flip": None}


def test_arithmetic_is_float64():
    """A float32 picture has the errors of the same values in float64, to the last bit, and float16 works."""
    image, reference = noise().astype(np.float32), noise(1).astype(np.float16)
    assert compare(image, reference) == compare(image.astype(np.float64), reference.astype(np.float64))
    small = np.full(SHAPE, 1e-30, np.float32)  # its square is 0 in float32
    assert compare(2 * small, small)["rmse"] == pytest.approx(1e-30, rel=1e-6)


@pytest.mark.parametrize(
    ("image", "error", "message"),
    [
        (np.zeros((12, 15, 3)), ValueError, r"image has shape \(12, 15, 3\), expected \(12, 16, 3\)"),
        (np.zeros((12, 16)), ValueError, "image has shape"),
        (np.zeros((0, 16, 3)), ValueError, "image has shape"),
        (np.zeros(SHAPE, np.uint8), TypeError, "image holds uint8"),
        (np.full(SHAPE, np.nan), ValueError, "image holds 576 values that are NaN"),
        ("picture", TypeError, "image holds"),
        (None, TypeError, "image holds"),
    ],
)
def test_wrong_pictures_are_refused(image, error, message):
    """Another shape, 8-bit values and NaN each raise one sentence that names the argument."""
    with pytest.raises(error, match=message):
        compare(image, np.zeros(SHAPE))
