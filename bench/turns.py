"""Jobs measured in turn, so that a load on the machine that comes and goes meets them all."""

from __future__ import annotations

import time
from collections.abc import Callable

import warpgi as gi


def take_turns(jobs: dict[str, Callable[[], None]], repeats: int, device: gi.Device) -> dict[str, list[float]]:
    """Seconds of each job in each repeat, after one run to warm up; every second repeat goes the other way round."""
    seconds: dict[str, list[float]] = {name: [] for name in jobs}
    for job in jobs.values():
        job()
    device.synchronize()
    for repeat in range(repeats):
        for name in list(jobs)[:: 1 if repeat % 2 == 0 else -1]:
            start = time.perf_counter()
            jobs[name]()
            device.synchronize()
            seconds[name].append(time.perf_counter() - start)
    return seconds
