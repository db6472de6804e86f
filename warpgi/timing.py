"""Named stages and the seconds they take."""

from __future__ import annotations

import time
from collections.abc import Iterator
from contextlib import contextmanager

#: Stages of every render, in order.
STAGES = ("compile", "upload", "prepare", "estimate", "image")


class Timings(dict[str, float]):
    """Seconds by stage; a stage entered twice adds up."""

    def __init__(self) -> None:
        super().__init__(dict.fromkeys(STAGES, 0.0))

    @contextmanager
    def stage(self, name: str) -> Iterator[None]:
        """Adds the time spent inside to stage `name`."""
        start = time.perf_counter()
        try:
            yield
        finally:
            self[name] = self.get(name, 0.0) + time.perf_counter() - start
