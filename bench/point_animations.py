"""The statistical filter at points of surfaces, among the other ways to make a sequence (MA06, section 3.1)."""

from __future__ import annotations

import time
from pathlib import Path
from typing import Any

import numpy as np

import warpgi as gi
from bench.figures import GAP, WHITE
from bench.reference import make_reference
from warpgi import checks
from warpgi.device_scene import DeviceScene
from warpgi.image import check_output, write_png
from warpgi.point_animation import PointRun
from warpgi.poisson_disc import poisson_disc
from warpgi.surface_points import SurfacePoints

# Random places on a shape to each of the discs that would cover it, so that few are missed.
PLACES_PER_DISC = 30
MOST_PLACES = 1 << 18


def draw(
    out: Path, scene: str, size: tuple[int, int], frames: int, frame: int, reference_spp: int, device: str | None
) -> None:
    """A frame's indirect light by 16 paths per pixel, by filtered points, and path-traced, side by side."""
    check_output(out)
    checks.image_size(size)
    checks.count("reference_spp", reference_spp, 2)
    sequence, where = gi.scenes.build_sequence(scene, frames=frames), gi.Device(device)
    reference = make_reference(sequence.scene(frame), size, reference_spp, device=where)
    noisy = gi.render(sequence.scene(frame), gi.PathTracing(spp=16), size, 0, where)
    points = gi.render_animation(sequence, gi.PointFilter(), size, 0, where)
    print(describe(sequence, gi.PointFilter(), size, where))
    pictures = [render.layers["indirect"] for render in (noisy, points[frame])]
    for picture, name in zip(pictures, ("path, 16 spp", "points"), strict=True):
        print(f"{name}: relmse {reference.judge(picture)['relmse']:.3g}")
    gap = np.full((size[1], GAP, 3), WHITE, np.float32)
    row = [part for picture in (*pictures, reference.image) for part in (picture, gap)][:-1]
    write_png(out, np.concatenate(row, axis=1).astype(np.float32), 2.0)
    print(f"wrote {out}")


def filtered_points(judge: Any, sequence: gi.Sequence, contest: Any, device: gi.Device) -> list[Any]:
    """Standing of the points, filtered; and how many points there are, and would be if all surfaces had them."""
    method = gi.PointFilter()
    # compiles
    gi.render_animation(sequence, gi.PointFilter(spp=1, rays=1), contest.size, 0, device, frames=[0, 1])
    start = time.perf_counter()
    pictures = gi.render_animation(sequence, method, contest.size, 0, device, True)
    seconds = time.perf_counter() - start
    images = np.stack([pictures[frame].layers["indirect"] for frame in judge.frames])
    print(describe(sequence, method, contest.size, device))
    shares = ", ".join(f"{name} {pictures.timings[name]:.2f} s" for name in ("points", "light", "filter"))
    modes = pictures.modes
    assert modes is not None
    print(f"{shares}; {modes.count} modes by {modes.rule.value}, {modes.truncation.mean():.2f} in the mean over points")
    return [judge.standing(f"points, {method.rays} paths, filtered", seconds, images)]


def describe(sequence: gi.Sequence, method: gi.PointFilter, size: tuple[int, int], device: gi.Device) -> str:
    """How many points a sequence has, and how many no frame sees, in words."""
    run = PointRun(sequence, method, size, 0, device, tuple(range(sequence.frames)))
    for number in run.numbers:
        run.look_at(number)
    run.choose()
    scene = run.rest.scene
    whole = whole_count(run.points, run.rest, device)
    glossy = sum(len(light.points) for light in run.lights if light.width > 1)
    return (
        f"{len(run.points)} points on {len(scene.shapes)} shapes, {glossy} of them glossy; all surfaces would have"
        f" about {whole}: {max(whole - len(run.points), 0)} are hidden in all frames and not computed"
    )


def whole_count(points: SurfacePoints, rest: DeviceScene, device: gi.Device) -> int:
    """Points that whole shapes would have, by discs of the median distance of their points that are seen."""
    rng = np.random.default_rng(0)
    total = 0
    for number, shape in enumerate(rest.scene.shapes):
        own = points.radius[points.shape == number]
        radius = float(np.median(own if len(own) else points.radius))
        areas = shape.areas()
        wanted = PLACES_PER_DISC * areas.sum() / radius**2
        count = int(np.clip(wanted, 64, MOST_PLACES))
        faces = rng.choice(len(areas), count, p=areas / areas.sum())
        a, b, c = (shape.vertices[shape.faces[faces, i]] for i in range(3))
        u, v = np.sqrt(rng.random((count, 1))), rng.random((count, 1))
        normal = np.cross(b - a, c - a)
        normal /= np.linalg.norm(normal, axis=1, keepdims=True)
        total += len(poisson_disc(a * (1 - u) + b * u * (1 - v) + c * u * v, normal, radius, 0, device=device))
    return total
