"""What the points of a chart say: lines, the Pareto front, error at equal time, time at equal error."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from typing import Any

from rich.console import Console
from rich.table import Table

from bench.contender import label

# Times and errors at which lines are compared, in every decade.
STEPS = (1.0, 3.0)

SLACK = 1e-9  # relative, far above rounding and far below what is measured


@dataclass(frozen=True)
class Point:
    """One contender at one setting on one scene."""

    scene: str
    contender: str
    settings: dict[str, Any]
    seeds: tuple[int, ...]
    """One a repeat."""
    seconds: float
    """Median over the repeats, warm."""
    seconds_low: float
    seconds_high: float
    compile_seconds: float
    """Beside `seconds`; the most of the repeats."""
    timings: dict[str, float]
    """Median of each stage."""
    relmse: float
    """Mean over the repeats without the reference's own share, and not below the floor."""
    relmse_measured: float
    """With it."""
    rmse: float
    psnr: float
    flip: float | None
    at_floor: bool
    """The error is lost in the reference's noise: it is at most `relmse`."""
    counts: dict[str, int]
    """Of the first repeat."""
    runs: tuple[str, ...]
    """Files of the repeats, pictures and all."""

    @property
    def label(self) -> str:
        """The settings in words."""
        return label(self.settings)

    def to_json(self) -> dict[str, Any]:
        """As a dictionary."""
        return asdict(self) | {"label": self.label}


class Line:
    """One contender's errors and times: straight between its points where both axes are logarithmic.

    Points that cost more than another of the same contender and are no better are not on the line: nobody would
    choose these settings. Neither are points at the floor, whose error is not known.
    """

    def __init__(self, points: Iterable[Point]) -> None:
        self.points: list[Point] = []
        for point in sorted(points, key=lambda p: (p.seconds, p.relmse)):
            if not point.at_floor and (not self.points or point.relmse < self.points[-1].relmse):
                self.points.append(point)

    def error_at(self, seconds: float) -> float | None:
        """relMSE after so many seconds; None outside of what was measured."""
        return _interpolate(seconds, [(p.seconds, p.relmse) for p in self.points])

    def seconds_at(self, relmse: float) -> float | None:
        """Seconds to such an error; None outside of what was measured."""
        return _interpolate(relmse, [(p.relmse, p.seconds) for p in reversed(self.points)])


def _interpolate(x: float, pairs: Sequence[tuple[float, float]]) -> float | None:
    """y on the log-log polyline through (x, y) pairs of growing x."""
    # a column of the table may be the very value of a point but for rounding
    slack = SLACK * x
    if not pairs or not pairs[0][0] - slack <= x <= pairs[-1][0] + slack:
        return None
    if len(pairs) == 1:
        return pairs[0][1]
    upper = next((i for i in range(1, len(pairs)) if pairs[i][0] >= x), len(pairs) - 1)
    (x0, y0), (x1, y1) = pairs[upper - 1], pairs[upper]
    share = (math.log(x) - math.log(x0)) / (math.log(x1) - math.log(x0))
    return math.exp((1.0 - share) * math.log(y0) + share * math.log(y1))


def lines(points: Iterable[Point]) -> dict[str, Line]:
    """The line of every contender, of points of one scene."""
    groups: dict[str, list[Point]] = {}
    for point in points:
        groups.setdefault(point.contender, []).append(point)
    return {name: Line(group) for name, group in groups.items()}


def pareto_front(points: Iterable[Point]) -> list[Point]:
    """Points of one scene than which none is both no slower and no worse, in the order of their times."""
    front: list[Point] = []
    for point in sorted(points, key=lambda p: (p.seconds, p.relmse)):
        if not front or point.relmse < front[-1].relmse:
            front.append(point)
    return front


@dataclass(frozen=True)
class Comparison:
    """A table of lines at equal times, or at equal errors."""

    columns: tuple[float, ...]
    """The times [s] or errors."""
    rows: dict[str, tuple[float | None, ...]]
    """Contender -> its errors or times [s]; None where it was not measured."""
    best: tuple[str | None, ...]
    """Whose entry is the least; None where a point of somebody without an entry is faster and better still."""


def equal_time(points: Sequence[Point]) -> Comparison:
    """relMSE of every contender after the same times."""
    rows = {name: line.error_at for name, line in lines(points).items()}
    return _compare(points, rows, lambda p: (p.seconds, p.relmse), descending=False)


