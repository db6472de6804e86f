"""Edge-avoiding À-Trous wavelet filter (Dammertz, Sewtz, Hanika, Lensch 2010)."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
import warp as wp

from warpgi import checks
from warpgi.device import Device
from warpgi.filtering import FilterInput, SampleFilter, check_memory, layer_rows, sample_rows
from warpgi.kernels import a_trous as kernels
from warpgi.kernels.samples import trace_samples
from warpgi.samples import SampleBuffer

# Vectors and numbers of a row on the device.
ROW_BYTES = 12 * 7 + 4 * 3


@dataclass(frozen=True, kw_only=True)
class ATrous(SampleFilter):
    """À-Trous wavelet filter of indirect light (Dammertz et al. 2010): fast, blurs what features do not show.

    Filters what diffuse surfaces reflect, with `glossy` glossy ones too; others keep their path-traced light.
    `gi.denoise` uses it on the layers of any picture and filters every pixel with a surface. Without a colour term, as
    Lehtinen et al. 2012 have it: that of the paper takes bright samples for edges and loses their energy.

    Raises:
        TypeError, ValueError: a setting is out of range.
    """

    iterations: int = 5
    """Passes, in [1, 10]; each doubles the reach, 2^(iterations + 1) - 2 pixels in the end."""
    sigma_normal: float | None = 0.5
    """Difference of normals at which a weight falls to 1/e; None: not looked at. The same in every pass: to let it grow
    with the step, as the paper does, makes the wide passes blur over edges."""
    sigma_position: float | None = 7.0
    """Distance, in that of neighbouring pixels, at which a weight falls to 1/e; None: not looked at."""
    sigma_color: float | None = None
    """Difference of demodulated light, in times its mean, at which a weight of the first pass falls to 1/e; halved
    from pass to pass. None: not looked at. At 16 it keeps what features do not show in pictures with little noise, such
    as reflections in metal, but loses light where there is more."""
    sigma_hit_normal: float | None = None
    """Difference of normals at the secondary hits at which a weight of the first pass falls to 1/e; halved from pass to
    pass (Lehtinen et al. 2012). None: not looked at. For sample buffers alone; 4 is gentle, 1 keeps reflections."""
    demodulate: bool = True
    """Divide layers by albedo first, so that textures stay sharp; samples come without it."""
    glossy: bool = False
    """Filter what glossy surfaces reflect too, divided by their reflectance: less noise, and blurred reflections."""

    def __post_init__(self) -> None:
        super().__post_init__()
        checks.count("iterations", self.iterations, 1, 10)
        for name in ("sigma_normal", "sigma_position", "sigma_color", "sigma_hit_normal"):
            if getattr(self, name) is not None:
                checks.number(name, getattr(self, name), 1e-6, 1e6)

    @property
    def filters_gloss(self) -> bool:
        """Whether it filters what glossy surfaces reflect too."""
        return self.glossy

    @property
    def kernels(self) -> tuple[wp.Kernel, ...]:
        """What it launches."""
        return (trace_samples, *self.filter_kernels)

    @property
    def filter_kernels(self) -> tuple[wp.Kernel, ...]:
        """What it launches on an input that is there."""
        return (kernels.filter_rows,)

    def passes(self, spp: int | None = None) -> tuple[int, str]:
        """Passes, the unit of its work."""
        return self.iterations, "passes"

    def filter_bytes(self) -> int:
        """Device memory of the filter for one sample."""
        return ROW_BYTES + (12 if self.sigma_hit_normal is not None else 0)

    def reconstruction(self, samples: SampleBuffer, device: Device, seed: int) -> ATrousFiltering:
        """The filter on the samples, each by itself; edges stay as smooth as the samples know them."""
        return ATrousFiltering(sample_rows(samples), device, self)

    def on_layers(self, layers: Mapping[str, np.ndarray], name: str, device: Device) -> ATrousFiltering:
        """The filter on the pixels of layer `name`."""
        if self.sigma_hit_normal is not None:
            raise ValueError("sigma_hit_normal is set, expected None: layers hold no secondary hits, samples do")
        has = self.sigma_normal is not None, self.sigma_position is not None
        return ATrousFiltering(layer_rows(layers, name, self.demodulate, *has), device, self)


class ATrousFiltering:
    """Passes of the filter over rows.

    Args:
        rows: the input.
        device: where it computes.
        settings: the filter's.

    Raises:
        ValueError: it does not fit into the device's memory limit.
    """

    def __init__(self, rows: FilterInput, device: Device, settings: ATrous) -> None:
        check_memory(device, len(rows.pixel), settings.filter_bytes())
        self.rows, self.device, self.settings = rows, device, settings
        hit_normal = rows.hit_normal if settings.sigma_hit_normal is not None else np.zeros((0, 3), np.float32)
        struct = kernels.Rows()
        struct.width, struct.height = rows.width, rows.height
        struct.first, struct.pixel = device.array(rows.first, int), device.array(rows.pixel, int)
        struct.normal, struct.position = device.array(rows.normal, wp.vec3), device.array(rows.position, wp.vec3)
        struct.footprint = device.array(rows.footprint(), float)
        struct.hit_normal = device.array(hit_normal, wp.vec3)
        self.struct = struct
        self.value, self.known = device.array(rows.value, wp.vec3), device.array(rows.known, wp.vec3)
        self._next = [device.zeros(len(rows.pixel), wp.vec3) for _ in range(2)]
        count = rows.known.sum(dtype=np.float64)
        self._mean = float(rows.value.sum(dtype=np.float64) / count) if count else 0.0

    def gather(self, first: int, count: int, total: int) -> None:
        """Does passes `first` to `first + count - 1`."""
        for i in range(first, first + count):
            inputs = [self.struct, self._falloff(i), 2**i, self.value, self.known]
            self.device.launch(kernels.filter_rows, len(self.rows.pixel), inputs, self._next)
            self.value, self.known, self._next = *self._next, [self.value, self.known]

    def picture(self) -> np.ndarray:
        """Filtered light after the passes so far, shape (H, W, 3)."""
        return self.rows.picture(self.rows.light(self.value.numpy(), self.known.numpy()))

    def all_counts(self) -> dict[str, int]:
        """What was left out."""
        return self.rows.counts

    def _falloff(self, i: int) -> kernels.Falloff:
        settings = self.settings
        falloff = kernels.Falloff()
        step = 2.0**i
        color = None if settings.sigma_color is None else settings.sigma_color * self._mean
        hit_normal = settings.sigma_hit_normal
        falloff.color = _inverse_square(color, 1.0 / step)
        falloff.normal = _inverse_square(settings.sigma_normal, 1.0)
        falloff.position = _inverse_square(settings.sigma_position, 1.0)
        falloff.hit_normal = _inverse_square(hit_normal, 1.0 / step)
        return falloff


def _inverse_square(sigma: float | None, scale: float) -> float:
    return 1.0 / (sigma * scale) ** 2 if sigma else 0.0
