"""What a surface is made of: reflection, textures and emission, as the host knows them."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np

from warpgi import checks

RGB = tuple[float, float, float]
#: A colour as callers may write it: one number for grey, or three.
Colour = float | RGB


@dataclass(frozen=True, eq=False)
class Texture:
    """An image of linear reflectance, repeated over the plane and interpolated bilinearly.

    Raises:
        TypeError, ValueError: the pixels are no (H, W, 3) array of finite values in [0, 1].
    """

    pixels: np.ndarray
    """Linear RGB, shape (H, W, 3), each value in [0, 1]; row 0 is the top, v = 1. Kept as float16 on the device."""

    def __post_init__(self) -> None:
        pixels = checks.finite_array("texture pixels", self.pixels, (None, None, 3), np.float32)
        if pixels.size == 0:
            raise ValueError(f"texture pixels have shape {pixels.shape}, expected at least one pixel")
        if pixels.min() < 0.0 or pixels.max() > 1.0:
            raise ValueError("texture pixels leave [0, 1], expected linear reflectance")
        object.__setattr__(self, "pixels", pixels)

    @staticmethod
    def from_srgb(pixels: Any) -> Texture:
        """A texture from 8-bit sRGB values, shape (H, W, 3) or (H, W, 4); a fourth channel is dropped."""
        values = np.asarray(pixels)
        if values.dtype != np.uint8 or values.ndim != 3 or values.shape[2] not in (3, 4):
            raise ValueError(f"sRGB pixels have type {values.dtype} and shape {values.shape}, expected uint8 (H, W, 3)")
        encoded = np.arange(256) / 255.0
        table = np.where(encoded <= 0.04045, encoded / 12.92, ((encoded + 0.055) / 1.055) ** 2.4).astype(np.float32)
        return Texture(table[values[..., :3]])


def _reflectance(name: str, value: Colour | Texture) -> RGB | Texture:
    return value if isinstance(value, Texture) else checks.rgb(name, value, upper=1.0)


@dataclass(frozen=True)
class Diffuse:
    """Lambertian reflection on both sides, f = albedo / pi."""

    albedo: Colour | Texture = (0.8, 0.8, 0.8)
    """Fraction of light reflected, linear RGB in [0, 1], or a texture of it."""

    def __post_init__(self) -> None:
        object.__setattr__(self, "albedo", _reflectance("albedo", self.albedo))


@dataclass(frozen=True)
class Conductor:
    """A rough metal: Torrance-Sparrow with the Blinn distribution (Pharr, Humphreys 2010, sec. 8.4).

    Its Fresnel term comes from `eta` and `k` where these are given, else from `reflectance` at normal incidence by
    Schlick's approximation (1994).
    """

    roughness: float = 0.05
    """1 / exponent of the Blinn distribution, in [1e-5, 1]; smaller is sharper."""
    reflectance: Colour | Texture = (0.9, 0.9, 0.9)
    """Reflectance at normal incidence, linear RGB in [0, 1], or a texture of it."""
    eta: Colour | None = None
    """Real part of the index of refraction per channel; goes with `k`."""
    k: Colour | None = None
    """Absorption coefficient per channel; goes with `eta`."""

    def __post_init__(self) -> None:
        checks.number("roughness", self.roughness, 1e-5, 1.0)
        object.__setattr__(self, "reflectance", _reflectance("reflectance", self.reflectance))
        if (self.eta is None) != (self.k is None):
            raise ValueError("eta and k belong together, expected both or neither")
        if self.eta is not None and self.k is not None:
            eta = checks.rgb("eta", self.eta)
            if min(eta) <= 0.0:
                raise ValueError(f"eta is {eta}, expected every channel above 0")
            object.__setattr__(self, "eta", eta)
            object.__setattr__(self, "k", checks.rgb("k", self.k))


@dataclass(frozen=True)
class Mirror:
    """A perfect mirror on both sides."""

    reflectance: Colour | Texture = (1.0, 1.0, 1.0)
    """Fraction of light reflected, linear RGB in [0, 1], or a texture of it."""

    def __post_init__(self) -> None:
        object.__setattr__(self, "reflectance", _reflectance("reflectance", self.reflectance))


@dataclass(frozen=True)
class Dielectric:
    """Smooth glass: Fresnel reflection and Snell refraction; the normal side of its triangles is outside."""

    ior: float = 1.5
    """Index of refraction inside over outside, in [1, 4]."""

    def __post_init__(self) -> None:
        checks.number("ior", self.ior, 1.0, 4.0)


@dataclass(frozen=True)
class Coated:
    """A diffuse base under a glossy coat, as varnished wood or plastic; on both sides.

    The coat is a dielectric Torrance-Sparrow lobe with the Blinn distribution. What it lets through, on the way in and
    on the way out, the base reflects diffusely, light that the coat throws back to the base included: the model of
    Mitsuba's `roughplastic` with its nonlinear colours. A white base loses no energy but what the fit of the coat's
    albedo, a bound from above, takes (Kelemen, Szirmay-Kalos 2001).
    """

    albedo: Colour | Texture = (0.5, 0.5, 0.5)
    """Reflectance of the base without its coat, linear RGB in [0, 1], or a texture of it."""
    roughness: float = 0.05
    """1 / exponent of the coat's Blinn distribution, in [1e-5, 1]; smaller is sharper."""
    ior: float = 1.5
    """Index of refraction of the coat, in [1, 4]; at 1 there is none."""

    def __post_init__(self) -> None:
        object.__setattr__(self, "albedo", _reflectance("albedo", self.albedo))
        checks.number("roughness", self.roughness, 1e-5, 1.0)
        checks.number("ior", self.ior, 1.0, 4.0)


Material = Diffuse | Conductor | Mirror | Dielectric | Coated


@dataclass(frozen=True)
class Emissive:
    """Diffuse emission of a shape's surface, beside whatever its material reflects."""

    radiance: Colour = field(default=(1.0, 1.0, 1.0))
    """Emitted radiance, linear RGB, W/(sr m^2), 0 or more; leaves on the normal side of the triangles."""
    two_sided: bool = False
    """Emit on both sides."""

    def __post_init__(self) -> None:
        object.__setattr__(self, "radiance", checks.rgb("radiance", self.radiance))
