"""Light-field reconstruction where surfaces are glossy: at primary hits, at secondary hits, or at both.

Lehtinen et al. 2012, sections 2.2 to 2.5, and 4 on hierarchies of their own and on layers.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import warp as wp

from warpgi.device import Device
from warpgi.device_scene import material_record
from warpgi.kernels import glossy_light_field as kernels
from warpgi.kernels import light_field as diffuse_kernels
from warpgi.kernels.scene import ShapeRecord
from warpgi.lens_reconstruction import COVERED_PART2
from warpgi.reconstruction import Preprocessing, PrimaryHits, Reconstruction
from warpgi.samples import SampleBuffer
from warpgi.splat_tree import LANES, SplatTree

#: What it launches beside what a diffuse reconstruction does, to be compiled first.
GLOSSY_KERNELS = (kernels.reconstruct_glossy,)

# Along the curve that orders lobes, a typical radius counts as much as this many times the typical angle of a lobe.
ANGLES_PER_RADIUS = 1.0


class GlossyReconstruction(Reconstruction):
    """Reconstruction rays drawn by the BSDFs of primary hits, and secondary hits read by the bandwidth of theirs.

    Splats of glossy surfaces resolve visibility, and give the light of diffuse layers, as all splats do. Light of
    glossy layers comes from the lobe whose filter is largest, by the share that glossy splats have in the surface met:
    where glossy and diffuse splats overlap, as in a corner, each kind answers by its weight. On `statuettes` (320x180,
    8 spp) two hierarchies reconstruct 1.5 times as fast as one whose splats have their lobes' sizes, at the same error.

    Args:
        bandwidth: False reads secondary hits as if all were diffuse.
    """

    def __init__(
        self,
        samples: SampleBuffer,
        device: Device,
        preprocessing: Preprocessing,
        seed: int,
        hits: PrimaryHits | None = None,
        recursions: int = 0,
        recursive_rays: int = 16,
        bandwidth: bool = True,
    ) -> None:
        device.load(GLOSSY_KERNELS)
        self.bandwidth = bandwidth and samples.kappa is not None
        self.surfaces = surfaces_of(samples, hits, device)
        super().__init__(
            samples, device, preprocessing, seed, hits, recursions=recursions, recursive_rays=recursive_rays
        )
        self.counts["lobes"] = self.lobe_tree.count
        if samples.beyond is not None and self.bandwidth:
            self.counts["mirrored"] = len(samples.beyond)

    def _walk_on(self) -> kernels.Beyond:
        """Splats of the segments after mirrors.

        They are apart from the others: what they show includes lamps, and their visibility is the mirrors' own.
        """
        struct, beyond = kernels.Beyond(), self.samples.beyond
        if beyond is None or not self.bandwidth:
            return struct
        nothing = np.zeros((0, 3), np.float32)
        nowhere = PrimaryHits(nothing, nothing, nothing, 1)  # none of them gathers light
        # a mirror shows rims as they are, so splats half as many neighbours wide
        sizes = replace(self.preprocessing, neighbours=max(2, self.preprocessing.neighbours // 2))
        after = self._after = _Beyond(beyond, self.device, sizes, self.seed, nowhere)  # kept, for its arrays
        mirror = np.zeros((len(self.samples), 3), np.float32)
        mirror[beyond.pixel_of_sample] = beyond.albedo
        struct.mirror = self.device.array(mirror[self.tree.order.numpy()], wp.vec3)
        struct.tree, struct.lobes, struct.sky, struct.noise = after.tree.struct, after.lobes, after.sky, after.noise
        struct.shift = wp.vec3(*(after.centre - self.centre).tolist())
        return struct

    def _upload(self, splats: np.ndarray, receivers: PrimaryHits | None) -> None:
        super()._upload(splats, receivers)
        samples = self.samples
        kappa = samples.kappa if self.bandwidth else None
        self._kappa = np.zeros(len(samples), np.float32) if kappa is None else kappa
        glossy = (self._kappa > 0.0)[:, None]
        base = np.zeros_like(samples.radiance) if samples.base_radiance is None else samples.base_radiance
        zero = np.float32(0.0)
        self._radiance = self.device.array(np.where(glossy, base, samples.radiance), wp.vec3)
        with np.errstate(invalid="ignore"):
            self._lobe_radiance = np.where(glossy, np.maximum(samples.radiance - base, zero), zero)

    def _make_tree(self, splats: np.ndarray) -> None:
        super()._make_tree(splats)
        device, tree = self.device, self.tree
        self.lobes = lobes = kernels.Lobes()
        order = tree.order.numpy()
        chosen = np.sort(order[self._kappa[order] > 0.0]).astype(np.int32)
        radiance = device.array(self._lobe_radiance, wp.vec3)
        axes = device.zeros(len(self.samples), wp.vec3)
        inputs = [self._origins, self._hits, self._hit_normals]
        device.launch(kernels.mirror_rays, len(self.samples), inputs, [axes])
        arrays = (self._hits, self._hit_normals, radiance)
        self.lobe_tree = LobeTree(self, axes, device.array(self._kappa, float), arrays, chosen)
        lobes.tree, lobes.axes, lobes.cones = self.lobe_tree.struct, self.lobe_tree.axes, self.lobe_tree.cones
        lobes.stretch = self.preprocessing.alpha**2 - 1.0
        lobes.kappa = device.array(self._kappa[order], float)
        lobes.radiance = device.array(self._lobe_radiance[order], wp.vec3)
        self.lobe_tree.size(lobes, self.preprocessing.neighbours)
        self.beyond = self._walk_on()

    def _trace(
        self,
        receivers: diffuse_kernels.Receivers,
        gathered: diffuse_kernels.Gathered,
        size: int,
        first: int,
        count: int,
        each: int,
    ) -> None:
        inputs = [self.tree.struct, self.lobes, self.beyond, self.surfaces, self.sky, receivers, each, first, count]
        inputs += [self.seed, self.noise, *self._kept_parts()]
        self.device.launch(kernels.reconstruct_glossy, size, inputs, [gathered])
        self.counts["reconstruction_rays"] += size * count

    def _relight(self, splats: np.ndarray, rays: int) -> None:
        # what a glossy splat sent is no multiple of the light that all directions bring it
        surfaces, self.surfaces = self.surfaces, kernels.Surfaces()
        super()._relight(splats[self._kappa[splats] == 0.0], rays)
        self.surfaces = surfaces


class _Beyond(GlossyReconstruction):
    """What mirrors show: its rims are rims in the picture, as through a lens."""

    def _fit(self) -> None:
        sizes = self.tree.radii()
        super()._fit()
        radii = self.tree.radii()
        crossed = radii < sizes * np.float32(1.0 - 1e-4)
        radius2 = np.square(radii) * np.where(crossed, np.float32(COVERED_PART2), np.float32(1.0))
        self.tree.set_radius2(self.device.array(radius2, float))


class LobeTree(SplatTree):
    """Lobes in a tree of their own, ordered by place and direction, with boxes of directions beside those of places.

    This subdivision by angle saves little: on `statuettes` at 192x108 the boxes of directions 2 to 8 % of the time of
    reconstruction, for the same picture, and the order 2 % beside one by place alone.
    """

    def __init__(
        self,
        state: Reconstruction,
        axes: wp.array,
        kappa: wp.array,
        arrays: tuple[wp.array, wp.array, wp.array],
        chosen: np.ndarray,
    ) -> None:
        device = state.device
        # ellipsoids, alpha times as thin as wide
        self._flat = 1.0 - 1.0 / state.preprocessing.alpha**2
        order = lobe_order(state, axes, kappa, chosen)
        super().__init__(device, *arrays, chosen, state.noise, order)
        self.axes = device.zeros(self.block_count * int(kernels.AXIS_STRIDE), float)
        self.cones = device.zeros(self.node_count * int(kernels.CONE_STRIDE), float)
        inputs = [axes, kappa, self.order, self.count]
        device.launch(kernels.fill_axes, self.block_count * LANES, inputs, [self.axes])
        start, size = self.levels[0]
        inputs = [self.axes, self.count, self.block_count, start]
        device.launch(kernels.fit_leaf_cones, size, inputs, [self.cones])
        for (start, size), (below, count_below) in zip(self.levels[1:], self.levels, strict=False):
            device.launch(kernels.fit_level_cones, size, [start, below, count_below], [self.cones])

    def refit(self) -> None:
        """Boxes from the lobes' present sizes, as ellipsoids."""
        self._refit(self._flat)

    def size(self, lobes: kernels.Lobes, k: int) -> None:
        """Radii from the k-th nearest neighbour of like direction (Lehtinen et al. 2012, section 2.2)."""
        if self.count == 0:
            return
        radius2 = self.nearest_distances(k, lobes.stretch)
        self.device.launch(kernels.size_lobes, self.count, [lobes, k], [radius2])
        self.set_radius2(radius2)


