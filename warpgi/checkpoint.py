"""A render half done, kept on disk, so that it can go on later as if it had never stopped."""

from __future__ import annotations

import dataclasses
import json
from contextlib import suppress
from enum import Enum
from pathlib import Path
from typing import Any
from zipfile import BadZipFile

import numpy as np

import warpgi
from warpgi.film import FIELDS, Film
from warpgi.image import atomic_write
from warpgi.job import Job

# Often enough that a crash costs little, seldom enough that writing does.
SAVE_SECONDS = 20.0
FORMAT = 1


class Checkpoint:
    """The film of an unfinished render in a file, with what the render was of.

    Args:
        path: the file; it need not exist.
        method: settings; `spp` may differ between one run and the next.
        job: scene, size and seed.

    Raises:
        ValueError: the file is no checkpoint, or one of another render.
        OSError: it cannot be read.
    """

    def __init__(self, path: Path, method: Any, job: Job) -> None:
        self.path = path
        settings = {k: v for k, v in dataclasses.asdict(method).items() if k != "spp"}
        self.identity = {
            "format": FORMAT,
            "version": warpgi.__version__,
            "scene": job.scene.scene.fingerprint,
            "method": type(method).__name__,
            "size": list(job.size),
            "seed": job.seed,
            **{name: value.value if isinstance(value, Enum) else value for name, value in settings.items()},
        }
        self.done = 0
        self.counts: dict[str, int] = {}
        self._fields: dict[str, np.ndarray] = {}
        if path.exists():
            self._read()

    def restore(self, film: Film) -> None:
        """Fills the film with what the file holds."""
        if self._fields:
            film.restore(self._fields)
            self._fields = {}

    def save(self, film: Film, done: int, counts: dict[str, int]) -> None:
        """Writes the film after `done` units of work."""
        identity = self.identity | {"done": done, "counts": counts}
        fields: dict[str, Any] = {name: film.field(name) for name in FIELDS}
        with atomic_write(self.path) as temporary, open(temporary, "wb") as file:
            np.savez(file, identity=np.array(json.dumps(identity)), **fields)

    def _read(self) -> None:
        found: dict[str, Any] = {}
        with suppress(ValueError, KeyError, EOFError, BadZipFile), open(self.path, "rb") as file:
            data = np.load(file, allow_pickle=False)
            found = json.loads(str(data["identity"]))
            self._fields = {name: data[name] for name in FIELDS}
        if not self._fields or "done" not in found:
            raise ValueError(f"checkpoint {self.path} is damaged or no checkpoint, expected one or a new name")
        for name, value in self.identity.items():
            if found.get(name) != value:
                raise ValueError(
                    f"checkpoint {self.path} is of another render: {name} is {found.get(name)!r} there, {value!r} here"
                )
        self.done, self.counts = found["done"], found["counts"]
