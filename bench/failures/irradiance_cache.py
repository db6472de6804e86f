"""Where irradiance caches fail: splotches of noisy records, thin walls, and small bright details beside records."""

from __future__ import annotations

import numpy as np

import warpgi as gi
from bench.failures.failure import Failure, Value, indirect, mean_value
from bench.reference import make_reference

SIZE = (96, 96)
BOX = 9  # pixels across of the filter that leaves low frequencies


def _low(image: np.ndarray) -> np.ndarray:
    """A picture after a box filter, whole boxes only."""
    sums = np.pad(image.cumsum(axis=0).cumsum(axis=1), ((1, 0), (1, 0), (0, 0)))
    return (sums[BOX:, BOX:] - sums[:-BOX, BOX:] - sums[BOX:, :-BOX] + sums[:-BOX, :-BOX]) / BOX**2


def _splotches(method: object, device: gi.Device) -> np.ndarray:
    """Low-frequency error over that of path tracing with as many rays, root mean squares, for each of four seeds."""
    scene = gi.scenes.cornell_box()
    truth = _low(make_reference(scene, SIZE, 1024, device=device).image.astype(np.float64))
    ratios = []
    for seed in range(4):
        render = gi.render(scene, method, SIZE, seed, device)  # type: ignore[arg-type]
        rays = sum(render.counts.get(name, 0) for name in ("record_rays", "fallback_rays"))
        spp = max(1, round(rays / (SIZE[0] * SIZE[1])))
        noisy = indirect(scene, gi.PathTracing(spp=spp), SIZE, seed, device)
        ours = render.layers["indirect"].astype(np.float64)
        errors = [np.sqrt(np.mean(np.square(_low(image) - truth))) for image in (ours, noisy)]
        ratios.append(errors[0] / errors[1])
    return np.array(ratios)


def splotches(device: gi.Device) -> Value:
    """Few paths to a record, no gradients."""
    return mean_value(_splotches(gi.IrradianceCache(rays=64, gradients=False, fallback_rays=8), device))


def splotches_gradients(device: gi.Device) -> Value:
    """The same with gradients."""
    return mean_value(_splotches(gi.IrradianceCache(rays=64, fallback_rays=8), device))


def splotches_light_field(device: gi.Device) -> Value:
    """The same with records from splats."""
    method = gi.LightField(spp=1, primary_hits=8, rays=8, record_rays=64, cache=True, recursive=1, recursive_rays=4)
    return mean_value(_splotches(method, device))


def sparse_gradients(device: gi.Device) -> Value:
    """Low-frequency error with gradients over that without, where records are few and their noise is not what shows."""
    scene = gi.scenes.cornell_box()
    truth = _low(make_reference(scene, SIZE, 1024, device=device).image.astype(np.float64))
    ratios = []
    for seed in range(4):
        methods = [gi.IrradianceCache(rays=1024, tolerance=0.6, gradients=on) for on in (True, False)]
        pictures = [_low(indirect(scene, method, SIZE, seed, device).astype(np.float64)) for method in methods]
        errors = [np.sqrt(np.mean(np.square(picture - truth))) for picture in pictures]
        ratios.append(errors[0] / errors[1])
    return mean_value(ratios)


def leak(device: gi.Device) -> Value:
    """Mean light of the dark room over that of the lit one, 4 columns beside the wall left out."""
    scene, _ = gi.scenes.leak(open_front=True)
    values = []
    for seed in range(4):
        picture = indirect(scene, gi.IrradianceCache(spp=2, rays=256), (48, 36), seed, device)
        values.append(float(picture[:, 26:].mean() / picture[:, :22].mean()))
    return mean_value(values)


def _detail(tolerance: float, device: gi.Device) -> Value:
    """RMS error over the mean, of a floor around a lit cube that is small beside the distance of records."""
    cube = np.array([(x, y, z) for x in (0, 1) for y in (0, 1) for z in (0, 1)], float) * 0.06 - (0.03, 0.0, 0.03)
    faces = [
        (0, 1, 3),
        (0, 3, 2),
        (4, 6, 7),
        (4, 7, 5),
        (0, 4, 5),
        (0, 5, 1),
        (2, 3, 7),
        (2, 7, 6),
        (0, 2, 6),
        (0, 6, 4),
    ]
    faces += [(1, 5, 7), (1, 7, 3)]
    shapes = [
        gi.Shape([(-1, 0, -1), (-1, 0, 1), (1, 0, 1), (1, 0, -1)], [(0, 1, 2), (0, 2, 3)], gi.Diffuse(0.5)),
        gi.Shape(cube, faces, gi.Diffuse(0.9)),
    ]
    lights = [gi.DistantLight(direction=(1, -0.2, 0.3), irradiance=3.0)]
    scene = gi.Scene(shapes, gi.Camera((0, 1.2, 1.2), target=(0, 0, 0), fov=40), lights, name="lit cube")
    truth = make_reference(scene, (64, 64), 1024, device=device)
    values = []
    for seed in range(4):
        render = gi.render(scene, gi.IrradianceCache(rays=1024, tolerance=tolerance), (64, 64), seed, device)
        floor = np.abs(render.layers["position"][..., 1]) < 1e-4
        near = floor & (np.linalg.norm(render.layers["position"][..., ::2], axis=2) < 0.2)
        error = (render.layers["indirect"] - truth.image)[near].astype(np.float64)
        noise = float(np.square(truth.standard_error[near]).mean())
        values.append(float(np.sqrt(max(np.square(error).mean() - noise, 0.0)) / truth.image[near].mean()))
    return mean_value(values)


def detail(device: gi.Device) -> Value:
    """At the usual tolerance."""
    return _detail(0.3, device)


def detail_half(device: gi.Device) -> Value:
    """At half of it."""
    return _detail(0.15, device)


def _row(scene: str, what: str, bound: float | None, measure) -> Failure:
    return Failure("irradiance-cache", scene, what, bound, measure)


BESIDE = "9 x 9 box error over path tracing's at equal rays"
ROWS = (
    _row("cornell-box", f"{BESIDE}, no gradients", None, splotches),
    _row("cornell-box", f"{BESIDE}, gradients", 1.0, splotches_gradients),
    _row("cornell-box", f"{BESIDE}, records from splats", 0.8, splotches_light_field),
    _row("cornell-box", "9 x 9 box error at tolerance 0.6, gradients over none", 0.8, sparse_gradients),
    _row("leak, open front", "light in the dark room, of the lit one's", 0.001, leak),
    _row("lit cube", "RMS error around it over the mean", 2.0, detail),
    _row("lit cube", "the same at half the tolerance", None, detail_half),
)
