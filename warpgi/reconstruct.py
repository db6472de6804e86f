"""`reconstruct`: a picture from a sample buffer alone."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from warpgi import checks
from warpgi.device import Device, as_device
from warpgi.filtering import SampleFilter, hit_distance
from warpgi.methods import RECONSTRUCTIONS, AmbientOcclusion, LightField, TemporalLightField
from warpgi.passes import Passes
from warpgi.progress import Progress, progress_bar
from warpgi.reconstruction import pixel_means
from warpgi.render import Interrupted, provenance
from warpgi.result import Render
from warpgi.samples import SampleBuffer
from warpgi.timing import Timings


def reconstruct(
    samples: SampleBuffer,
    method: LightField | AmbientOcclusion | TemporalLightField | SampleFilter | None = None,
    seed: int = 0,
    device: str | Device | None = None,
    progress: bool | Callable[[Progress], None] = False,
) -> Render:
    """Reconstructs or filters indirect light, ambient occlusion, or defocus and motion; no scene is needed.

    Args:
        samples: the input, from `sample`, a file or any other renderer.
        method: `LightField` by default; settings that say how samples are traced mean nothing here.
        seed: which reconstruction rays, 0 to 2^31 - 1.
        device: "cpu", "cuda:0", a `Device`, or None for a GPU if there is one.
        progress: True shows a bar on standard error; a function gets a `Progress` after every pass.

    Returns:
        Layers "indirect" (or "image" for what makes the whole picture), "albedo", "normal", "position",
        "hit_distance", and "direct" where the samples hold it. `counts` says how many samples could not be used and how
        many rays found no support.

    Raises:
        TypeError, ValueError: an argument is wrong; nothing has been computed then.
        Interrupted: Ctrl-C; a KeyboardInterrupt that carries the picture so far.

    Example:
        >>> import warpgi as gi
        >>> samples = gi.sample(gi.scenes.cornell_box(), spp=2, size=(8, 8))
        >>> gi.reconstruct(samples, gi.LightField(rays=16)).layers["indirect"].shape
        (8, 8, 3)
    """
    method = LightField() if method is None else method
    if not isinstance(samples, SampleBuffer):
        raise TypeError(f"samples is {type(samples).__name__}, expected SampleBuffer")
    if not isinstance(method, tuple(RECONSTRUCTIONS.values())):
        *names, last = (kind.__name__ for kind in RECONSTRUCTIONS.values())
        raise TypeError(f"method is {type(method).__name__}, expected {', '.join(names)} or {last}")
    chosen: Any = method  # its state is its own affair
    checks.count("seed", seed, 0)
    where = as_device(device)
    timings = Timings()
    with timings.stage("compile"):
        where.load(chosen.kernels)
    spp = samples.spp or max(1, round(len(samples) / (samples.width * samples.height)))
    passes = Passes(*chosen.passes(spp))
    interrupted = False
    try:
        with timings.stage("prepare"):
            state = chosen.reconstruction(samples, where, seed)
            where.synchronize()
        with timings.stage("estimate"), progress_bar(progress) as report:
            passes.run(lambda first, count: state.gather(first, count, passes.total), where, report, state.all_counts)
    except KeyboardInterrupt:
        if passes.done == 0:
            raise Interrupted(None, passes) from None
        interrupted = True
    with timings.stage("image"):
        layers = _layers(samples) | chosen.layers(state)
        render = Render(layers, dict(timings), state.all_counts(), spp=spp, **provenance(chosen, seed, where))
    render.timings["image"] = timings["image"]
    if interrupted:
        raise Interrupted(render, passes)
    return render


def _layers(samples: SampleBuffer) -> dict[str, np.ndarray]:
    """Means of what the samples know of their primary hits."""
    primary = samples.checked.is_primary
    zero = np.float32(0.0)
    values = {"albedo": samples.albedo, "normal": samples.unit_origin_normal}
    if samples.direct is not None:
        values["direct"] = samples.direct
    layers = {name: pixel_means(samples, np.where(primary[:, None], value, zero)) for name, value in values.items()}
    share = pixel_means(samples, np.repeat(primary[:, None].astype(np.float32), 3, axis=1))
    position = pixel_means(samples, np.where(primary[:, None], samples.origin, zero))
    layers["position"] = position / np.where(share > 0, share, np.float32(1.0))
    layers["hit_distance"] = hit_distance(samples)
    return layers
