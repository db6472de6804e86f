"""More samples where a picture needs them: path tracing of chosen pixels."""

from __future__ import annotations

import numpy as np

from warpgi.device import Device
from warpgi.device_scene import DeviceScene
from warpgi.film import BYTES_PER_PIXEL, Film
from warpgi.job import Job
from warpgi.kernels.chosen_paths import trace_chosen
from warpgi.methods.path import PathTracing
from warpgi.scene import Scene


def trace_pixels(
    scene: Scene, pixels: np.ndarray, method: PathTracing, size: tuple[int, int], seed: int, device: Device
) -> np.ndarray:
    """Indirect radiance of some pixels, as `render` would give it, shape (n, 3), float32.

    Args:
        scene: what to render.
        pixels: y * width + x of each, shape (n,).
        method: settings of the paths.
        size: (width, height) of the whole picture.
        seed: which random numbers.
        device: where to compute.
    """
    device.load([trace_chosen])
    on_device = DeviceScene(scene, device)
    step = max(1, (device.memory_limit - on_device.nbytes) // (BYTES_PER_PIXEL + 4))
    result = np.zeros((len(pixels), 3), np.float32)
    for start in range(0, len(pixels), step):
        part = pixels[start : start + step]
        film = Film((len(part), 1), device, BYTES_PER_PIXEL * len(part))
        job = Job(on_device, on_device.camera(size), size, seed, device)
        state = method.prepare(job, film)
        inputs = [on_device.struct, job.camera, state, device.array(part.astype(np.int32), int), method.spp]
        device.launch(trace_chosen, len(part), inputs, [film.load(film.bands[0])])
        result[start : start + step] = film.field("indirect")
    return result
