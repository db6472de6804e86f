"""How far a picture is from its reference: relMSE, RMSE, PSNR and FLIP."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from warpgi import checks
from warpgi.image import encode_srgb

# Keeps black pixels of the reference from dividing by zero; counts at a reference whose mean is 0.5.
RELMSE_EPSILON = 0.01
RELMSE_MEAN = 0.5

# A firefly is so many times as bright as its second brightest neighbour and this part of the picture's mean.
FIREFLY_RATIO = 4.0
FIREFLY_MEAN = 0.25
# And its standard error is this part of its brightness: it comes from few of its samples.
FIREFLY_ERROR = 0.25


def compare(image: Any, reference: Any) -> dict[str, float | None]:
    """Errors of a picture against a reference, each 0 where they are equal but for PSNR, which is infinite.

    - "relmse": mean of (x - ref)^2 / (ref^2 + 0.01) over pixels and channels, after both were scaled so that the
      reference's mean is 0.5. A reference whose mean is not above 0, such as a black one, is left unscaled.
    - "rmse": root of the mean squared difference of radiance, unscaled.
    - "psnr": -10 log10 of the mean squared difference of sRGB-encoded values, clamped to [0, 1], in dB.
    - "flip": mean LDR-FLIP (Andersson et al. 2020) of the same sRGB values, in [0, 1], at 67 pixels per degree;
      None where flip-evaluator is not installed (`pip install warpgi[bench]`).

    Args:
        image: linear radiance of a floating-point type, shape (H, W, 3), finite.
        reference: the same.

    Raises:
        TypeError: they are no floating-point arrays; 8-bit pictures are not linear.
        ValueError: their shapes differ or are others, or they hold NaN or infinity.

    Example:
        >>> import numpy as np
        >>> reference = np.full((4, 4, 3), 0.5)
        >>> errors = compare(reference + 0.1, reference)
        >>> round(errors["rmse"], 6), round(errors["relmse"], 6)
        (0.1, 0.038462)
    """
    x, ref = _radiance("image", image), _radiance("reference", reference)
    if x.shape != ref.shape:
        raise ValueError(f"image has shape {x.shape}, expected {ref.shape}, the shape of the reference")
    mean = float(ref.mean())
    scale = RELMSE_MEAN / mean if mean > 0.0 else 1.0
    squares = np.square(x - ref)
    shown, shown_ref = encode_srgb(x), encode_srgb(ref)
    shown_mse = float(np.square(shown - shown_ref).mean())
    return {
        "relmse": float((scale**2 * squares / (np.square(scale * ref) + RELMSE_EPSILON)).mean()),
        "rmse": math.sqrt(float(squares.mean())),
        "psnr": -10.0 * math.log10(shown_mse) if shown_mse > 0.0 else math.inf,
        "flip": _flip(shown, shown_ref),
    }


def flicker(images: Any, references: Any) -> float:
    """RMS over pixels, channels and pairs of neighbouring frames of the change of (x - ref) from frame to frame.

    Motion that the references show too costs nothing, and neither does an error that stays.

    Args:
        images: linear radiance of each frame, shape (N, H, W, 3), N at least 2.
        references: the same.

    Raises:
        TypeError, ValueError: they are no such arrays.

    Example:
        >>> import numpy as np
        >>> references = np.zeros((3, 2, 2, 3))
        >>> images = references + np.array([0.0, 0.1, 0.0])[:, None, None, None]
        >>> round(flicker(images, references), 6), flicker(images + 0.5, images)
        (0.1, 0.0)
    """
    x, ref = (
        checks.finite_array(name, value, (None, None, None, 3))
        for name, value in (("images", images), ("references", references))
    )
    if x.shape != ref.shape or len(x) < 2 or x.size == 0:
        raise ValueError(f"images has shape {x.shape}, references {ref.shape}, expected one shape and 2 frames or more")
    return math.sqrt(float(np.square(np.diff(x - ref, axis=0)).mean()))


def count_fireflies(image: np.ndarray, variance: np.ndarray) -> int:
    """Pixels that owe their light to one or two of many samples: what a path tracer hardly finds is there, but seldom.

    Such a pixel is 4 times as bright, in its brightest channel, as its second brightest neighbour and a quarter of the
    picture's mean together, and its standard error is a quarter of its brightness or more. With one sample per pixel,
    whose variance nobody knows, brightness alone decides.

    Args:
        image: radiance, shape (H, W, 3); a layer without lamps, which are meant to be bright.
        variance: of each pixel, the same shape; all 0: unknown.
    """
    value = image.max(axis=2).astype(np.float64)
    height, width = value.shape
    padded = np.pad(value, 1, constant_values=0.0)
    shifts = [(y, x) for y in range(3) for x in range(3) if (y, x) != (1, 1)]
    around = np.stack([padded[y : y + height, x : x + width] for y, x in shifts])
    second = np.partition(around, -2, axis=0)[-2]
    bright = value > FIREFLY_RATIO * (second + FIREFLY_MEAN * value.mean())
    if variance.any():
        bright &= np.sqrt(variance.max(axis=2)) > FIREFLY_ERROR * value
    return int(np.count_nonzero(bright))


def _radiance(name: str, value: Any) -> np.ndarray:
    array = np.asarray(value)
    if not np.issubdtype(array.dtype, np.floating):
        raise TypeError(f"{name} holds {array.dtype}, expected floating-point linear radiance")
    if array.size == 0:
        raise ValueError(f"{name} has shape {array.shape}, expected at least one pixel")
    return checks.finite_array(name, array, (None, None, 3))


def _flip(shown: np.ndarray, shown_ref: np.ndarray) -> float | None:
    try:
        import flip_evaluator
    except ImportError:
        return None
    _, mean, _ = flip_evaluator.evaluate(
        shown_ref.astype(np.float32), shown.astype(np.float32), "LDR", inputsRGB=True, applyMagma=False
    )
    return float(mean)
