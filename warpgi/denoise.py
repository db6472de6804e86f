"""`denoise`: an image-space filter on a finished picture, whoever rendered it."""

from __future__ import annotations

from collections.abc import Callable, Mapping

import numpy as np

from warpgi.device import Device, as_device
from warpgi.methods import DENOISERS, ATrous, IrradianceFilter, RandomParameterFilter
from warpgi.passes import Passes
from warpgi.progress import Progress, progress_bar
from warpgi.render import Interrupted, provenance
from warpgi.result import Render
from warpgi.timing import Timings


def denoise(
    picture: Render | Mapping[str, np.ndarray],
    method: ATrous | IrradianceFilter | None = None,
    device: str | Device | None = None,
    progress: bool | Callable[[Progress], None] = False,
) -> Render:
    """Filters the layer "indirect" of a picture, or where there is none its image, and keeps what else it holds.

    It needs the feature layers that the filter looks at: albedo, normal and position, or depth in its place; for
    `IrradianceFilter` also "hit_distance". `gi.Render.load` finds them in the EXR files of other renderers. Pixels
    without a surface stay as they are; a pixel that is NaN or infinite takes what its neighbours say. Whatever a
    mirror shows is blurred unless the features follow its reflection, as Blender's denoising passes do.

    Args:
        picture: a `Render`, or its layers by name, float32 of shape (H, W, C).
        method: `ATrous` by default; settings that say how samples are traced mean nothing here.
        device: "cpu", "cuda:0", a `Device`, or None for a GPU if there is one.
        progress: True shows a bar on standard error; a function gets a `Progress` after every pass.

    Returns:
        The picture's layers, the filtered one in place of its input and without "variance", which it no longer has.
        `counts["nonfinite_pixels"]` says how many pixels were not finite.

    Raises:
        TypeError, ValueError: an argument is wrong or a layer is missing; nothing has been computed then.
        Interrupted: Ctrl-C; a KeyboardInterrupt that carries the picture so far.

    Example:
        >>> import warpgi as gi
        >>> noisy = gi.render(gi.scenes.cornell_box(), gi.PathTracing(spp=2), size=(16, 16))
        >>> gi.denoise(noisy, gi.ATrous()).image.shape
        (16, 16, 3)
    """
    method = ATrous() if method is None else method
    if isinstance(method, RandomParameterFilter):
        raise TypeError(
            "RandomParameterFilter works on samples, not on pixels, expected a sample buffer in gi.reconstruct or a"
            " scene in gi.render"
        )
    if not isinstance(method, tuple(DENOISERS.values())):
        names = " or ".join(kind.__name__ for kind in DENOISERS.values())
        raise TypeError(f"method is {type(method).__name__}, expected {names}")
    if not isinstance(picture, Render):
        if not isinstance(picture, Mapping):
            raise TypeError(f"picture is {type(picture).__name__}, expected a Render or its layers by name")
        picture = Render(dict(picture))
    name = "indirect" if "indirect" in picture.layers else "image"
    before = picture.layers["indirect"] if name == "indirect" else picture.image
    where = as_device(device)
    timings = Timings()
    with timings.stage("compile"):
        where.load(method.filter_kernels)
    passes = Passes(*method.passes())
    interrupted = False
    try:
        with timings.stage("prepare"):
            state = method.on_layers(picture.layers | {name: before}, name, where)
            where.synchronize()
        with timings.stage("estimate"), progress_bar(progress) as report:
            passes.run(lambda first, count: state.gather(first, count, passes.total), where, report, state.all_counts)
    except KeyboardInterrupt:
        if passes.done == 0:
            raise Interrupted(None, passes) from None
        interrupted = True
    with timings.stage("image"):
        layers = {key: layer for key, layer in picture.layers.items() if key != "variance"}
        layers[name] = state.picture()
        if name == "indirect" and "image" in layers:
            with np.errstate(invalid="ignore"):
                layers["image"] = layers["image"] + (layers[name] - before)
        result = Render(
            layers,
            dict(timings),
            state.all_counts(),
            spp=picture.spp,
            scene=picture.scene,
            **provenance(method, picture.seed, where),
        )
        result.settings["input"] = {"method": picture.method, "settings": picture.settings}
    result.timings["image"] = timings["image"]
    if interrupted:
        raise Interrupted(result, passes)
    return result
