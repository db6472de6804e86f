"""Pictures for the README, each from one command."""

from __future__ import annotations

from pathlib import Path

import numpy as np

import warpgi as gi
from bench.reference import make_reference
from bench.report import progress
from warpgi.image import check_output, write_png
from warpgi.methods import RECONSTRUCTIONS, Method

GAP = 4  # pixels between panels
WHITE = 1e4  # radiance of the gap


def side_by_side(
    out: Path,
    scene: str,
    methods: tuple[str, ...],
    size: tuple[int, int],
    spp: int,
    rays: int,
    reference_spp: int,
    exposure: float,
    device: str | None,
) -> None:
    """Indirect light of one scene, left to right: the input, each method, the path-traced reference."""
    check_output(out)
    built = gi.scenes.build(scene)
    panels: dict[str, Method] = {f"input, {spp} spp": gi.PathTracing(spp=spp)}
    for name in methods:
        if name not in RECONSTRUCTIONS:
            raise ValueError(f"methods holds {name!r}, expected names out of {', '.join(RECONSTRUCTIONS)}")
        kind = RECONSTRUCTIONS[name]
        panels[f"{name}, {spp} spp"] = kind(spp=spp, rays=rays) if hasattr(kind, "rays") else kind(spp=spp)
    with progress() as bar:
        task = bar.add_task("reference", total=None)
        reference = make_reference(
            built,
            size,
            reference_spp,
            device=gi.Device(device),
            report=lambda done, total: bar.update(task, completed=done, total=total),
        )
    pictures = [
        gi.render(built, method, size, seed, device, progress=True).layers["indirect"]
        for seed, method in enumerate(panels.values())
    ]
    for name, picture in zip(panels, pictures, strict=True):
        errors = reference.judge(picture)
        print(f"{name}: {', '.join(f'{kind} {value:.4g}' for kind, value in errors.items() if value is not None)}")
    gap = np.full((size[1], GAP, 3), WHITE, np.float32)
    row = [part for picture in (*pictures, reference.image) for part in (picture, gap)][:-1]
    write_png(out, np.concatenate(row, axis=1), exposure)
    print(f"wrote {out}")
