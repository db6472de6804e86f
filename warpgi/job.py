"""What a method gets to work with."""

from __future__ import annotations

from dataclasses import dataclass

from warpgi.device import Device
from warpgi.device_scene import DeviceScene
from warpgi.kernels.camera import Camera


@dataclass(frozen=True)
class Job:
    """One picture of one scene."""

    scene: DeviceScene
    camera: Camera
    size: tuple[int, int]
    """(width, height) in pixels."""
    seed: int
    device: Device
