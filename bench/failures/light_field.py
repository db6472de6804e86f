"""Where light-field reconstruction fails: thin walls, foliage, single samples, gloss, mirrors, hair and motion."""

from __future__ import annotations

import numpy as np

import warpgi as gi
from bench.failures.failure import Failure, Value, indirect, inside_ring, mean_value
from bench.reference import make_reference


def leak(device: gi.Device) -> Value:
    """Mean light of the dark room over that of the lit one, 4 columns beside the wall left out."""
    scene, _ = gi.scenes.leak(open_front=True)
    pictures = [indirect(scene, gi.LightField(spp=4, rays=64), (48, 36), seed, device) for seed in range(1, 5)]
    return mean_value([float(picture[:, 26:].mean() / picture[:, :22].mean()) for picture in pictures])


def foliage(device: gi.Device) -> Value:
    """How far mean light of leaves is from path tracing's, as a share of it."""
    scene, size = gi.scenes.courtyard(detail=0.05), (64, 48)
    ours = mean_value([indirect(scene, gi.LightField(rays=32), size, seed, device).mean() for seed in range(4)])
    truth = make_reference(scene, size, 512, device=device)
    # means of halves differ by twice the standard error of their mean
    noise = 0.5 * abs(float(np.diff(truth.halves.mean(axis=(1, 2, 3)))[0]))
    mean = float(truth.image.mean(dtype=np.float64))
    return Value(abs(ours.value / mean - 1.0), float(np.hypot(ours.error or 0.0, noise)) / mean)


def _one_sample(device: gi.Device) -> np.ndarray:
    """relMSE at one sample per pixel of input, reconstruction, and that with recursive=1; shape (3, seeds)."""
    scene, size = gi.scenes.cornell_box(), (64, 64)
    truth = make_reference(scene, size, 1024, device=device)
    methods = [gi.PathTracing(spp=1), *(gi.LightField(spp=1, rays=64, recursive=k) for k in (0, 1))]
    return np.array(
        [[truth.judge(indirect(scene, m, size, s, device))["relmse"] for s in range(1, 5)] for m in methods]
    )


def one_sample(device: gi.Device) -> Value:
    """relMSE of a reconstruction over that of its input."""
    input_errors, errors, _ = _one_sample(device)
    return mean_value(errors / input_errors)


def one_sample_recursive(device: gi.Device) -> Value:
    """relMSE with recursive filtering over that without."""
    _, errors, recursive = _one_sample(device)
    return Value(float(recursive.mean() / errors.mean()))


def unsupported(device: gi.Device) -> Value:
    """Share of rays that meet no splat in a closed room with few samples."""
    scene, _ = gi.scenes.furnace(albedo=0.5, shape="blocks")
    counts = [gi.render(scene, gi.LightField(spp=1, rays=64), (24, 24), s, device).counts for s in range(4)]
    return mean_value([c["missing_support"] / c["reconstruction_rays"] for c in counts])


GLOSS_SIZE = (64, 64)


def gloss_energy(device: gi.Device) -> Value:
    """How far mean light of a picture with glass and metal is from path tracing's, as a share of it."""
    scene = gi.scenes.caustic(roughness=0.2)
    mean = make_reference(scene, GLOSS_SIZE, 1024, device=device).image.mean(dtype=np.float64)
    method = gi.LightField(spp=8, rays=64)
    found = mean_value([indirect(scene, method, GLOSS_SIZE, seed, device).mean() for seed in range(4)])
    return Value(abs(found.value / mean - 1.0), (found.error or 0.0) / mean)


def gloss_blur(device: gi.Device) -> Value:
    """RMS error of a caustic over the truth's own spread: 1 is a caustic that is not there. Noise is a part of it."""
    scene = gi.scenes.caustic(roughness=0.2)
    truth = make_reference(scene, GLOSS_SIZE, 1024, device=device).image.astype(np.float64)
    renders = [gi.render(scene, gi.LightField(spp=8, rays=64), GLOSS_SIZE, seed, device) for seed in range(4)]
    inside = inside_ring(scene, renders[0])
    spread = truth[inside].std(axis=0)
    errors = [(render.layers["indirect"][inside] - truth[inside]) / spread for render in renders]
    return mean_value([float(np.sqrt(np.square(error).mean())) for error in errors])


def _under(ceiling: gi.Mirror) -> gi.Scene:
    """A coated floor seen from the side, lit from close by, under a wide ceiling."""

    def flat(
        material: gi.Coated | gi.Mirror, height: float, size: float, faces: list[tuple[int, int, int]]
    ) -> gi.Shape:
        corners = [(-size, height, -size), (-size, height, size), (size, height, size), (size, height, -size)]
        return gi.Shape(corners, faces, material)

    shapes = [flat(gi.Coated(0.6, 0.05), 0, 1, [(0, 1, 2), (0, 2, 3)]), flat(ceiling, 1, 4, [(0, 2, 1), (0, 3, 2)])]
    camera = gi.Camera((0.0, 0.6, 1.6), (0.0, 0.0, 0.0), fov=40)
    return gi.Scene(shapes, camera, [gi.PointLight((0.3, 0.5, -0.2), (2.0, 1.5, 1.0))], name="mirror-ceiling")


