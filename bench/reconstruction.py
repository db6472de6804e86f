"""Light-field reconstruction: rates beside a yardstick of the machine and the authors' program, and how time scales.

The authors' C++ program for the CPU (Lehtinen et al. 2012), built with g++ -O3 -march=native, reconstructed 0.24 M rays
a second and preprocessed (tree, k-NN, shrinking) 0.235 M samples a second: two threads, a diffuse box, 128x128 pixels
of 8 samples. It ran on another day on a machine of the same kind, on which scipy's cKDTree then found the 12 nearest
neighbours of 0.93 M points a second, two workers on 100 000 points. Here the yardstick runs again, in turn with the
rest: a rate over the yardstick's, divided by the authors' rate over theirs, says how many times faster this is. Which
points those were, and in which order, is not on record; both change scipy's rate by a factor of two.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from contextlib import nullcontext
from dataclasses import asdict, dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import warp as wp

import warpgi as gi
from bench.report import Row, circumstances, paired_ratio, print_table, row, write_json
from bench.turns import take_turns
from warpgi import checks
from warpgi.image import atomic_write
from warpgi.reconstruction import Reconstruction
from warpgi.render import versions
from warpgi.scenes import build

AUTHORS = {"reconstruction": 0.24e6, "preprocessing": 0.235e6}  # rays/s, samples/s
AUTHORS_YARDSTICK = 0.93e6  # points/s

YARDSTICK = "scipy cKDTree"
YARDSTICK_POINTS = 100_000
YARDSTICK_NEIGHBOURS = 12

SPP = 8
RAYS = 256
SEED = 1
# Reconstruction rays timed at a time: more would measure no better.
MOST_RAYS = 1 << 22
STAGES = ("build", "knn", "shrink")


@dataclass(frozen=True)
class ScalingSettings:
    """What to measure, and where."""

    device: str | None
    scenes: tuple[str, ...]
    size: tuple[int, int]
    rays: tuple[int, ...]
    spp: tuple[int, ...]
    repeats: int
    threads: int | None

    def __post_init__(self) -> None:
        checks.image_size(self.size)
        checks.count("repeats", self.repeats)
        for name in ("rays", "spp"):
            values = getattr(self, name)
            if not values:
                raise ValueError(f"{name} is empty, expected one number or more")
            for value in values:
                checks.count(name, value)
        if not self.scenes:
            raise ValueError("scenes is empty, expected one name or more")


class Yardstick:
    """The machine's speed, as a well-known program sees it: the nearest neighbours of random points in a cube.

    Args:
        threads: CPU threads.
    """

    def __init__(self, threads: int) -> None:
        from scipy.spatial import cKDTree

        points = np.random.default_rng(SEED).random((YARDSTICK_POINTS, 3))
        # neighbours in turn, as a tree over samples has them: out of order scipy waits for memory, which flatters us
        self.points = points[cKDTree(points).indices]
        self.tree = cKDTree(self.points)
        self.threads = threads
        self.rates: list[float] = []

    def run(self) -> None:
        """Looks every point up."""
        self.tree.query(self.points, k=YARDSTICK_NEIGHBOURS, workers=self.threads)

    def row(self) -> Row:
        """Its rate over all repeats of all scenes."""
        note = f"k = {YARDSTICK_NEIGHBOURS}, {YARDSTICK_POINTS} ordered random points, {self.threads} workers"
        return row("-", YARDSTICK, self.rates, "points/s", note=note)


class Stages:
    """One sample buffer through every stage; each is timed by itself.

    Args:
        samples: the input.
        device: where it computes.
        rays: reconstruction rays per pixel.
    """

    def __init__(self, samples: gi.SampleBuffer, device: gi.Device, rays: int = RAYS) -> None:
        self.device = device
        spp = samples.spp or max(1, round(len(samples) / (samples.width * samples.height)))
        self.method = gi.LightField(rays=rays)
        self.each = self.method.passes(spp)[0]
        # kept whole for the gather, while trees are built over and over beside it
        self.state = self.method.reconstruction(samples, device, SEED)
        self.count = max(1, min(self.each, MOST_RAYS // max(1, len(self.state.primary))))
        self.ray_count = self.count * len(self.state.primary)
        self.splats = np.flatnonzero(samples.checked.is_splat).astype(np.int32)
        self.seconds: dict[str, list[float]] = {name: [] for name in STAGES}

    def reconstruct(self) -> None:
        """Sends rays from every primary hit."""
        self.state.gather(0, self.count, self.each)

    def preprocess(self) -> None:
        """Sorts, builds the tree, sizes and shrinks the splats; notes the seconds of each."""
        state, how = self.state, self.state.preprocessing
        start = time.perf_counter()
        tree = type(state.tree)(self.device, state._hits, state._hit_normals, state._radiance, self.splats, state.noise)
        rays = type(state.rays)()
        rays.origins, rays.hits, rays.order = state.rays.origins, state.rays.hits, tree.order
        build = self._since(start)
        tree.size_by_neighbours(rays, how.neighbours, how.alpha)
        knn = self._since(start)
        tree.shrink(rays, how.margin, state.escaped, state.extent)
        shrink = self._since(start)
        for name, seconds in zip(STAGES, (build, knn - build, shrink - knn), strict=True):
            self.seconds[name].append(seconds)

    def prepare(self) -> None:
        """All that a new buffer needs before its first ray."""
        _prepare(self.method, self.state.samples, self.device)

    def _since(self, start: float) -> float:
        self.device.synchronize()
        return time.perf_counter() - start


def stage_rows(
    name: str, samples: gi.SampleBuffer, device: gi.Device, repeats: int, yard: Yardstick | None
) -> list[Row]:
    """Rates of reconstruction and of each stage before it on one buffer, and its size."""
    stages = Stages(samples, device)
    jobs: dict[str, Callable[[], None]] = {
        "reconstruction": stages.reconstruct,
        "preprocessing": stages.preprocess,
        "prepare": stages.prepare,
    }
    if yard is not None:
        jobs = {YARDSTICK: yard.run, **jobs}
    # a load beside this one takes turns with it on the cores, so that wall time may misjudge either
    processor: dict[str, list[float]] = {key: [] for key in jobs}

    def clocked(key: str) -> None:
        start = time.process_time()
        jobs[key]()
        processor[key].append(time.process_time() - start)

    turns = take_turns({key: partial(clocked, key) for key in jobs}, repeats, device)
    seconds = {key: np.array(values) for key, values in turns.items()}
    splats = len(stages.splats)
    # the first run warmed up
    timed = {stage: np.array(values[1:]) for stage, values in stages.seconds.items()}
    rates = {"reconstruction": stages.ray_count / seconds["reconstruction"]}
    rates |= {stage: splats / values for stage, values in timed.items()}
    rates["preprocessing"] = splats / sum(timed.values())
    rates["preprocessing, checks and upload too"] = splats / seconds["prepare"]
    of = f"{splats} splats of {len(samples)} samples"
    notes = dict.fromkeys(rates, of) | {"reconstruction": f"{of}, {stages.count} of {stages.each} rays a hit"}
    yard_rates = None
    if yard is None:
        notes["reconstruction"] += f"; no {YARDSTICK}: scipy is not installed"
    else:
        yard_rates = YARDSTICK_POINTS / seconds[YARDSTICK]
        yard.rates += yard_rates.tolist()
    rows = []
    for what, values in rates.items():
        unit = "rays/s" if what == "reconstruction" else "splats/s"
        compared: dict[str, Any] = {}
        if yard_rates is not None and what in AUTHORS:
            compared = {"ratio": paired_ratio(values, yard_rates), "versus": YARDSTICK}
        rows.append(row(name, what, values, unit, note=notes[what], **compared))
        if compared:
            theirs = AUTHORS[what] / AUTHORS_YARDSTICK
            work = stages.ray_count if what == "reconstruction" else splats
            busy = [count / np.array(processor[key]) for count, key in ((work, what), (YARDSTICK_POINTS, YARDSTICK))]
            note = f"over {YARDSTICK}, theirs {theirs:.3f}; by processor time {paired_ratio(*busy) / theirs:.2f}"
            rows.append(row(name, f"{what}, times the authors'", values / yard_rates / theirs, "", note=note))
    count = len(samples)
    rows.append(row(name, "sample, host", samples.bytes_per_sample, "B"))
    rows.append(row(name, "sample, device", device_bytes(stages.state) / count, "B", note="tree and sums included"))
    return rows


def device_bytes(state: Reconstruction) -> int:
    """Bytes on the device that a reconstruction holds; what its samples share with the host counts too."""
    found: dict[int, int] = {}

    def visit(value: Any) -> None:
        if isinstance(value, wp.array):
            if value.ptr:
                found[value.ptr] = value.capacity
        elif hasattr(value, "_cls"):
            for name in value._cls.vars:
                visit(getattr(value, name))
        elif type(value).__module__.startswith("warpgi.") and value is not state.samples:
            for part in vars(value).values():
                visit(part)

    visit(state)
    return sum(found.values())


def yardstick(device: gi.Device) -> Yardstick | None:
    """The yardstick; None where scipy is not installed."""
    try:
        return Yardstick(device.threads)
    except ImportError:
        return None


def run_scaling(settings: ScalingSettings, json: Path | None) -> None:
    """Measures, prints the table and writes the JSON.

    Raises:
        ValueError: a setting is wrong.
        OSError: the file cannot be written.
    """
    device = gi.Device(settings.device, settings.threads)
    scenes = [build(name) for name in settings.scenes]
    about = circumstances(device, versions())
    with atomic_write(json) if json else nullcontext() as file:
        device.load(gi.LightField().kernels)
        rows = scaling_rows(scenes, settings, device)
        print_table(rows)
        if file is not None:
            record = asdict(settings) | {"threads": device.threads, "device": device.name}
            write_json(file, about, record, rows)


def scaling_rows(scenes: Sequence[gi.Scene], settings: ScalingSettings, device: gi.Device) -> list[Row]:
    """Seconds from a sample buffer to reconstructed light: against rays, input samples and scenes; and its memory."""
    spp, rays = settings.spp[-1], settings.rays[-1]
    cases = [(scenes[0].name, spp, count) for count in settings.rays[:-1]]
    cases += [(scenes[0].name, count, rays) for count in settings.spp]
    cases += [(scene.name, spp, rays) for scene in scenes[1:]]
    named = {scene.name: scene for scene in scenes}
    inputs: dict[tuple[str, int], gi.SampleBuffer] = {}
    held: dict[tuple[str, int], int] = {}
    for name, count, _ in cases:
        if (name, count) not in inputs:
            inputs[name, count] = gi.sample(named[name], count, settings.size, SEED, device)
    jobs: dict[Any, Callable[[], None]] = {}
    for case in dict.fromkeys(cases):
        method = gi.LightField(rays=case[2])

        def run(case: tuple[str, int, int] = case, method: gi.LightField = method) -> None:
            state = _prepare(method, inputs[case[:2]], device)
            each = method.passes(case[1])[0]
            state.gather(0, each, each)
            device.synchronize()
            held[case[:2]] = device_bytes(state)

        jobs[case] = run
    seconds = {case: np.array(values) for case, values in take_turns(jobs, settings.repeats, device).items()}

    def line(case: tuple[str, int, int], base: tuple[str, int, int], versus: str, what: str) -> Row:
        compared = {} if case == base else {"ratio": paired_ratio(seconds[case], seconds[base]), "versus": versus}
        return row(case[0], what, seconds[case], "s", **compared)

    first, whole = scenes[0].name, (scenes[0].name, spp, rays)
    result = []
    for count in settings.rays:
        base, versus = (first, spp, settings.rays[0]), f"{settings.rays[0]} rays"
        result.append(line((first, spp, count), base, versus, f"{count} rays, {spp} spp"))
    for count in settings.spp:
        base, versus = (first, settings.spp[0], rays), f"{settings.spp[0]} spp"
        result.append(line((first, count, rays), base, versus, f"{count} spp, {rays} rays"))
    for scene in scenes[1:]:
        result.append(line((scene.name, spp, rays), whole, first, f"{rays} rays, {spp} spp"))
    for (name, count), samples in inputs.items():
        note = f"{np.count_nonzero(samples.checked.is_splat)} splats of {len(samples)} samples"
        result.append(row(name, f"sample, host, {count} spp", samples.bytes_per_sample, "B"))
        result.append(row(name, f"sample, device, {count} spp", held[name, count] / len(samples), "B", note=note))
    return result


def _prepare(method: gi.LightField, samples: gi.SampleBuffer, device: gi.Device) -> Reconstruction:
    # a new buffer over the same arrays has its samples yet to check
    return method.reconstruction(replace(samples), device, SEED)
