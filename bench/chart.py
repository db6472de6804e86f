"""Error against seconds of every contender on every scene: measures, keeps, reports."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from rich.progress import Progress

import warpgi as gi
from bench.chart_page import PAGE, RESULTS, RUNS, write_page
from bench.chart_plot import PICTURE, draw
from bench.chart_report import PathNoise, Point, equal_error, equal_time, lines, pareto_front, print_report
from bench.contender import Contender, Place, Run, Settings, label
from bench.contenders import contenders
from bench.reference import CACHE, Reference, make_reference
from bench.report import circumstances, cpu_model, finite, progress
from bench.runs import RunStore
from warpgi import checks
from warpgi.__main__ import open_scene
from warpgi.image import atomic_write, check_output

NO_PICTURE = np.zeros((0, 0, 3), np.float32)


@dataclass(frozen=True)
class ChartSettings:
    """What to chart, and where.

    Raises:
        ValueError: a number is out of range.
    """

    device: str | None = None
    scenes: tuple[str, ...] = ("cornell-box", "courtyard")
    size: tuple[int, int] = (256, 256)
    methods: tuple[str, ...] = ()
    repeats: int = 3
    seed: int = 0
    reference_spp: int = 4096
    max_depth: int | None = None
    threads: int | None = None
    quick: bool = False

    def __post_init__(self) -> None:
        checks.image_size(self.size)
        checks.count("repeats", self.repeats, 1, 1 << 20)
        checks.count("seed", self.seed, 0, 1 << 29)
        checks.count("reference_spp", self.reference_spp, 2)
        if self.max_depth is not None:
            checks.count("max_depth", self.max_depth)
        if not self.scenes:
            raise ValueError("scenes is empty, expected at least one")

    def made_quick(self) -> ChartSettings:
        """The same, small enough for a look."""
        return replace(self, size=(64, 64), repeats=1, reference_spp=1024, quick=True)


@dataclass(frozen=True, eq=False)
class Task:
    """One run to be done."""

    scene: str
    contender: Contender
    settings: Settings
    seed: int

    def __str__(self) -> str:
        return f"{self.scene}, {self.contender.name}, {label(self.settings)}, seed {self.seed}"


class Chart:
    """Measures what is missing in a folder, and says what is there.

    Raises:
        ValueError: a contender or a scene is unknown.
    """

    def __init__(self, settings: ChartSettings, out: Path, cache: Path = CACHE) -> None:
        self.settings = settings
        self.cache = cache
        self.out = out
        self.store = RunStore(out / RUNS)
        self.device = gi.Device(settings.device, settings.threads)
        self.contenders, self.notes = contenders(settings.methods)
        self.scenes = {name: open_scene(name) for name in settings.scenes}
        self.references: dict[str, Reference] = {}
        self.loaded: dict[tuple[str, str], Callable[[Settings, int], Run]] = {}
        self.finished: dict[str, tuple[Run, dict[str, Any]]] = {}  # by the words of the task; without pictures

    def measure(self) -> None:
        """Does all that is missing; may be interrupted at any time, and continued."""
        for name, scene in self.scenes.items():
            place = Place(scene, self.settings.size, self.settings.max_depth, self.device)
            for contender in self.contenders:
                try:
                    self.loaded[name, contender.name] = contender.load(place)
                except ValueError as error:
                    self.notes.append(f"{contender.name} is left out on {name}: {error}")
        with progress() as bar:
            for name in self.scenes:
                self.references[name] = self._reference(name, bar)
            tasks = list(self.tasks())
            missing = [task for task in tasks if not self.recall(task)]
            if len(missing) < len(tasks):
                bar.console.print(f"{len(tasks) - len(missing)} of {len(tasks)} runs were done before")
            job = bar.add_task("", total=len(missing))
            warm: set[tuple[str, str]] = set()
            for task in missing:
                bar.update(job, description=str(task))
                if (task.scene, task.contender.name) not in warm:
                    self.loaded[task.scene, task.contender.name](task.contender.ladder[0], task.seed)
                    warm.add((task.scene, task.contender.name))
                run = self.loaded[task.scene, task.contender.name](task.settings, task.seed)
                errors = self.keep(task, run)
                bar.console.print(f"{task}: {run.seconds:.3g} s, relMSE {errors['relmse']:.3g}", highlight=False)
                bar.advance(job)

    def _reference(self, scene: str, bar: Progress) -> Reference:
        task = bar.add_task(f"reference of {scene}", total=None)
        reference = make_reference(
            self.scenes[scene],
            self.settings.size,
            self.settings.reference_spp,
            self.settings.max_depth,
            self.device,
            lambda done, total: bar.update(task, completed=done, total=total),
            self.cache,
        )
        bar.remove_task(task)
        return reference

    def tasks(self) -> Iterator[Task]:
        """All runs, in rounds of one seed each, so that a load that comes and goes meets all contenders alike."""
        for repeat in range(self.settings.repeats):
            for scene in self.scenes:
                steps = [
                    Task(scene, contender, settings, self.settings.seed + repeat)
                    for contender in self.contenders
                    if (scene, contender.name) in self.loaded
                    for settings in (contender.quick() if self.settings.quick else contender.ladder)
                ]
                yield from steps[:: 1 if repeat % 2 == 0 else -1]

    def identity(self, task: Task) -> dict[str, Any]:
        """All that a run depends on."""
        return {
            "scene": self.references[task.scene].about["key"],
            "size": list(self.settings.size),
            "contender": task.contender.name,
            "version": task.contender.version,
            "settings": task.settings,
            "max_depth": self.settings.max_depth,
            "seed": task.seed,
            "device": self.device.name,
            "device_name": self.device.warp.name,
            "cpu": cpu_model(),
            "threads": self.device.threads,
            "versions": gi.versions(),
        }

    def recall(self, task: Task) -> bool:
        """Takes up a run that was done before, judged by today's reference; False where there is none."""
        found = self.store.load(self.identity(task))
        if found is None:
            return False
        run, errors = found
        if errors["reference"] == self.references[task.scene].about["file"]:
            self.finished[str(task)] = replace(run, indirect=NO_PICTURE), errors
        else:
            self.keep(task, run)
        return True

    def keep(self, task: Task, run: Run) -> dict[str, Any]:
        """Judges a run, writes both to the folder and returns the errors."""
        reference = self.references[task.scene]
        errors = reference.judge(run.indirect) | {"reference": reference.about["file"]}
        self.store.save(self.identity(task), run, errors)
        self.finished[str(task)] = replace(run, indirect=NO_PICTURE), errors
        return errors

    def points(self) -> list[Point]:
        """What is finished, repeats together, in the order of scenes, contenders and ladders."""
        groups: dict[tuple[str, str, str], list[Task]] = {}
        for task in self.tasks():
            if str(task) in self.finished:
                groups.setdefault((task.scene, task.contender.name, label(task.settings)), []).append(task)
        return [self._point(tasks) for tasks in groups.values()]

    def _point(self, tasks: list[Task]) -> Point:
        first = tasks[0]
        runs, errors = zip(*(self.finished[str(task)] for task in tasks), strict=True)
        seconds = [run.seconds for run in runs]
        floor = self.references[first.scene].noise["relmse"]
        mean = {
            name: float(np.mean([e[name] for e in errors])) for name in ("relmse", "relmse_measured", "rmse", "psnr")
        }
        return Point(
            scene=first.scene,
            contender=first.contender.name,
            settings=dict(first.settings),
            seeds=tuple(task.seed for task in tasks),
            seconds=float(np.median(seconds)),
            seconds_low=min(seconds),
            seconds_high=max(seconds),
            compile_seconds=max(run.compile_seconds for run in runs),
            timings={stage: float(np.median([run.timings[stage] for run in runs])) for stage in runs[0].timings},
            flip=None if errors[0]["flip"] is None else float(np.mean([e["flip"] for e in errors])),
            at_floor=mean["relmse"] < floor,
            counts=runs[0].counts,
            runs=tuple(self.store.path(self.identity(task)).name for task in tasks),
            **mean | {"relmse": max(mean["relmse"], floor)},
        )

    def command(self, point: Point) -> str | None:
        """What renders the picture of a method of the library again."""
        if point.contender not in gi.METHODS:
            return None
        settings = dict(point.settings)
        if self.settings.max_depth is not None:
            settings["max_depth"] = self.settings.max_depth
        options = "".join(f" --{name.replace('_', '-')} {value}" for name, value in settings.items())
        width, height = self.settings.size
        return (
            f"warpgi render {point.scene} {point.contender}{options} --size {width} {height} --seed {point.seeds[0]}"
            f" --device {self.device.name} --out a.exr"
        )

    def path_noise(self) -> dict[str, PathNoise]:
        """What each scene's reference says of path tracing."""
        return {
            name: PathNoise(int(reference.about["spp"]), float(reference.noise["relmse"] or 0.0))
            for name, reference in self.references.items()
        }

    def results(self) -> dict[str, Any]:
        """All that is known, as plain JSON."""
        points = self.points()
        scenes = {}
        for name, reference in self.references.items():
            mine = [point for point in points if point.scene == name]
            scenes[name] = {
                "reference": reference.about | {"noise": reference.noise},
                "points": [point.to_json() | {"command": self.command(point)} for point in mine],
                "lines": {who: [mine.index(point) for point in line.points] for who, line in lines(mine).items()},
                "front": [mine.index(point) for point in pareto_front(mine)],
                "equal_time": asdict(equal_time(mine)),
                "equal_error": asdict(equal_error(mine, self.path_noise()[name])),
            }
        return {
            **circumstances(self.device, gi.versions()),
            "settings": asdict(self.settings),
            "contenders": {c.name: {"knob": c.knob, "version": c.version} for c in self.contenders},
            "notes": self.notes,
            "scenes": scenes,
        }


