"""The picture of irradiance caches for the README."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np

import warpgi as gi
from bench.figures import GAP, WHITE
from bench.reference import make_reference
from warpgi import checks
from warpgi.image import check_output, write_png

METHODS = (
    gi.IrradianceCache(),
    gi.LightField(spp=1, primary_hits=8, rays=64, record_rays=1024, cache=True, recursive=1, recursive_rays=4),
)


def draw(out: Path, size: tuple[int, int], reference_spp: int, device: str | None) -> None:
    """Indirect light of the Cornell box by both irradiance caches, the records of the second, and the reference."""
    check_output(out)
    checks.image_size(size)
    checks.count("reference_spp", reference_spp, 2)
    scene, where = gi.scenes.cornell_box(), gi.Device(device)
    reference = make_reference(scene, size, reference_spp, device=where)
    renders = [gi.render(scene, method, size, device=where) for method in METHODS]
    for render in renders:
        error = reference.judge(render.layers["indirect"])["relmse"]
        print(f"{render.method}: relmse {error:.3g}, {json.dumps(render.counts)}")
    pictures = [render.layers["indirect"] for render in renders]
    dots = np.where(renders[1].layers["records"] > 0.0, np.float32([1.0, 0.8, 0.0]), 0.3 * pictures[1])
    gap = np.full((size[1], GAP, 3), WHITE, np.float32)
    row = [part for picture in (*pictures, dots, reference.image) for part in (picture, gap)][:-1]
    write_png(out, np.concatenate(row, axis=1).astype(np.float32), 1.0)
    print(f"wrote {out}")
