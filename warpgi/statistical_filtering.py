"""The statistical filter at work: principal components of a sequence, some frames in memory at a time."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from functools import cached_property

import numpy as np
import warp as wp

from warpgi.cluster import Cluster, worker_device
from warpgi.device import Device
from warpgi.filtering import layer_rows
from warpgi.kernels import statistical_filter as kernels
from warpgi.methods.irradiance_filter import SurfaceFilter
from warpgi.methods.statistical_filter import StatisticalFilter
from warpgi.modes import Modes, Rule, by_epsilon, by_noise, principal_components
from warpgi.samples import unit

# Rows whose strips' products are on the device, or on their way to a worker, at a time.
SLAB = 16 * int(kernels.STRIP)

# Difference of normals [degrees] up to which pixels share their statistics.
ANGLE = 50.0


class FrameMatrix:
    """A layer of all frames as columns of a matrix, rows of which are values: as many columns at a time as fit.

    Args:
        load: gives the layer of frame i, shape (H, W, 3).
        count: number of frames.
        size: (width, height) in pixels.
        device: where columns are; half its memory limit is for them.
    """

    def __init__(self, load: Callable[[int], np.ndarray], count: int, size: tuple[int, int], device: Device) -> None:
        self._load, self.count, self.device = load, count, device
        self.rows = 3 * size[0] * size[1]
        fit = device.memory_limit // 2 // (4 * self.rows)
        whole = fit >= 4 * -(-count // 4)
        # for products of two blocks both are there
        step = count if whole else max(4, fit // 2 // 4 * 4)
        self.blocks = [range(i, min(i + step, count)) for i in range(0, count, step)]
        self._kept: tuple[range, wp.array] | None = None

    def columns(self, block: range) -> wp.array:
        """The block's columns, four to a vec4, shape (rows, columns / 4)."""
        if self._kept is not None and self._kept[0] == block:
            return self._kept[1]
        values = np.zeros((self.rows, -(-len(block) // 4) * 4), np.float32)
        for column, frame in enumerate(block):
            values[:, column] = self._load(frame).reshape(-1)
        array = self.device.array(values.reshape(self.rows, -1, 4), wp.vec4)
        if len(self.blocks) == 1:
            self._kept = block, array
        return array

    def gram(self, cluster: Cluster | None = None) -> np.ndarray:
        """D^T D, shape (N, N), float64; here or on workers, which get some rows of all frames each."""
        if cluster is not None:
            return self._gram_there(cluster)
        result = np.zeros((self.count, self.count))
        for i, first in enumerate(self.blocks):
            left = self.columns(first)
            for second in self.blocks[i:]:
                right = left if second == first else self.columns(second)
                part = self._products(left, right)[: len(first), : len(second)]
                result[first.start : first.stop, second.start : second.stop] = part
                result[second.start : second.stop, first.start : first.stop] = part.T
        return result

    def _products(self, left: wp.array, right: wp.array) -> np.ndarray:
        total = np.zeros((4 * left.shape[1], 4 * right.shape[1]))
        for start in range(0, self.rows, SLAB):
            total += slab_products(self.device, left, right, start, min(SLAB, self.rows - start))
        return total

    def _gram_there(self, cluster: Cluster) -> np.ndarray:
        place = self.device.name, self.device.memory_limit
        total, early, following = np.zeros((self.count, self.count)), {}, 0
        slabs = ((start, *place, values) for start, values in self._slabs())
        for start, part in cluster.run(_slab_gram, slabs):
            early[start] = part
            # float64 sums in the order of the rows, whoever comes first
            while following in early:
                total += early.pop(following)[: self.count, : self.count]
                following += SLAB
        return total

    def _slabs(self) -> Iterator[tuple[int, np.ndarray]]:
        """Some rows of all frames at a time: the first one's number and values, shape (rows, columns / 4, 4)."""
        if len(self.blocks) == 1:
            values = self.columns(self.blocks[0]).numpy()
            yield from ((start, values[start : start + SLAB].copy()) for start in range(0, self.rows, SLAB))
            return
        width = -(-self.count // 4) * 4
        # half for the rows that are read, half for those that are on their way
        step = max(1, self.device.memory_limit // 4 // (4 * width * SLAB)) * SLAB
        for first in range(0, self.rows, step):
            values = np.zeros((min(step, self.rows - first), width), np.float32)
            for frame in range(self.count):
                values[:, frame] = self._load(frame).reshape(-1)[first : first + step]
            values = values.reshape(len(values), -1, 4)
            yield from ((first + start, values[start : start + SLAB]) for start in range(0, len(values), SLAB))

    def basis(self, vectors: np.ndarray) -> tuple[wp.array, np.ndarray]:
        """D V on the device, shape (rows, K), and each row's squared length, shape (rows,)."""
        basis = self.device.zeros((self.rows, vectors.shape[1]), float)
        energy = self.device.zeros(self.rows, float)
        for block in self.blocks:
            frames = self.columns(block)
            weights = np.zeros((vectors.shape[1], 4 * frames.shape[1]), np.float32)
            weights[:, : len(block)] = vectors[block.start : block.stop].T
            inputs = [frames, self.device.array(weights.reshape(len(weights), -1, 4), wp.vec4)]
            self.device.launch(kernels.add_to_basis, self.rows, inputs, [basis, energy])
        return basis, energy.numpy().astype(np.float64)


def slab_products(device: Device, left: wp.array, right: wp.array, start: int, rows: int) -> np.ndarray:
    """Products of all columns of two blocks over some rows, shape (columns, columns), float64."""
    a, b = left.shape[1], right.shape[1]
    strips = -(-rows // int(kernels.STRIP))
    sums = device.zeros((strips, a, b), wp.mat44)
    device.launch(kernels.multiply_strips, strips * a * b, [left, right, start, rows], [sums])
    total = sums.numpy().reshape(strips, a, b, 4, 4).sum(axis=0, dtype=np.float64)
    return total.transpose(0, 2, 1, 3).reshape(4 * a, 4 * b)


def _slab_gram(name: str, memory_limit: int, values: np.ndarray) -> np.ndarray:
    device = worker_device(name, memory_limit)
    columns = device.array(values, wp.vec4)
    return slab_products(device, columns, columns, 0, len(values))


class Projection:
    """Basis functions on the device, and what any frame is in them.

    Args:
        matrix: the frames.
        settings: the filter's.
        smooth: takes images, shape (H, W, C), to their means over each pixel's surroundings on its surface.
        signed: whether values may be below 0; else such results become 0.
        cluster: where frames are multiplied; None: here.
    """

    def __init__(
        self,
        matrix: FrameMatrix,
        settings: StatisticalFilter,
        size: tuple[int, int],
        smooth: Callable[[np.ndarray], np.ndarray],
        signed: bool = False,
        cluster: Cluster | None = None,
    ) -> None:
        self.size, self.device = size, matrix.device
        self._least = -3.0e38 if signed else 0.0
        gram = matrix.gram(cluster)
        values, vectors = principal_components(gram)
        limit = min(settings.modes or settings.max_modes, matrix.count)
        # the bound for infinitely many pixels is the lowest: no more than that will be needed
        kept = limit if settings.modes else min(by_noise(gram, values, vectors, np.inf)[0], limit)
        self._basis, energy = matrix.basis(vectors[:, :kept])
        width, height = size
        basis = self._basis.numpy().reshape(height, width, 3, kept)
        mode_energy = np.square(basis, dtype=np.float64).sum(axis=2)
        left = np.maximum(energy.reshape(height, width, 3).sum(axis=2) - mode_energy.sum(axis=2), 0.0)
        effective = _effective_count(left, matrix.count - kept)
        by_floor, edge = by_noise(gram, values, vectors, effective)
        count, rule = _choose(settings, values, by_floor, kept)
        left += mode_energy[..., count:].sum(axis=2)
        truncation = np.full((height, width), float(count), np.float32)
        if settings.per_pixel and count > 1 and matrix.count > count:
            variance = left / (matrix.count - count)
            truncation = pixel_truncation(mode_energy[..., :count], variance, smooth)
        self._weights = vectors[:, :count]
        self._truncation = self.device.array(truncation.reshape(-1), float)
        self.modes = Modes(
            eigenvalues=values,
            weights=self._weights,
            basis=np.ascontiguousarray(basis[..., :count].transpose(3, 0, 1, 2)),
            count=count,
            rule=rule,
            noise_edge=edge,
            truncation=truncation,
        )

    def frame(self, index: int) -> np.ndarray:
        """The filtered layer of one frame, shape (H, W, 3), float32."""
        width, height = self.size
        weights = np.zeros(self._basis.shape[1], np.float32)
        weights[: self.modes.count] = self._weights[index]
        result = self.device.zeros(width * height, wp.vec3)
        inputs = [self._basis, self.device.array(weights, float), self._truncation, self._least]
        self.device.launch(kernels.project, width * height, inputs, [result])
        return result.numpy().reshape(height, width, 3).copy()


class PixelSmoother:
    """Means of images over each pixel's surroundings on its surface.

    Args:
        settings: the filter's.
        size: (width, height) in pixels.
        device: where it computes.
        features: means over the frames of the layers "normal" and "position", which say what pixels belong together.
    """

    def __init__(
        self,
        settings: StatisticalFilter,
        size: tuple[int, int],
        device: Device,
        features: Callable[[], Mapping[str, np.ndarray]],
    ) -> None:
        self._settings, self._size, self._device, self._features = settings, size, device, features

    def __call__(self, images: np.ndarray) -> np.ndarray:
        """Smooths images, shape (H, W, C)."""
        if self._settings.map_radius == 0.0:
            return images
        surface, radius = self._surface
        flat = images.reshape(len(radius), -1).astype(np.float32)
        padded = np.pad(flat, ((0, 0), (0, -flat.shape[1] % 3)))
        ones = np.ones((len(radius), 3), np.float32)
        parts = [surface.run(padded[:, i : i + 3].copy(), ones, radius) for i in range(0, padded.shape[1], 3)]
        return np.concatenate(parts, axis=1)[:, : flat.shape[1]].reshape(images.shape)

    @cached_property
    def _surface(self) -> tuple[SurfaceFilter, np.ndarray]:
        layers, reach = self._features(), self._settings.map_radius
        rows = layer_rows({"indirect": layers["normal"]} | dict(layers), "indirect", False, True, True)
        surface = SurfaceFilter(self._size, unit(rows.normal), rows.position, self._device, reach, ANGLE)
        return surface, (reach * rows.footprint()).astype(np.float32)


def pixel_truncation(
    mode_energy: np.ndarray, variance: np.ndarray, smooth: Callable[[np.ndarray], np.ndarray]
) -> np.ndarray:
    """M of every pixel, shape (H, W), float32 in [1, M].

    A basis function more takes the pixel's part of it out of the error and brings one frame's noise in. Both are known
    from the pixel's surroundings: its part is its energy there less the noise. M is where their sum is least, as by
    Mallows (1973); the map is smoothed as in MA06, sec. 3.2.

    Args:
        mode_energy: squared length of each pixel in each basis function, shape (H, W, M).
        variance: noise of a pixel in one frame, shape (H, W).
        smooth: mean of images over each pixel's surroundings.
    """
    around = smooth(np.concatenate([mode_energy, variance[..., None]], axis=2)).astype(np.float64)
    gain = np.cumsum(around[..., :-1] - 2.0 * around[..., -1:], axis=2)
    best = 1.0 + np.argmax(gain, axis=2)
    return np.clip(smooth(best[..., None])[..., 0], 1.0, mode_energy.shape[2]).astype(np.float32)


def _choose(settings: StatisticalFilter, values: np.ndarray, by_floor: int, kept: int) -> tuple[int, Rule]:
    if settings.modes is not None:
        return kept, Rule.BY_HAND
    by_rules = by_epsilon(values, settings.epsilon, settings.epsilon_change)
    if by_rules is not None and by_rules <= min(by_floor, kept):
        return by_rules, Rule.EPSILON
    return (by_floor, Rule.NOISE_FLOOR) if by_floor <= kept and by_floor < len(values) else (kept, Rule.LIMIT)


def _effective_count(left: np.ndarray, freedom: int) -> float:
    """Pixels of one and the same noise that would make as wide a spectrum, from each pixel's unexplained energy."""
    squares = float(np.square(left).sum())
    if squares == 0.0 or freedom < 1:
        return float(left.size)
    # the energies scatter themselves, as chi-squares do, by 2 / freedom of their square
    return min(float(left.sum()) ** 2 / squares * (1.0 + 2.0 / freedom), float(left.size))
