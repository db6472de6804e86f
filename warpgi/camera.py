"""The camera: pinhole, or thin lens where `lens_radius` is above 0, with a shutter for scenes that move."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from warpgi import checks
from warpgi.materials import RGB


@dataclass(frozen=True)
class Camera:
    """A perspective camera that looks from `position` to `target`.

    Raises:
        TypeError, ValueError: a field is out of its range, or the viewing direction is undefined.
    """

    position: RGB
    """World position of the pinhole or the lens's centre."""
    target: RGB
    """World point in the middle of the picture."""
    up: RGB = (0.0, 1.0, 0.0)
    """World direction that points up in the picture; not parallel to the viewing direction."""
    fov: float = 40.0
    """Vertical field of view in degrees, in (0, 180)."""
    lens_radius: float = 0.0
    """Radius of the thin lens in world units; 0 is a pinhole, where all is sharp."""
    focus_distance: float | None = None
    """Distance along the viewing direction of the plane that is sharp; None: the distance of `target`."""
    shutter: tuple[float, float] = (0.0, 1.0)
    """Scene time at which the shutter opens and closes, in [0, 1]; equal times are an instant."""

    def __post_init__(self) -> None:
        object.__setattr__(self, "position", checks.vector("camera position", self.position))
        object.__setattr__(self, "target", checks.vector("camera target", self.target))
        object.__setattr__(self, "up", checks.direction("camera up", self.up))
        checks.number("camera fov", self.fov, 0.0, 179.0, open_lower=True)
        checks.number("camera lens_radius", self.lens_radius, 0.0)
        if self.focus_distance is not None:
            checks.number("camera focus_distance", self.focus_distance, 0.0, open_lower=True)
        shutter = checks.finite_array("camera shutter", self.shutter, (2,))
        if not 0.0 <= shutter[0] <= shutter[1] <= 1.0:
            raise ValueError(f"camera shutter is {tuple(shutter.tolist())}, expected two ascending times in [0, 1]")
        object.__setattr__(self, "shutter", tuple(shutter.tolist()))
        forward = np.subtract(self.target, self.position)
        if not forward.any():
            raise ValueError("camera target is the camera position, expected another point")
        if np.linalg.norm(np.cross(forward / np.linalg.norm(forward), self.up)) < 1e-6:
            raise ValueError("camera up is parallel to the viewing direction, expected another direction")

    def frame(self) -> np.ndarray:
        """Unit vectors right, up and forward as rows, shape (3, 3), float64."""
        forward = np.subtract(self.target, self.position)
        forward = forward / np.linalg.norm(forward)
        right = np.cross(forward, self.up)
        right = right / np.linalg.norm(right)
        return np.stack([right, np.cross(right, forward), forward])
