"""Progress of a render, and its bar on a terminal."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass


@dataclass(frozen=True)
class Progress:
    """Where a render stands after a pass."""

    done: int
    """Samples per pixel so far."""
    total: int
    """Samples per pixel in the end."""
    seconds: float
    """Since the first pass began."""
    counts: dict[str, int]
    """Rays so far, by kind."""

    @property
    def rays_per_second(self) -> float:
        """Closest-hit and shadow rays together."""
        rays = self.counts.get("closest_hit_rays", 0) + self.counts.get("shadow_rays", 0)
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
        TextColumn("{task.completed}/{task.total} spp"),
        TextColumn("{task.fields[rate]:.2f} M rays/s"),
        TimeElapsedColumn(),
        TextColumn("left"),
        TimeRemainingColumn(),
    )
    with Bar(*columns, console=Console(stderr=True)) as bar:
        task = bar.add_task("render", total=None, rate=0.0)

        def report(state: Progress) -> None:
            bar.update(task, completed=state.done, total=state.total, rate=state.rays_per_second / 1e6)

        yield report
