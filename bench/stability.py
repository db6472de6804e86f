"""The table of known failures: what each method is known to do wrong, how wrong today, and how wrong it may be."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.table import Table

import warpgi as gi
from bench.chart_page import PAGE, RESULTS, STABILITY, write_page
from bench.failures import (
    ambient_occlusion,
    instant_radiosity,
    irradiance_cache,
    light_field,
    meshless_hierarchy,
    path,
    photon_map,
    point_filter,
    statistical_filter,
)
from bench.failures.failure import Failure
from bench.report import circumstances, finite, progress
from warpgi.image import atomic_write

#: All rows; a method adds those of its own file.
FAILURES: tuple[Failure, ...] = (
    *path.ROWS,
    *light_field.ROWS,
    *meshless_hierarchy.ROWS,
    *ambient_occlusion.ROWS,
    *photon_map.ROWS,
    *irradiance_cache.ROWS,
    *instant_radiosity.ROWS,
    *statistical_filter.ROWS,
    *point_filter.ROWS,
)

PASS, FAIL, OPEN = "pass", "fail", "open"


def run(out: Path, methods: tuple[str, ...] = (), device: str | None = None, threads: int | None = None) -> bool:
    """Measures, prints the table, writes stability.json into a folder and renews the chart's page where there is one.

    Returns:
        Whether every bound is kept.

    Raises:
        ValueError: a method has no rows.
        OSError: the folder cannot be written.
    """
    known = list(dict.fromkeys(failure.method for failure in FAILURES))
    for name in methods:
        if name not in known:
            raise ValueError(f"methods holds {name!r}, expected some of {', '.join(known)}")
    where = gi.Device(device, threads)
    out.mkdir(parents=True, exist_ok=True)
    rows = measure([failure for failure in FAILURES if failure.method in (methods or known)], where)
    print_rows(rows)
    record = finite(circumstances(where, gi.versions()) | {"rows": rows})
    with atomic_write(out / STABILITY) as temporary:
        temporary.write_text(json.dumps(record, indent=2, allow_nan=False) + "\n")
    print(f"wrote {out / STABILITY}")
    if (out / RESULTS).exists():
        write_page(out)
        print(f"wrote {out / PAGE}")
    broken = [row for row in rows if row["verdict"] == FAIL]
    if broken:
        print(f"{len(broken)} of {len(rows)} bounds are broken")
    return not broken


def measure(failures: Sequence[Failure], device: gi.Device) -> list[dict[str, Any]]:
    """A row of plain values for each failure."""
    rows = []
    with progress() as bar:
        task = bar.add_task("", total=len(failures))
        for failure in failures:
            bar.update(task, description=f"{failure.method}, {failure.scene}")
            value, error = failure.measure(device)
            rows.append(
                {
                    "method": failure.method,
                    "scene": failure.scene,
                    "what": failure.what,
                    "value": value,
                    "error": error,
                    "bound": failure.bound,
                    "verdict": verdict(value, failure.bound),
                }
            )
            bar.advance(task)
    return rows


def verdict(value: float, bound: float | None) -> str:
    """Whether a value is within its bound; one that is no number is not. Without a bound the question is open."""
    if bound is None:
        return OPEN
    return PASS if value <= bound else FAIL


def print_rows(rows: Sequence[dict[str, Any]], console: Console | None = None) -> None:
    """Writes the table."""
    table = Table(box=None, header_style="bold")
    for heading in ("method", "scene", "what is measured", "value", "bound", ""):
        table.add_column(heading, justify="right" if heading in ("value", "bound") else "left")
    for row in rows:
        error = "" if row["error"] is None else f" ± {row['error']:.2g}"
        bound = "none" if row["bound"] is None else f"{row['bound']:g}"
        mark = f"[red]{row['verdict']}[/]" if row["verdict"] == FAIL else row["verdict"]
        table.add_row(row["method"], row["scene"], row["what"], f"{row['value']:.3g}{error}", bound, mark)
    console = console or Console()
    (console if console.is_terminal else Console(width=200, file=console.file)).print(table)