def mirror_energy(device: gi.Device) -> Value:
    """How far mean light of a floor under a mirror is from path tracing's, as a share of it."""
    scene, size = _under(gi.Mirror(0.8)), (48, 48)
    mean = make_reference(scene, size, 256, device=device).image.mean(dtype=np.float64)
    method = gi.LightField(spp=8, rays=64)
    found = mean_value([indirect(scene, method, size, seed, device).mean() for seed in range(4)])
    return Value(abs(found.value / mean - 1.0), (found.error or 0.0) / mean)


def hair_excess(device: gi.Device) -> Value:
    """Brightest pixel's mean incident light over the brightest input sample's, of thin glossy strands: at most 1."""
    rng = np.random.default_rng(7)
    count = 400
    root = np.concatenate([rng.uniform(-1.0, 1.0, (count, 2)), np.zeros((count, 1))], axis=1)
    tip = root + np.array([0.0, 0.0, 0.8]) + rng.normal(0.0, 0.15, (count, 3))
    side = 0.004 * np.cross(tip - root, rng.normal(size=(count, 3)))
    vertices = np.concatenate([root - side, root + side, tip])
    faces = np.arange(count)[:, None] + count * np.arange(3)
    floor = [(-1.2, -1.2, 0.0), (1.2, -1.2, 0.0), (1.2, 1.2, 0.0), (-1.2, 1.2, 0.0)]
    shapes = [gi.Shape(vertices, faces, gi.Conductor(0.05)), gi.Shape(floor, [(0, 1, 2), (0, 2, 3)], gi.Diffuse(0.5))]
    scene = gi.Scene(
        shapes, gi.Camera((0, -2.5, 1.5), (0, 0, 0.3), fov=45), [gi.DistantLight((0.3, 0.4, -1), (3, 3, 3))]
    )
    found = []
    for seed in range(4):
        samples = gi.sample(scene, 4, (32, 24), seed, device, glossy=True)
        method = gi.LightField(rays=64)
        state = method.reconstruction(samples, device, seed)
        state.gather(0, 16, 16)
        diffuse = samples.material == 1
        found.append(float(state.incident()[diffuse].max() / samples.radiance.max()))  # type: ignore[union-attr]
    return mean_value(found)


def disoccluded(device: gi.Device) -> Value:
    """Share of rays without support where things move; pixels that hold no other keep their input."""
    method = gi.LightField(spp=1, rays=32, primary_rays=True)
    counts = [gi.render(gi.scenes.butterflies(), method, (96, 54), seed, device).counts for seed in range(4)]
    return mean_value([c["missing_support"] / c["reconstruction_rays"] for c in counts])


def lens_energy(device: gi.Device) -> Value:
    """How far mean light through a lens is from path tracing's, as a share of it."""
    scene, size = gi.scenes.butterflies(), (96, 54)
    truth = gi.render(scene, gi.PathTracing(spp=256), size, 1 << 30, device).image.mean(dtype=np.float64)
    method = gi.LightField(spp=1, rays=32, primary_rays=True)
    found = mean_value([float(gi.render(scene, method, size, seed, device).image.mean()) for seed in range(4)])
    return Value(abs(found.value / truth - 1.0), (found.error or 0.0) / truth)


def _row(scene: str, what: str, bound: float | None, measure) -> Failure:
    return Failure("light-field", scene, what, bound, measure)


ROWS = (
    _row("leak, open front", "light in the dark room, of the lit one's, 4 spp", 0.01, leak),
    _row("courtyard", "mean light beside path tracing's, relative, 8 spp", 0.02, foliage),
    _row("cornell-box", "relMSE over that of the input, 1 spp", 1.0, one_sample),
    _row("cornell-box", "relMSE with recursive=1 over that without, 1 spp", 0.9, one_sample_recursive),
    _row("furnace, blocks", "rays that meet no splat, share, 1 spp", 0.01, unsupported),
    _row("caustic, rough ring", "mean light beside path tracing's, relative, 8 spp", None, gloss_energy),
    _row("caustic, rough ring", "RMS error inside the ring over the truth's spread, 8 spp", None, gloss_blur),
    _row("floor under a mirror", "mean light beside path tracing's, relative, 8 spp", 0.02, mirror_energy),
    _row("glossy strands", "brightest incident light over the brightest input sample's, 4 spp", 1.0, hair_excess),
    _row("butterflies", "rays through lens and shutter without support, share, 1 spp", 0.001, disoccluded),
    _row("butterflies", "mean light beside path tracing's, relative, 1 spp", 0.02, lens_energy),
)
