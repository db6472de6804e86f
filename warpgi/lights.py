"""Lights that are no surface; a surface that emits is a shape with `Emissive`."""

from __future__ import annotations

import math
from dataclasses import dataclass

from warpgi import checks
from warpgi.materials import RGB, Colour


@dataclass(frozen=True)
class PointLight:
    """A point that sends the same radiant intensity everywhere."""

    position: RGB
    """World position."""
    intensity: Colour
    """Radiant intensity, linear RGB, W/sr, 0 or more; its power is 4 pi times this."""

    def __post_init__(self) -> None:
        object.__setattr__(self, "position", checks.vector("position", self.position))
        object.__setattr__(self, "intensity", checks.rgb("intensity", self.intensity))


@dataclass(frozen=True)
class SpotLight:
    """A point that lights a cone, with the smooth edge of glTF's KHR_lights_punctual."""

    position: RGB
    """World position."""
    direction: RGB
    """Axis of the cone, away from the light."""
    intensity: Colour
    """Radiant intensity on the axis, linear RGB, W/sr, 0 or more."""
    inner_angle: float = 0.0
    """Half angle in radians up to which the intensity is full."""
    outer_angle: float = math.pi / 4
    """Half angle in radians from which on it is 0, above `inner_angle`, at most pi/2."""

    def __post_init__(self) -> None:
        object.__setattr__(self, "position", checks.vector("position", self.position))
        object.__setattr__(self, "direction", checks.direction("direction", self.direction))
        object.__setattr__(self, "intensity", checks.rgb("intensity", self.intensity))
        checks.number("outer_angle", self.outer_angle, 0.0, math.pi / 2, open_lower=True)
        checks.number("inner_angle", self.inner_angle, 0.0)
        if self.inner_angle >= self.outer_angle:
            raise ValueError(
                f"inner_angle is {self.inner_angle:g}, expected less than outer_angle {self.outer_angle:g}"
            )


@dataclass(frozen=True)
class DistantLight:
    """Parallel light from infinitely far away, such as the sun."""

    direction: RGB
    """Direction in which the light travels."""
    irradiance: Colour
    """Irradiance on a surface that faces it, linear RGB, W/m^2, 0 or more."""

    def __post_init__(self) -> None:
        object.__setattr__(self, "direction", checks.direction("direction", self.direction))
        object.__setattr__(self, "irradiance", checks.rgb("irradiance", self.irradiance))


@dataclass(frozen=True)
class Environment:
    """The same radiance from every direction that no surface blocks."""

    radiance: Colour
    """Linear RGB, W/(sr m^2), 0 or more."""

    def __post_init__(self) -> None:
        object.__setattr__(self, "radiance", checks.rgb("radiance", self.radiance))


Light = PointLight | SpotLight | DistantLight | Environment