def lobe_order(state: Reconstruction, axes: wp.array, kappa: wp.array, chosen: np.ndarray) -> wp.array:
    """The chosen samples' numbers along a Hilbert curve through places and directions, on the device."""
    device, count = state.device, len(chosen)
    source = device.array(chosen, int)
    if count == 0:
        return source
    places = state._hits.numpy()[chosen]
    low, extent = places.min(axis=0), float(np.ptp(places, axis=0).max())
    # how far away a lobe's filter has fallen to a half
    angle = float(np.arccos(np.clip(1.0 - np.log(2.0) / np.median(kappa.numpy()[chosen]), -1.0, 1.0)))
    radius = float(np.median(state.tree.radii()))
    steps = 1 << int(kernels.KEY_BITS)
    # cells as large in units of a radius as in units of an angle, and as many as there are bits for
    cell = max(extent / steps, radius * ANGLES_PER_RADIUS * 2.0 / (angle * steps), 1e-30)
    axis_cell = max(cell * angle / max(radius * ANGLES_PER_RADIUS, 1e-30), 2.0 / steps)
    keys, values = device.zeros(2 * count, wp.int64), device.zeros(2 * count, int)
    inputs = [state._hits, axes, source, wp.vec3(*low.tolist()), cell, axis_cell]
    device.launch(kernels.order_lobes, count, inputs, [keys, values])
    wp.utils.radix_sort_pairs(keys, values, count)
    return values[:count].contiguous()


def surfaces_of(samples: SampleBuffer, hits: PrimaryHits | None, device: Device) -> kernels.Surfaces:
    """BSDFs of the primary hits at which light is gathered."""
    surfaces = kernels.Surfaces()
    known = samples if hits is None else hits
    if known.material is None:
        return surfaces
    records = [material_record(material) for material in samples.materials]
    surfaces.records = device.array(records, ShapeRecord)
    surfaces.material = device.array(known.material, int)
    surfaces.wo, surfaces.reflectance = device.array(known.wo, wp.vec3), device.array(known.reflectance, wp.vec3)
    return surfaces
