"""Progress of a render, and its bar on a terminal."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass

#: Counts that are rays; camera rays are among the closest-hit rays.
RAY_KINDS = ("closest_hit_rays", "shadow_rays", "reconstruction_rays")


@dataclass(frozen=True)
class Progress:
    """Where a render stands after a pass."""

    done: int
    """Passes' units so far: samples per pixel, or reconstruction rays per primary hit."""
    total: int
    """Units in the end."""
    unit: str
    """What they are."""
    seconds: float
    """Since the first pass began."""
    counts: dict[str, int]
    """Rays so far, by kind."""

    @property
    def rays_per_second(self) -> float:
        """Rays of all kinds together."""
        rays = sum(self.counts.get(kind, 0) for kind in RAY_KINDS)
        return rays / max(self.seconds, 1e-9)


@contextmanager
def progress_bar(progress: bool | Callable[[Progress], None]) -> Iterator[Callable[[Progress], None] | None]:
    """What to call after each pass: nothing, the caller's function, or a bar on standard error."""
    if callable(progress):
        yield progress
        return
    if not progress:
        yield None
        return
    from rich.console import Console
    from rich.progress import BarColumn, TextColumn, TimeElapsedColumn, TimeRemainingColumn
    from rich.progress import Progress as Bar

    columns = (
        BarColumn(),
        TextColumn("{task.completed}/{task.total} {task.fields[unit]}"),
        TextColumn("{task.fields[rate]:.2f} M rays/s"),
        TimeElapsedColumn(),
        TextColumn("left"),
        TimeRemainingColumn(),
    )
    with Bar(*columns, console=Console(stderr=True)) as bar:
        task = bar.add_task("render", total=None, rate=0.0, unit="")

        def report(state: Progress) -> None:
            bar.update(task, completed=state.done, total=state.total, rate=state.rays_per_second / 1e6, unit=state.unit)

        yield report
