"""Intel Open Image Denoise (Áfra 2025) as a peer: the filter that a user would pick today for a noisy picture."""

from __future__ import annotations

import time
from typing import Any, NamedTuple

import numpy as np

from bench.mitsuba_peer import MissingPeer

# Below so much albedo nothing of the layer's light can be told from rounding.
LEAST_ALBEDO = 1e-3


class Denoised(NamedTuple):
    """What the filter made, and how long it took."""

    layer: np.ndarray
    """Linear radiance, shape (H, W, 3), float32."""
    seconds: float
    """For running the filters."""
    setup_seconds: float
    """For making and committing device and filters, once for a picture's size; weights are unpacked there."""


class OidnPeer:
    """Denoises layers on the CPU.

    The defaults are what serves it best: over the albedo it was worse in diffuse scenes and no better in glossy ones,
    and prefiltering took two or three times as long for less than a tenth of the error either way.

    Args:
        threads: CPU threads.
        demodulate: filter the layer over its albedo, and multiply that back.
        prefilter: filter albedo and normal by themselves first; else they are taken for free of noise as they are.

    Raises:
        MissingPeer: pyoidn is not installed.
    """

    def __init__(self, threads: int, demodulate: bool = False, prefilter: bool = False) -> None:
        try:
            import pyoidn
        except ImportError as error:
            raise MissingPeer("pyoidn is not installed, expected it for its peer: pip install warpgi[peers]") from error
        self.oidn, self.threads = pyoidn, threads
        self.demodulate, self.prefilter = demodulate, prefilter
        self.version: str = pyoidn.version.oidn_version

    def denoise(self, layer: np.ndarray, albedo: np.ndarray, normal: np.ndarray) -> Denoised:
        """A layer without its noise.

        Args:
            layer: linear radiance, 0 or more, shape (H, W, 3).
            albedo: in [0, 1], shape (H, W, 3).
            normal: in [-1, 1], shape (H, W, 3).
        """
        images = {
            name: np.ascontiguousarray(image, dtype=np.float32)
            for name, image in (("color", layer), ("albedo", albedo), ("normal", normal))
        }
        base = np.maximum(images["albedo"], LEAST_ALBEDO) if self.demodulate else None
        if base is not None:
            images["color"] = images["color"] / base
        start = time.perf_counter()
        with self.oidn.Device(self.oidn.OIDN_DEVICE_TYPE_CPU) as device:
            device.set_int("numThreads", self.threads)
            device.commit()
            guides = ("albedo", "normal") if self.prefilter else ()
            stages = [self._filter(device, {name: images[name]}, name) for name in guides]
            clean = images | {name: output for name, (_, output) in zip(guides, stages, strict=True)}
            stages.append(self._filter(device, clean, "color"))
            ready = time.perf_counter()
            for stage, _ in stages:
                stage.execute()
            device.wait()
            done = time.perf_counter()
            fault = device.get_error()
            for stage, _ in stages:
                stage.release()
        if fault is not None:
            raise RuntimeError(f"Open Image Denoise failed: {fault}")
        output = stages[-1][1]
        return Denoised(output if base is None else output * base, done - ready, ready - start)

    def _filter(self, device: Any, images: dict[str, np.ndarray], main: str) -> tuple[Any, np.ndarray]:
        """A committed filter of `images`, which have to stay alive, and the array that it will fill."""
        result = self.oidn.Filter(device, self.oidn.OIDN_FILTER_TYPE_RT)
        output = np.empty_like(images[main])
        for name, image in (images | {"output": output}).items():
            result.set_image(name, image, self.oidn.OIDN_FORMAT_FLOAT3)
        if main == "color":
            result.set_bool("hdr", True)
            result.set_bool("cleanAux", True)
        result.commit()
        return result, output
