"""Long work cut into passes whose length follows the clock; nothing computed depends on where the cuts are."""

from __future__ import annotations

import signal
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager

from warpgi.device import Device
from warpgi.progress import Progress

# Short enough for a live bar and a prompt Ctrl-C, long enough for launches to cost nothing.
PASS_SECONDS = 0.4


class Passes:
    """How far `run` came; `done` stays right when Ctrl-C ends it."""

    def __init__(self, total: int, unit: str) -> None:
        self.total = total
        self.unit = unit
        self.done = 0

    def run(
        self,
        step: Callable[[int, int], None],
        device: Device,
        report: Callable[[Progress], None] | None,
        counts: Callable[[], dict[str, int]],
        seconds: float = PASS_SECONDS,
        between: Callable[[float], bool] | None = None,
    ) -> None:
        """Calls step(first, count) until `total` units are done, each call about `seconds` long.

        A Ctrl-C takes effect between two steps, so that `done` and what the steps wrote agree.

        Args:
            step: does units `first` to `first + count - 1`.
            device: waited for after each step.
            report: gets a `Progress` after each step; None: nobody listens.
            counts: rays so far, for the report.
            seconds: a step's length to aim at.
            between: called after each step with the seconds since the first; True ends the work early.
        """
        started = time.perf_counter()
        count = 1
        while self.done < self.total:
            count = min(count, self.total - self.done)
            begin = time.perf_counter()
            with _interrupt_afterwards():
                step(self.done, count)
                device.synchronize()
                self.done += count
            took = time.perf_counter() - begin
            if report is not None:
                report(Progress(self.done, self.total, self.unit, time.perf_counter() - started, counts()))
            if between is not None and between(time.perf_counter() - started):
                return
            count = max(1, min(4 * count, int(count * seconds / max(took, 1e-6))))


@contextmanager
def _interrupt_afterwards() -> Iterator[None]:
    """Holds a Ctrl-C back until the end; other threads than the main one never get it."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    pressed: list[int] = []
    before = signal.signal(signal.SIGINT, lambda number, frame: pressed.append(number))
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, before)
    if pressed:
        signal.raise_signal(signal.SIGINT)
