"""Rows of measurements: as a table, and as JSON with what they were made with."""

from __future__ import annotations

import json
import math
import platform
import subprocess
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from datetime import datetime, timezone
from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn
from rich.table import Table

from warpgi.device import Device

CHECKOUT = Path(__file__).resolve().parent.parent
PREFIXES = {"M": 1e6, "k": 1e3}


@dataclass(frozen=True)
class Row:
    """One measurement."""

    scene: str
    """The scene's name; "-": none."""
    what: str
    """What was measured."""
    value: float
    """Median over the repeats."""
    unit: str
    low: float
    """Smallest of the repeats."""
    high: float
    """Largest of the repeats."""
    ratio: float | None = None
    """Median over the repeats of the value over that of row `versus`."""
    versus: str | None = None
    note: str = ""


def row(scene: str, what: str, values: float | Sequence[float], unit: str, **more: Any) -> Row:
    """A row of one value, or of one a repeat."""
    values = np.atleast_1d(values)
    return Row(scene, what, float(np.median(values)), unit, float(values.min()), float(values.max()), **more)


def paired_ratio(values: Sequence[float], others: Sequence[float]) -> float:
    """Median of the ratios within each repeat, which a load that comes and goes hardly touches."""
    return float(np.median(np.divide(values, others)))


def print_table(rows: Sequence[Row]) -> None:
    """Writes the rows to standard output."""
    table = Table(box=None, header_style="bold")
    for heading in ("scene", "measured", "median", "lowest", "highest", "unit", "ratio", "to", "note"):
        table.add_column(heading, justify="right" if heading in ("median", "lowest", "highest", "ratio") else "left")
    previous = None
    for item in rows:
        scale, unit = scaled(item)
        numbers = [f"{value / scale:.4g}" for value in (item.value, item.low, item.high)]
        ratio = "" if item.ratio is None else f"{item.ratio:.3f}"
        scene = "" if item.scene == previous else item.scene
        table.add_row(scene, item.what, *numbers, unit, ratio, item.versus or "", item.note)
        previous = item.scene
    # a pipe has no width: lines are not to be broken there
    console = Console()
    console = console if console.is_terminal else Console(width=200)
    console.print(table)


def scaled(item: Row) -> tuple[float, str]:
    """What to divide a row's numbers by for reading, and the unit then."""
    if item.unit not in ("", "s"):
        for prefix, scale in PREFIXES.items():
            if item.value >= scale:
                return scale, f"{prefix}{item.unit}" if item.unit == "B" else f"{prefix} {item.unit}"
    return 1.0, item.unit


def progress() -> Progress:
    """A bar on standard error, gone when it is done."""
    columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeElapsedColumn())
    return Progress(*columns, console=Console(stderr=True), transient=True)


def circumstances(device: Device, versions: dict[str, str]) -> dict[str, Any]:
    """What a measurement depends on beside its settings."""
    return {
        "date": datetime.now(timezone.utc).isoformat(timespec="seconds"),
        "device": device.name,
        "device_name": device.warp.name,
        "cpu": cpu_model(),
        "threads": device.threads,
        "system": platform.platform(),
        "versions": versions,
        **commit(),
    }


def cpu_model() -> str:
    """The processor as it calls itself."""
    try:
        for line in Path("/proc/cpuinfo").read_text().splitlines():
            if line.startswith("model name"):
                return line.partition(":")[2].strip()
    except OSError:
        pass
    return platform.processor() or platform.machine()


def commit() -> dict[str, Any]:
    """The checkout's commit and whether files differ from it; None where git does not know."""
    try:
        head, status = (
            subprocess.run(["git", "-C", str(CHECKOUT), *arguments], capture_output=True, text=True, check=True).stdout
            for arguments in (["rev-parse", "HEAD"], ["status", "--porcelain"])
        )
    except (OSError, subprocess.CalledProcessError):
        return {"commit": None, "dirty": None}
    return {"commit": head.strip(), "dirty": bool(status.strip())}


def write_json(path: Path, circumstances: dict[str, Any], settings: dict[str, Any], rows: Sequence[Row]) -> None:
    """Writes everything to `path`."""
    content = {**circumstances, "settings": settings, "rows": [asdict(item) for item in rows]}
    path.write_text(json.dumps(content, indent=2, allow_nan=False) + "\n")


def finite(value: Any) -> Any:
    """The same plain JSON with null where a number is infinite or none, as the PSNR of equal pictures is."""
    if isinstance(value, dict):
        return {key: finite(item) for key, item in value.items()}
    if isinstance(value, (list, tuple)):
        return [finite(item) for item in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value
