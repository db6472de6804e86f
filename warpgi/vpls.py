"""Virtual point lights on a device: the photons of a few paths, made lights."""

from __future__ import annotations

import numpy as np
import warp as wp

from warpgi.device import Device
from warpgi.device_scene import DeviceScene
from warpgi.kernels import photons as photon_kernels
from warpgi.kernels import vpls as kernels
from warpgi.materials import Coated, Conductor, Diffuse

PLAIN_FIELDS = {"target": wp.vec3, "normal": wp.vec3, "intensity": wp.vec3}
OTHER_FIELDS = {"shape": int, "shading": wp.vec3, "turned": float, "albedo": wp.vec3, "incident": wp.vec3}
#: Device bytes of a light, with the photon that it was made of.
VPL_BYTES = 4 * (9 + 13 + 16)


def is_plain(scene: DeviceScene) -> bool:
    """Whether all lights of a scene can only be on flat diffuse surfaces."""
    return all(
        isinstance(s.material, Diffuse) and s.normals is None
        for s in scene.scene.shapes
        if isinstance(s.material, (Diffuse, Conductor, Coated))
    )


def make_vpls(
    scene: DeviceScene,
    photons: photon_kernels.Photons,
    count: int,
    sharpest: float,
    flux_scale: np.ndarray | None = None,
) -> kernels.Vpls:
    """Lights made of `count` photons, in their order.

    Args:
        scene: in which the photons are.
        photons: with the fields of a source that was told `sharpest`.
        count: of them.
        sharpest: Blinn exponent of the glossy lobes that light comes from.
        flux_scale: factor on each photon's flux, shape (count,); None: 1.
    """
    device = scene.device
    plain = is_plain(scene)
    vpls = _allocate(device, count, plain)
    scale = np.zeros(0, np.float32) if flux_scale is None else flux_scale.astype(np.float32)
    inputs = [scene.struct, photons, sharpest, 0, device.array(scale, float)]
    device.launch(kernels.light_up, count, inputs, [vpls])
    return vpls


def _allocate(device: Device, count: int, plain: bool) -> kernels.Vpls:
    vpls = kernels.Vpls()
    vpls.plain = int(plain)
    for name, dtype in PLAIN_FIELDS.items():
        setattr(vpls, name, device.zeros(count, dtype))
    if not plain:
        for name, dtype in OTHER_FIELDS.items():
            setattr(vpls, name, device.zeros(count, dtype))
    return vpls
