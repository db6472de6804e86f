"""Random parameter filtering (Sen, Darabi 2012)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import warp as wp

from warpgi import checks
from warpgi.device import Device
from warpgi.filtering import SampleFilter, check_memory, sample_rows
from warpgi.kernels import random_parameter_filter as kernels
from warpgi.kernels.samples import trace_samples
from warpgi.samples import SampleBuffer

# Vectors and numbers of a sample on the device.
SAMPLE_BYTES = 12 * 6 + 16 + 4 * 5

# Bytes of a neighbourhood: for each of its samples, and beside.
NEIGHBOUR_BYTES = 4 + int(kernels.COLUMNS)
PIXEL_BYTES = 4 + 8 * int(kernels.COLUMNS) + 12 * int(kernels.OUTPUTS)

# What neighbourhoods may take on the device; pixels are done as many at a time as fit.
SCRATCH_BYTES = 64 << 20

# The work of a box in as many parts, for the progress bar.
PARTS = 32

# Where escaped rays are taken to end, in sizes of the scene that the samples know.
SKY_DISTANCE = 2.0


@dataclass(frozen=True, kw_only=True)
class RandomParameterFilter(SampleFilter):
    """Random parameter filter (Sen, Darabi 2012): blurs what statistics tie to random numbers; slow, for comparison.

    A cross-bilateral filter of samples whose weights follow, pixel by pixel, from the mutual information of colours
    and features with the random direction of the secondary ray and with screen position. Filters what diffuse surfaces
    reflect, with `glossy` glossy ones too; others keep their path-traced light.

    Raises:
        TypeError, ValueError: a setting is out of range.
    """

    boxes: tuple[int, ...] = (55, 35, 17, 7)
    """Side of each round's neighbourhood [pixels], odd, at most 999; the paper's by default."""
    neighbours: int | None = 1024
    """Most samples of a neighbourhood, drawn with a Gaussian; time and memory grow with it. None: half of those in the
    box, as in the paper, 12 100 for a box of 55 at 8 spp, for some five times the time."""
    variance: float = 1.0
    """Squared sigma of the weights at 8 spp; the paper has 0.02 for noisy scenes and 0.002 for others, with
    which much noise stays where clamped light is given back."""
    reinsert: bool = True
    """Give clamped light back within its pixel (Lehtinen et al. 2012), and what the weights lose or gain over the whole
    picture back by one factor a channel, so that the mean stays that of the input."""
    glossy: bool = False
    """Filter what glossy surfaces reflect too, divided by their reflectance: less noise, and blurred reflections."""

    def __post_init__(self) -> None:
        super().__post_init__()
        if not isinstance(self.boxes, tuple) or not self.boxes:
            raise ValueError(f"boxes is {self.boxes!r}, expected one odd number or more")
        for box in self.boxes:
            if checks.count("boxes", box, 1, 999) % 2 == 0:
                raise ValueError(f"boxes holds {box}, expected odd numbers")
        if self.neighbours is not None:
            checks.count("neighbours", self.neighbours, 1, 1 << 20)
        checks.number("variance", self.variance, 1e-6, 1e6)

    @property
    def filters_gloss(self) -> bool:
        """Whether it filters what glossy surfaces reflect too."""
        return self.glossy

    @property
    def kernels(self) -> tuple[wp.Kernel, ...]:
        """What it launches."""
        return (trace_samples, kernels.filter_samples)

    def passes(self, spp: int | None = None) -> tuple[int, str]:
        """Parts of the picture, once for each box."""
        return PARTS * len(self.boxes), "parts"

    def filter_bytes(self) -> int:
        """Device memory of the filter for one sample, but for the neighbourhoods of a few pixels."""
        return SAMPLE_BYTES

    def neighbourhood(self, box: int, spp: int) -> int:
        """Most samples of a neighbourhood, those of the pixel itself included."""
        half = box * box * spp // 2
        return spp + (half if self.neighbours is None else min(half, self.neighbours))

    def reconstruction(self, samples: SampleBuffer, device: Device, seed: int) -> RandomParameterFiltering:
        """The filter on the samples."""
        return RandomParameterFiltering(samples, device, self, seed)


class RandomParameterFiltering:
    """Rounds of the filter over a sample buffer, part by part.

    Args:
        samples: the input.
        device: where it computes.
        settings: the filter's.
        seed: which neighbours are drawn.

    Raises:
        ValueError: the samples hold no secondary rays, or do not fit into the device's memory limit.
    """

    def __init__(self, samples: SampleBuffer, device: Device, settings: RandomParameterFilter, seed: int) -> None:
        self.rows = rows = sample_rows(samples)
        self.device, self.settings, self.seed = device, settings, seed
        first = rows.first
        self.first = first
        self.spp = int(np.diff(first).max(initial=1))
        usable = rows.known[:, 0] > 0
        assert rows.hit_normal is not None
        hit, parameters = _hits(samples, usable), _parameters(samples, rows.normal)

        largest = max(settings.neighbourhood(box, self.spp) for box in settings.boxes)
        each = largest * NEIGHBOUR_BYTES + PIXEL_BYTES
        free = device.memory_limit - len(samples) * SAMPLE_BYTES
        self.chunk = int(min(max(SCRATCH_BYTES // each, 1), -(-(len(first) - 1) // PARTS)))
        check_memory(device, 1, len(samples) * SAMPLE_BYTES + each)
        self.chunk = min(self.chunk, free // each)

        struct = kernels.Samples()
        struct.width, struct.height = rows.width, rows.height
        struct.first, struct.pixel = device.array(first, int), device.array(rows.pixel, int)
        struct.primary, struct.known = (device.array(flags.astype(np.int32), int) for flags in (rows.filtered, usable))
        vectors = {"position": rows.position, "normal": rows.normal, "hit": hit, "hit_normal": rows.hit_normal}
        for name, values in vectors.items():
            setattr(struct, name, device.array(values, wp.vec3))
        struct.parameters = device.array(parameters, wp.vec4)
        spreads = [_spread(values[usable]) for values in (rows.value, *vectors.values())]
        struct.spread = kernels.vec19(*np.repeat(spreads, 3).tolist(), *[_spread(parameters[usable])] * 4)
        self.struct = struct
        self.found = self._neighbourhoods(largest)
        self.value, self.known = device.array(rows.value, wp.vec3), struct.known
        self.next = device.array(rows.value, wp.vec3)
        self.filled = device.zeros(len(samples), int)

    def _neighbourhoods(self, size: int) -> kernels.Neighbourhoods:
        found, device, chunk = kernels.Neighbourhoods(), self.device, self.chunk
        found.count, found.sample = device.zeros(chunk, int), device.zeros(chunk * size, int)
        found.mean, found.inverse_sigma = (device.zeros(chunk, kernels.vec19) for _ in range(2))
        found.bins = device.zeros(chunk * size * int(kernels.COLUMNS), wp.uint8)
        found.dependency = device.zeros(chunk * int(kernels.OUTPUTS), wp.vec3)
        return found

    def gather(self, first: int, count: int, total: int) -> None:
        """Does parts `first` to `first + count - 1`; the last of a box makes its result the next one's input."""
        pixels = len(self.first) - 1
        for unit in range(first, first + count):
            round_, part = divmod(unit, PARTS)
            stop = (part + 1) * pixels // PARTS
            for begin in range(part * pixels // PARTS, stop, self.chunk):
                self._filter(round_, begin, min(begin + self.chunk, stop))
            if part == PARTS - 1:
                self.value, self.next, self.known = self.next, self.value, self.filled

    def _filter(self, round_: int, begin: int, end: int) -> None:
        """One box for pixels `begin` to `end - 1`."""
        settings, launch, samples, found = self.settings, self.device.launch, self.struct, self.found
        box, count = settings.boxes[round_], end - begin
        found.first_pixel, found.size = begin, settings.neighbourhood(box, self.spp)
        draws = found.size - self.spp
        launch(kernels.choose_neighbours, count, [samples, self.value, box, round_, draws, self.seed], [found])
        launch(kernels.quantise, count, [samples, self.value], [found])
        launch(kernels.measure_dependency, count * int(kernels.OUTPUTS), [], [found])
        start, stop = int(self.first[begin]), int(self.first[end])
        scale = self.spp / (16.0 * settings.variance)
        inputs = [start, samples, self.value, found, 1.0 + 0.1 * round_, scale]
        launch(kernels.filter_samples, stop - start, inputs, [self.next, self.filled])
        launch(kernels.clamp_outliers, count, [begin, samples, int(settings.reinsert)], [self.next])

    def picture(self) -> np.ndarray:
        """Filtered light after the boxes that are done, shape (H, W, 3)."""
        rows = self.rows
        filled = np.repeat(self.known.numpy()[:, None], 3, axis=1)
        light = rows.light(self.value.numpy(), filled)
        if self.settings.reinsert:
            before, after = (x.sum(axis=0, dtype=np.float64) for x in (rows.albedo * rows.value, light * rows.known))
            light = light * np.divide(before, after, out=np.ones(3), where=after > 0)
        return rows.picture(light)

    def all_counts(self) -> dict[str, int]:
        """What was left out."""
        return self.rows.counts


def _hits(samples: SampleBuffer, usable: np.ndarray) -> np.ndarray:
    """Secondary hits; of rays that left the scene, points beyond it; 0 where not usable. Shape (N, 3)."""
    splat = samples.checked.is_splat & usable
    seen = np.concatenate([samples.hit[splat], samples.origin[usable]])
    size = float(np.ptp(seen, axis=0).max()) if len(seen) else 0.0
    far = samples.origin + samples.direction * np.float32(SKY_DISTANCE * size)
    zero = np.float32(0.0)
    return np.where(splat[:, None], samples.hit, np.where(usable[:, None], far, zero)).astype(np.float32)


def _parameters(samples: SampleBuffer, normal: np.ndarray) -> np.ndarray:
    """Random parameters, of which the secondary ray's direction was made, and screen position; shape (N, 4).

    The parameters are the direction's two coordinates along the surface, which cosine sampling distributes evenly.
    """
    # the frame of Duff et al. 2017
    x, y, z = normal.T
    sign = np.where(z >= 0.0, 1.0, -1.0)
    a = -1.0 / (sign + z)
    b = x * y * a
    s = np.stack([1.0 + sign * x * x * a, sign * b, -sign * x], axis=1)
    t = np.stack([b, sign + y * y * a, -y], axis=1)
    d = samples.direction
    along = [np.einsum("ij,ij->i", axis, d) for axis in (s, t)]
    if samples.image_xy is not None:
        place = samples.image_xy
    else:
        pixel = samples.pixel_of_sample
        place = np.stack([pixel % samples.width, pixel // samples.width], axis=1)
    return np.concatenate([np.stack(along, axis=1), np.nan_to_num(place)], axis=1).astype(np.float32)


def _spread(values: np.ndarray) -> float:
    """Largest standard deviation of a column."""
    return float(values.std(axis=0, dtype=np.float64).max()) if len(values) else 0.0
