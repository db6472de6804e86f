"""How much light a rough dielectric coat reflects by angle, and a fit of it that a kernel can evaluate."""

from __future__ import annotations

import functools
from typing import NamedTuple

import numpy as np

# Powers of 1 - cos of the fit; the high ones stand for the rise towards grazing angles.
POWERS = (0, 1, 2, 5, 10, 24)

HALF_VECTORS, AZIMUTHS = 128, 48


class Coat(NamedTuple):
    """What the device needs of a coat."""

    coefficients: np.ndarray
    """Of the fit's powers, shape (6,)."""
    excess: float
    """The most that the coat reflects beyond a smooth one, at any angle."""
    transmitted: float
    """Share of light from all around that the fit lets through."""
    internal: float
    """Share of diffuse light from below that a smooth coat throws back."""


@functools.lru_cache(maxsize=256)
def fit_coat(roughness: float, ior: float) -> Coat:
    """A bound of the coat's directional albedo: the lesser of a polynomial and the smooth coat's Fresnel reflectance.

    Both lie nowhere below the albedo, so that a base layer scaled by what is left never adds energy (Kelemen,
    Szirmay-Kalos 2001).
    """
    cos = np.concatenate([np.linspace(2e-3, 0.1, 40), np.linspace(0.1, 1.0, 60)[1:]])
    albedo, smooth = coat_albedo(cos, 1.0 / roughness, ior), fresnel(cos, ior)
    basis = (1.0 - cos)[:, None] ** POWERS
    coefficients = np.linalg.lstsq(basis, albedo, rcond=None)[0]
    coefficients[0] += np.max(albedo - basis @ coefficients)
    excess = max(0.0, float(np.max(albedo - smooth)))
    x, w = np.polynomial.legendre.leggauss(128)
    cos = 0.5 * (x + 1.0)
    bound = np.minimum((1.0 - cos)[:, None] ** POWERS @ coefficients, np.minimum(fresnel(cos, ior) + excess, 1.0))
    transmitted = float((w * cos * (1.0 - bound)).sum())
    # of the light that comes in diffusely, 1 / ior^2 of the transmitted share leaves again (Duderstadt, Martin 1979)
    external = float((w * cos * fresnel(cos, ior)).sum())
    return Coat(coefficients, excess, transmitted, 1.0 - (1.0 - external) / ior**2)


def coat_albedo(cos: np.ndarray, exponent: float, ior: float) -> np.ndarray:
    """Share of light from an angle that a Torrance-Sparrow coat with the Blinn distribution reflects, shape of `cos`.

    The mean over half vectors drawn by (e+1)/(2 pi) cos^e of F G (wo.h) (e+2)/(e+1) / cos_o.
    """
    c = np.asarray(cos, dtype=np.float64)[:, None, None]
    cos_h = (((np.arange(HALF_VECTORS) + 0.5) / HALF_VECTORS) ** (1.0 / (exponent + 1.0)))[:, None]
    azimuth = np.pi * (np.arange(AZIMUTHS) + 0.5) / AZIMUTHS
    oh = np.sqrt(1.0 - c * c) * np.sqrt(1.0 - cos_h * cos_h) * np.cos(azimuth) + c * cos_h
    cos_i = 2.0 * oh * cos_h - c
    used = (oh > 0.0) & (cos_i > 0.0)
    oh = np.where(used, oh, 1.0)
    g = np.minimum(1.0, 2.0 * cos_h * np.minimum(c, cos_i) / oh)
    value = fresnel(oh, ior) * g * oh * ((exponent + 2.0) / (exponent + 1.0)) / c
    return np.where(used, value, 0.0).mean(axis=(1, 2))


def fresnel(cos: np.ndarray, ior: float) -> np.ndarray:
    """Unpolarised reflectance of a dielectric from outside, `ior` at least 1."""
    cos_t = np.sqrt(ior * ior - 1.0 + cos * cos) / ior
    rp = (ior * cos - cos_t) / (ior * cos + cos_t)
    rs = (cos - ior * cos_t) / (cos + ior * cos_t)
    return 0.5 * (rs * rs + rp * rp)
