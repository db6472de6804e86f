"""The statistical filter on points of surfaces: their light frame by frame, filtered in time, and pictures of it."""

from __future__ import annotations

import os
import time
import zipfile
from collections import Counter
from collections.abc import Callable
from collections.abc import Sequence as Series
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import warp as wp

import warpgi
from warpgi.animation import Animation
from warpgi.device import Device
from warpgi.device_scene import DeviceScene
from warpgi.film import Film
from warpgi.filter_animation import MODES
from warpgi.fingerprint import fingerprint
from warpgi.frame_files import FrameFiles, make_frames
from warpgi.frame_renderer import frame_seed
from warpgi.image import atomic_write
from warpgi.job import Job
from warpgi.methods.path import NEVER
from warpgi.methods.point_filter import PointFilter
from warpgi.point_light import PointLight, glossy_shapes, lights_at
from warpgi.progress import Progress, progress_bar
from warpgi.render import render_scene
from warpgi.result import Render
from warpgi.sampling import path_settings, trace_primary_hits
from warpgi.sequence import Sequence
from warpgi.statistical_filtering import FrameMatrix, Projection
from warpgi.surface_points import PointCollector, SurfacePoints
from warpgi.timing import Timings

FORMAT = 1

# Camera rays that look for places of points, in all frames together: enough to find all that few frames show.
LEAST_PLACES = 1 << 16
MOST_RAYS_PER_PIXEL = 16


def render_points(
    sequence: Sequence,
    method: PointFilter,
    size: tuple[int, int],
    seed: int,
    device: Device,
    progress: bool | Callable[[Progress], None],
    out: str | os.PathLike[str] | None,
    resume: bool,
    numbers: tuple[int, ...],
) -> Animation:
    """`render_animation` with a `PointFilter`, its arguments checked.

    Noisy light of the points is kept in a folder "points" beside `out`, basis functions in modes.npz beside the frames.
    """
    files = None if out is None else FrameFiles(out)
    run = PointRun(sequence, method, size, seed, device, numbers, files, resume)
    for number in numbers:
        run.look_at(number)
    run.choose()
    began = time.perf_counter()
    with progress_bar(progress) as report:
        for done, number in enumerate(numbers, 1):
            run.trace(number)
            if report is not None:
                report(Progress(done, len(numbers), "frames of light", time.perf_counter() - began, dict(run.counts)))
    run.filter()
    # points are counted once, not by every picture that they light
    sources, rendered = make_frames(
        numbers, run.identity, run.picture, files, resume, run.timings, run.counts, progress, uncounted=("points",)
    )
    if files:
        run.modes.save(files.path(numbers[0]).with_name(MODES))
    return Animation(sources, numbers, sequence.fps, dict(run.timings), dict(run.counts), tuple(rendered), run.modes)