def run(settings: ChartSettings, out: Path, fresh: bool, picture: Path | None = None) -> None:
    """Measures, prints the tables and writes results.json, chart.png and index.html into a folder.

    Args:
        settings: what to measure.
        out: the folder, made where it is missing.
        fresh: forget the runs that are finished there.
        picture: where chart.png goes instead.

    Raises:
        ValueError: a setting is wrong.
        OSError: the folder cannot be written.
        KeyboardInterrupt: after a report of what was finished.
    """
    out.mkdir(parents=True, exist_ok=True)
    picture = check_output(picture or out / PICTURE)
    chart = Chart(settings, out)
    if fresh:
        chart.store.clear()
    try:
        chart.measure()
    except KeyboardInterrupt:
        if chart.finished:
            report(chart, picture)
        raise
    report(chart, picture)


def report(chart: Chart, picture: Path) -> None:
    """Prints and writes what is finished."""
    for note in chart.notes:
        print(note)
    print_report(chart.points(), noise=chart.path_noise())
    results = finite(chart.results())
    for reference in chart.references.values():
        chart.store.save_reference(reference)
    with atomic_write(chart.out / RESULTS) as temporary:
        temporary.write_text(json.dumps(results, indent=2, allow_nan=False) + "\n")
    write_page(chart.out)
    print(f"wrote {chart.out / RESULTS}\nwrote {chart.out / PAGE}")
    try:
        draw(picture, results)
        print(f"wrote {picture}")
    except ImportError as error:
        print(f"no {picture.name}: {error}")