def equal_error(points: Sequence[Point], noise: PathNoise | None = None) -> Comparison:
    """Seconds of every contender to the same relMSE, the easy on the left, like short times."""
    rows = {name: line.seconds_at for name, line in lines(points).items()}
    table = _compare(points, rows, lambda p: (p.relmse, p.seconds), descending=True)
    if noise is None:
        return table
    by_noise = noise.seconds_at(points)
    return replace(table, rows=table.rows | {PATH_BY_NOISE: tuple(by_noise(error) for error in table.columns)})


@dataclass(frozen=True)
class PathNoise:
    """What a path-traced reference says of path tracing itself."""

    spp: int
    relmse: float
    """Of its own noise."""

    def seconds_at(self, points: Sequence[Point]) -> Callable[[float], float | None]:
        """Seconds of path tracing to an error above that: relMSE falls as 1 / spp, and a sample takes as long as in the
        longest of its runs among the points."""
        runs = [point for point in points if point.contender == "path"]
        if not runs or self.relmse <= 0.0:
            return lambda relmse: None
        longest = max(runs, key=lambda point: int(point.settings["spp"]))
        seconds = longest.seconds / int(longest.settings["spp"]) * self.spp
        return lambda relmse: seconds * self.relmse / relmse if relmse >= self.relmse else None


#: Row of the table at equal errors: path tracing where its own settings on the chart do not reach.
PATH_BY_NOISE = "path, by the reference's noise"


def _compare(
    points: Sequence[Point],
    read: dict[str, Callable[[float], float | None]],
    axes: Callable[[Point], tuple[float, float]],
    descending: bool,
) -> Comparison:
    pairs = [axes(point) for point in points]
    columns: list[float] = []
    if pairs:
        low, high = min(x for x, _ in pairs), max(x for x, _ in pairs)
        for decade in range(math.floor(math.log10(low)), math.ceil(math.log10(high)) + 1):
            # from text, so that a tenth is the number that prints as one
            columns += [float(f"{step:g}e{decade}") for step in STEPS]
    used, table, best = [], [], []
    for x in sorted(columns, reverse=descending):
        entries = {name: at(x) for name, at in read.items()}
        known = {name: y for name, y in entries.items() if y is not None}
        if known:
            name = min(known, key=lambda key: known[key])
            # a point is not beaten by itself, however its interpolation rounds
            beaten = any(at <= (1.0 + SLACK) * x and y < (1.0 - SLACK) * known[name] for at, y in pairs)
            used.append(x)
            table.append(entries)
            best.append(None if beaten else name)
    rows = {name: tuple(entries[name] for entries in table) for name in read}
    return Comparison(tuple(used), rows, tuple(best))


def print_report(
    points: Sequence[Point], console: Console | None = None, noise: Mapping[str, PathNoise] | None = None
) -> None:
    """Writes the tables of every scene; `noise` is that of the scenes' references."""
    console = console or Console()
    console = console if console.is_terminal or console.record else Console(width=200, file=console.file)
    for scene in dict.fromkeys(point.scene for point in points):
        mine = [point for point in points if point.scene == scene]
        console.print(f"{scene}: relMSE at equal time", style="bold", highlight=False)
        console.print(_table(equal_time(mine), "{:g} s"))
        console.print(f"{scene}: seconds at equal relMSE", style="bold", highlight=False)
        console.print(_table(equal_error(mine, (noise or {}).get(scene)), "{:g}"))
        front = ", ".join(f"{p.contender} ({p.label})" for p in pareto_front(mine))
        console.print(f"{scene}, Pareto front, fast to good: {front}", highlight=False, soft_wrap=True)
        floored = [f"{p.contender} ({p.label})" for p in mine if p.at_floor]
        if floored:
            console.print(
                f"{scene}, below the reference's noise: {', '.join(floored)}", highlight=False, soft_wrap=True
            )
        console.print()


def _table(comparison: Comparison, heading: str) -> Table:
    table = Table(box=None)
    table.add_column("")
    for column in comparison.columns:
        table.add_column(heading.format(column), justify="right")
    for name, row in comparison.rows.items():
        table.add_row(name, *(_cell(x, name == best) for x, best in zip(row, comparison.best, strict=True)))
    return table


def _cell(value: float | None, best: bool) -> str:
    # outside of what was measured nothing is said
    text = "-" if value is None else f"{value:.3g}"
    return f"[bold]{text}[/]" if best else text
