"""Virtual point lights on a device: the photons of a few paths, made lights."""

from __future__ import annotations

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
    map_side: int = 0,
) -> kernels.Vpls:
    """Lights made of `count` photons, in their order.

    Args:
        scene: in which the photons are.
        photons: of a source that was told how sharp lobes may be, for what lights need.
        count: of them.
        map_side: texels of a side of their shadow maps; 0: none are made.

    Raises:
        ValueError: the maps do not fit into the device's memory limit.
    """
    device = scene.device
    plain = is_plain(scene)
    vpls = _allocate(device, count, plain)
    inputs = [scene.struct, photons]
    device.launch(kernels.light_up, count, inputs, [vpls])
    texels = count * map_side**2
    if 4 * texels > device.memory_limit or texels >= 2**31:
        raise ValueError(f"shadow_map is {map_side}, expected less: {count} maps take {4 * texels} bytes")
    vpls.map_side, vpls.depth = map_side, device.zeros(texels, float)
    device.launch(kernels.render_maps, texels, [scene.struct], [vpls])
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
