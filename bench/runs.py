"""Finished runs on disk, a file each, so that what was measured once is not measured again."""

from __future__ import annotations

import hashlib
import json
import zipfile
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from bench.contender import Run
from bench.reference import Reference
from warpgi.image import atomic_write


@dataclass(frozen=True)
class RunStore:
    """A folder of runs, each under a digest of all that it came from."""

    folder: Path

    def path(self, identity: Mapping[str, Any]) -> Path:
        """Where a run of that identity, plain JSON, is kept."""
        text = json.dumps(identity, sort_keys=True)
        return self.folder / f"{hashlib.blake2b(text.encode(), digest_size=10).hexdigest()}.npz"

    def save(self, identity: Mapping[str, Any], run: Run, errors: Mapping[str, Any]) -> None:
        """Keeps a run and its errors against some reference: whole under its name, or not at all.

        Raises:
            OSError: the disk refuses.
        """
        self.folder.mkdir(parents=True, exist_ok=True)
        about = {
            "identity": identity,
            "seconds": run.seconds,
            "compile_seconds": run.compile_seconds,
            "timings": run.timings,
            "counts": run.counts,
            "errors": errors,
        }
        with atomic_write(self.path(identity)) as temporary, open(temporary, "wb") as file:
            np.savez_compressed(file, indirect=run.indirect, about=np.array(json.dumps(about)))

    def load(self, identity: Mapping[str, Any]) -> tuple[Run, dict[str, Any]] | None:
        """A run that was kept, and its errors; None where there is none, or none that can be read."""
        try:
            # numpy leaves a file of its own open where it finds no archive
            with open(self.path(identity), "rb") as data, np.load(data) as file:
                about = json.loads(str(file["about"]))
                fields = (about[name] for name in ("seconds", "compile_seconds", "timings", "counts"))
                return Run(file["indirect"], *fields), about["errors"]
        except (OSError, ValueError, KeyError, EOFError, zipfile.BadZipFile):
            return None

    def save_reference(self, reference: Reference) -> None:
        """Keeps the picture of a reference beside the runs, for the page."""
        self.folder.mkdir(parents=True, exist_ok=True)
        path = self.folder / reference.about["file"]
        if not path.exists():
            with atomic_write(path) as temporary, open(temporary, "wb") as file:
                np.savez_compressed(file, indirect=reference.image)

    def clear(self) -> None:
        """Forgets every run, and nothing else in the folder."""
        for path in self.folder.glob("*.npz"):
            path.unlink()
