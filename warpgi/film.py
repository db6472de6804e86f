"""The film: a picture's running means, on the device as a whole or, where memory is short, in bands."""

from __future__ import annotations

import math

import numpy as np
import warp as wp

from warpgi.device import Device
from warpgi.kernels.film import Film as FilmStruct
from warpgi.metrics import RELMSE_EPSILON, RELMSE_MEAN

# Per-pixel arrays of the device's struct and their types.
FIELDS = {
    "count": int,
    "surface_count": int,
    "emission": wp.vec3,
    "direct": wp.vec3,
    "indirect": wp.vec3,
    "squares": wp.vec3,
    "albedo": wp.vec3,
    "normal": wp.vec3,
    "position": wp.vec3,
    "depth": float,
    "closest_hit_rays": int,
    "shadow_rays": int,
    "nonfinite": int,
}
BYTES_PER_PIXEL = sum(12 if dtype is wp.vec3 else 4 for dtype in FIELDS.values())


class Film:
    """Means, squared deviations and counts of every pixel.

    Args:
        size: (width, height) in pixels.
        device: where its bands live.
        free_bytes: device memory that a band may take; a smaller one means more bands, never another picture.

    Raises:
        ValueError: not even one pixel fits.
    """

    def __init__(self, size: tuple[int, int], device: Device, free_bytes: int) -> None:
        self.width, self.height = size
        self.pixel_count = self.width * self.height
        band = min(self.pixel_count, free_bytes // BYTES_PER_PIXEL)
        if band < 1:
            raise ValueError(
                f"memory_limit is {device.memory_limit} bytes, expected enough for scene, method and a pixel,"
                f" {device.memory_limit - free_bytes + BYTES_PER_PIXEL} bytes"
            )
        self.device = device
        self.bands = [range(i, min(i + band, self.pixel_count)) for i in range(0, self.pixel_count, band)]
        self._host: dict[str, np.ndarray] = {}
        if len(self.bands) > 1:
            self._host = {name: np.zeros(self._shape(dtype), _numpy(dtype)) for name, dtype in FIELDS.items()}
        self._struct: FilmStruct | None = None
        self._loaded: range | None = None

    def load(self, band: range) -> FilmStruct:
        """The device's struct for one band, which keeps what the band held before."""
        if self._loaded == band:
            return self._struct
        self.store()
        struct = FilmStruct()
        struct.first_pixel = band.start
        for name, dtype in FIELDS.items():
            if self._host:
                array = self.device.array(self._host[name][band.start : band.stop], dtype)
            else:
                array = self.device.zeros(len(band), dtype)
            setattr(struct, name, array)
        self._struct, self._loaded = struct, band
        return struct

    def store(self) -> None:
        """Brings the band that is on the device back to the host, where there are several."""
        if self._loaded is None or not self._host:
            return
        for name in FIELDS:
            self._host[name][self._loaded.start : self._loaded.stop] = getattr(self._struct, name).numpy()
        self._struct = self._loaded = None

    def field(self, name: str) -> np.ndarray:
        """All pixels of one field, shape (H W,) or (H W, 3)."""
        if self._host:
            self.store()
            return self._host[name]
        if self._struct is None:
            return np.zeros(self._shape(FIELDS[name]), _numpy(FIELDS[name]))
        return getattr(self._struct, name).numpy()

    def restore(self, fields: dict[str, np.ndarray]) -> None:
        """Takes the values of all pixels, as `field` gave them."""
        for name, dtype in FIELDS.items():
            values: np.ndarray = fields[name].astype(_numpy(dtype)).reshape(self._shape(dtype))
            if self._host:
                self._host[name][:] = values
            else:
                getattr(self.load(self.bands[0]), name).assign(values)

    def relative_variance(self) -> float:
        """Mean over pixels and channels of variance / (mean^2 + 0.01), scaled to a mean of 0.5: the part of relMSE
        that is noise, as the picture itself knows it; infinite before every pixel has two samples."""
        count = self.field("count")[:, None].astype(np.float64)
        if count.min(initial=2) < 2:
            return math.inf
        mean = sum(self.field(name).astype(np.float64) for name in ("emission", "direct", "indirect"))
        variance = self.field("squares") / (count * (count - 1.0))
        total = float(np.mean(mean))
        scale = RELMSE_MEAN / total if total > 0.0 else 1.0
        return float(np.mean(scale**2 * variance / (np.square(scale * mean) + RELMSE_EPSILON)))

    def spp(self) -> int:
        """Samples that every pixel holds at least, dropped ones included."""
        return int((self.field("count") + self.field("nonfinite")).min())

    def counts(self) -> dict[str, int]:
        """Sums over all pixels of rays and dropped samples."""
        finite, dropped = (int(self.field(name).sum(dtype=np.int64)) for name in ("count", "nonfinite"))
        rays = {name: int(self.field(name).sum(dtype=np.int64)) for name in ("closest_hit_rays", "shadow_rays")}
        return {"camera_rays": finite + dropped, **rays, "nonfinite": dropped}

    def layers(self, centre: np.ndarray) -> dict[str, np.ndarray]:
        """Layers of a Render, shape (H, W, C) float32; `centre` is the world position of the device's origin."""
        layers = {name: self._image(name) for name in ("emission", "direct", "indirect", "albedo", "normal")}
        met = self.field("surface_count")[:, None] > 0
        position = np.where(met, self.field("position") + centre, 0.0).astype(np.float32)
        layers["position"] = position.reshape(self.height, self.width, 3)
        layers["depth"] = np.where(met[:, 0], self.field("depth"), np.float32(0.0)).reshape(self.height, self.width, 1)
        count = self.field("count")[:, None].astype(np.float64)
        # one sample tells nothing of its variance
        variance = np.where(count > 1, self.field("squares") / np.maximum(count * (count - 1), 1.0), 0.0)
        layers["variance"] = variance.astype(np.float32).reshape(self.height, self.width, 3)
        return layers

    def _image(self, name: str) -> np.ndarray:
        # a copy: the field may be a live view of the device's memory
        return self.field(name).reshape(self.height, self.width, 3).copy()

    def _shape(self, dtype: object) -> tuple[int, ...]:
        return (self.pixel_count, 3) if dtype is wp.vec3 else (self.pixel_count,)


def _numpy(dtype: object) -> type:
    return np.int32 if dtype is int else np.float32
