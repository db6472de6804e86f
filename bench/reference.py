"""Path-traced references of the indirect layer, kept on disk with the noise that they have themselves."""

from __future__ import annotations

import dataclasses
import hashlib
import json
import re
import zipfile
from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import warp as wp

import warpgi as gi
from bench.report import CHECKOUT
from warpgi import checks
from warpgi.device_scene import DeviceScene
from warpgi.image import atomic_write

CACHE = CHECKOUT / "bench" / "cache"

# A reference is this many pictures, with seeds of their own; work is kept after each, and each half has every second.
BATCHES = 16

# Above every seed that a contender gets.
FIRST_SEED = 1 << 30


@dataclass(frozen=True, eq=False)
class Reference:
    """The mean of two independent halves, whose difference tells its noise."""

    halves: np.ndarray
    """Indirect radiance, shape (2, H, W, 3), float64."""
    about: dict[str, Any]
    """What made it."""

    @cached_property
    def image(self) -> np.ndarray:
        """Linear radiance, shape (H, W, 3), float32."""
        return self.halves.mean(axis=0).astype(np.float32)

    @cached_property
    def standard_error(self) -> np.ndarray:
        """Of each pixel, shape (H, W, 3): half the halves' difference, one degree of freedom; means of it are sound."""
        return 0.5 * np.abs(self.halves[0] - self.halves[1])

    @cached_property
    def noise(self) -> dict[str, float | None]:
        """What a perfect picture would show for its errors on average.

        For relMSE the mean over pixels of the variance with the metric's weights. The halves differ by twice the
        reference's standard error, so that PSNR between them is 20 log10(2) dB too low. FLIP is that between the
        halves, which is too large.
        """
        between = gi.compare(self.image + self.standard_error.astype(np.float32), self.image)
        shown = gi.compare(*(half.astype(np.float32) for half in self.halves))
        return {
            "relmse": between["relmse"],
            "psnr": shown["psnr"] + 20.0 * np.log10(2.0),
            "flip": shown["flip"],
        }

    def judge(self, picture: np.ndarray) -> dict[str, float | None]:
        """Errors of a picture; from "relmse" the reference's own share is taken off, "relmse_measured" has it.

        The difference to the reference is the sum of two independent ones, that of the picture and the reference's
        own, and so are the means of their squares. What is left can be negative for a picture as good as this.
        """
        errors = gi.compare(picture, self.image)
        return errors | {"relmse_measured": errors["relmse"], "relmse": errors["relmse"] - self.noise["relmse"]}


def make_reference(
    scene: gi.Scene,
    size: tuple[int, int],
    spp: int,
    max_depth: int | None = None,
    device: gi.Device | None = None,
    report: Callable[[int, int], None] = lambda done, total: None,
    cache: Path = CACHE,
) -> Reference:
    """The reference of a scene, from the cache as far as it is there.

    An interrupted one is continued. One that other kernels, another scene or other settings made is never taken: the
    file's name is a digest of the compiled kernel's content and of every value that it is given.

    Args:
        scene: what to render.
        size: (width, height) in pixels.
        spp: paths per pixel, a multiple of 2; shared out over up to 16 pictures with seeds of their own.
        max_depth: longest path in segments; None is unlimited.
        device: where to render.
        report: gets the number of pictures that are done, and of all.
        cache: folder of the references.

    Raises:
        ValueError: an argument is wrong.
    """
    checks.count("reference_spp", spp, 2)
    batches = next((n for n in range(BATCHES, 1, -2) if spp % n == 0), 0)
    if not batches:
        raise ValueError(f"reference_spp is {spp}, expected a multiple of 2")
    device = device or gi.Device()
    method = gi.PathTracing(spp=spp // batches, max_depth=max_depth)
    key = fingerprint(scene, size, method, device)
    name = re.sub(r"[^\w.-]+", "-", scene.name)
    path = cache / f"{name}-{size[0]}x{size[1]}-{spp}spp-{key}.npz"
    cache.mkdir(parents=True, exist_ok=True)
    sums, seconds = _load(path) or (np.zeros((2, size[1], size[0], 3)), [])
    report(len(seconds), batches)
    while len(seconds) < batches:
        render = gi.render(scene, method, size, FIRST_SEED + len(seconds), device)
        sums[len(seconds) % 2] += render.layers["indirect"]
        seconds.append(render.timings["estimate"])
        _save(path, sums, seconds)
        report(len(seconds), batches)
    about = {
        "scene": scene.name,
        "size": list(size),
        "spp": spp,
        "method": "path",
        "settings": json.loads(json.dumps(dataclasses.asdict(method), default=lambda kind: kind.value)),
        "seeds": list(range(FIRST_SEED, FIRST_SEED + batches)),
        "seconds": sum(seconds),
        "key": key,
        "file": path.name,
    }
    return Reference(sums / (batches // 2), about)


def fingerprint(scene: gi.Scene, size: tuple[int, int], method: gi.PathTracing, device: gi.Device) -> str:
    """Digest of all that decides the pixels: code of the compiled kernels, the arrays they get, camera and settings.

    It sees through what made these: a comment in a source changes nothing, one vertex or one constant does.
    """
    digest = hashlib.blake2b(digest_size=10)
    for kernel in method.kernels:
        device.load([kernel])
        digest.update(kernel.module.get_module_hash(None if device.is_cuda else 1))
    on_device = DeviceScene(scene, device)
    for part in (on_device.struct, on_device.camera(size)):
        _add_struct(digest, part)
    digest.update(repr((method, wp.config.version)).encode())
    return digest.hexdigest()


def _add_struct(digest: Any, struct: Any) -> None:
    for name in struct._cls.vars:
        value = getattr(struct, name)
        digest.update(name.encode())
        if isinstance(value, wp.array):
            digest.update(repr(value.shape).encode() + np.ascontiguousarray(value.numpy()).tobytes())
        elif hasattr(value, "_cls"):
            _add_struct(digest, value)
        elif value is None:  # an array that the scene does not need; as an object it would be its address
            digest.update(b"none")
        else:
            digest.update(np.asarray(value).tobytes())


def _save(path: Path, sums: np.ndarray, seconds: list[float]) -> None:
    with atomic_write(path) as temporary, open(temporary, "wb") as file:
        np.savez(file, sums=sums, seconds=seconds)


def _load(path: Path) -> tuple[np.ndarray, list[float]] | None:
    try:
        # numpy leaves a file of its own open where it finds no archive
        with open(path, "rb") as data, np.load(data) as file:
            return file["sums"], file["seconds"].tolist()
    except FileNotFoundError:
        return None
    except (OSError, ValueError, KeyError, zipfile.BadZipFile, EOFError):
        return None  # no file of ours: made anew