class PointRun:
    """Points of one sequence, from what its camera sees to its pictures.

    Timings: "points" chooses them, "light" traces what falls on them, "filter" smooths it; the others are a picture's.

    Attributes:
        points: the points, once they are chosen.
        modes: basis functions and truncations of the points' light, a picture one point high, once it is filtered.
        identity: digest of all that the pictures depend on.
    """

    points: SurfacePoints

    def __init__(
        self,
        sequence: Sequence,
        method: PointFilter,
        size: tuple[int, int],
        seed: int,
        device: Device,
        numbers: tuple[int, ...],
        files: FrameFiles | None = None,
        resume: bool = False,
    ) -> None:
        self.sequence, self.method, self.size, self.seed, self.device = sequence, method, size, seed, device
        self.numbers, self.files, self.resume = numbers, files, resume
        self.timings, self.counts = Timings(), Counter[str]()
        with self.timings.stage("compile"):
            device.load(method.kernels)
        self.rest = DeviceScene(sequence.scene(0), device)
        exponent = 0.0 if method.roughness is None else 1.0 / method.roughness
        self._collector = PointCollector(self.rest, method.spacing, seed, exponent * (1.0 + 1e-6))
        pixels = size[0] * size[1] * len(numbers)
        self._rays_per_pixel = min(max(1, -(-LEAST_PLACES // pixels)), MOST_RAYS_PER_PIXEL)
        self._before = self.rest
        self._glossy = np.zeros(len(self.rest.scene.shapes), bool)
        self._values: dict[int, dict[str, np.ndarray]] = {}
        self._identities: dict[int, str] = {}

    def look_at(self, number: int) -> None:
        """Looks for places of points in a frame.

        Raises:
            ValueError: shapes move while its shutter is open.
        """
        scene = self.sequence.scene(number)
        if scene.moves:
            raise ValueError(f"frame {number}: the scene moves, which PointFilter cannot render, expected a still one")
        # materials may change from frame to frame
        self._glossy |= glossy_shapes(scene, self.method)
        with self.timings.stage("points"):
            self._collector.add_frame(self._job(number, frame_seed(self.seed, number)), self._rays_per_pixel)

    def choose(self) -> None:
        """Chooses the points, once all frames were looked at."""
        with self.timings.stage("points"):
            self.points = self._collector.points()
            self.lights = lights_at(self.points, self._glossy, self.rest, self.method)
        self.counts["points"] = len(self.points)

    def trace(self, number: int) -> None:
        """Traces a frame's light at all points, or finds it in its file."""
        points, method = self.points, self.method
        seed = frame_seed(frame_seed(self.seed, number), number)  # other random numbers than the picture's
        scene = self.sequence.scene(number)
        paths = (method.rays, method.roughness, method.max_depth, method.roulette_depth, method.sampler)
        where = (points.face, points.bary, points.side, self._glossy)
        identity = fingerprint(FORMAT, warpgi.__version__, paths, seed, scene, where)
        self._identities[number] = identity
        if self.resume and self._found(number, identity):
            return
        with self.timings.stage("light"):
            job = self._job(number, seed)
            values = {}
            for light in self.lights:
                found, rays = light.trace(job)
                finite = np.isfinite(found)
                values[light.name] = np.where(finite, found, np.float32(0.0))
                self.counts["nonfinite"] += int(np.count_nonzero(~finite.all(axis=(1, 2))))
                self.counts["point_rays"] += rays
        if self.files is None:
            self._values[number] = values
            return
        path = self._path(number)
        path.parent.mkdir(parents=True, exist_ok=True)
        with atomic_write(path) as temporary, open(temporary, "wb") as file:
            np.savez(file, allow_pickle=False, identity=np.array(identity), **values)

    def filter(self) -> None:
        """Filters the light of all frames."""
        with self.timings.stage("filter"):
            self._projections = [self._projection(light) for light in self.lights]
        self.modes = self._projections[0].modes
        identities = [self._identities[number] for number in self.numbers]
        settings = (FORMAT, warpgi.__version__, self.method, self.size, self.seed)
        self.identity = fingerprint(settings, identities, self.points.radius)

    def picture(self, index: int) -> Render:
        """A frame's picture by filtered light."""
        number = self.numbers[index]
        with self.timings.stage("filter"):
            values = self.filtered(index)
        seed = frame_seed(self.seed, number)
        prepare = partial(FramePoints, self.method, self.lights, values)
        scene = self.sequence.scene(number)
        method: Any = self.method  # which has no way to prepare a picture alone
        picture, self._before, _ = render_scene(
            scene, method, self.size, seed, self.device, before=self._before, prepare=prepare
        )
        for name, seconds in picture.timings.items():
            self.timings[name] = self.timings.get(name, 0.0) + seconds
        return picture

    def filtered(self, index: int) -> list[np.ndarray]:
        """A frame's filtered values of each of `lights`, shape (P, width, 3), float32."""
        found = []
        for light, projection in zip(self.lights, self._projections, strict=True):
            found.append(projection.frame(index).reshape(-1, light.width, 3))
        return found

    def _projection(self, light: PointLight) -> Projection:
        """One light's principal components, a coefficient of a point in place of a pixel."""
        count = len(light.points)
        size = (count * light.width, 1)

        def smooth(images: np.ndarray) -> np.ndarray:
            return light.lookup.smoothed(images.reshape(count, -1)).reshape(images.shape)

        matrix = FrameMatrix(partial(self._load, light.name), len(self.numbers), size, self.device)
        signed = light.width > 1
        return Projection(matrix, self.method.filter, size, smooth, signed)

    def _job(self, number: int, seed: int) -> Job:
        on_device = DeviceScene(self.sequence.scene(number), self.device, self._before)
        self._before = on_device
        return Job(on_device, on_device.camera(self.size), self.size, seed, self.device)

    def _path(self, number: int) -> Path:
        assert self.files is not None
        path = self.files.path(number)
        return path.parent / "points" / path.with_suffix(".npz").name

    def _found(self, number: int, identity: str) -> bool:
        """Whether a frame's light is on disk, whole, and of this identity."""
        try:
            # numpy leaves what is no archive open
            with open(self._path(number), "rb") as file, np.load(file, allow_pickle=False) as data:
                return str(data["identity"]) == identity and all(light.name in data for light in self.lights)
        except (OSError, ValueError, KeyError, EOFError, zipfile.BadZipFile):
            return False

    def _load(self, name: str, index: int) -> np.ndarray:
        number = self.numbers[index]
        if self.files is None:
            return self._values[number][name]
        with np.load(self._path(number), allow_pickle=False) as data:
            return data[name]


class FramePoints:
    """A picture's primary hits, and the light that they find at the points.

    Args:
        method: settings.
        lights: what is known at points.
        values: it, filtered.
        job: the picture.
        film: gets all light but that of the points.
    """

    def __init__(
        self, method: PointFilter, lights: Series[PointLight], values: list[np.ndarray], job: Job, film: Film
    ) -> None:
        self._lights, self._values = lights, values
        depth, roulette = method.max_depth or NEVER, method.roulette_depth or NEVER
        paths = path_settings(job, depth, roulette, method.sampler)
        each = max(1, method.light_samples // method.spp)
        glossy = any(light.width > 1 for light in lights)
        exponent = 1.0 / method.roughness * (1.0 + 1e-6) if glossy and method.roughness is not None else 0.0
        self.hits = trace_primary_hits(job, film, method.spp, each, paths, with_place=True, exponent=exponent)
        self.reflected = job.device.zeros(len(self.hits.origin), wp.vec3)
        self.counts = {"points": sum(len(light.points) for light in lights)}

    def look_up(self, job: Job) -> None:
        """Writes what each primary hit reflects of the points' light."""
        for light, values in zip(self._lights, self._values, strict=True):
            self.counts |= light.reflect(job, self.hits, values, self.reflected)
