"""Mitsuba 3 (Jakob et al. 2022) as a peer: warpgi scenes rendered by its path tracer, the indirect layer alone too."""

from __future__ import annotations

import os
import subprocess
import sys
import time
from collections.abc import Callable
from functools import cache
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np

from warpgi import Scene, to_mitsuba
from warpgi.mitsuba_scene import needs_plugins

SCALAR, LLVM = VARIANTS = ("scalar_rgb", "llvm_ad_rgb")

# A scalar variant numbers the pixels' random streams from seed * width * height on, over blocks that reach beyond the
# picture; seeds this far apart share no stream.
SEED_STEP = 16

# Paths that a vectorised variant traces in one go.
WAVEFRONT = 1 << 22

# Versions of LLVM that are too old abort where they compile a path tracer.
TRIAL = """
import mitsuba
mitsuba.set_variant("llvm_ad_rgb")
mitsuba.render(mitsuba.load_dict(mitsuba.cornell_box()), spp=1, sensor=0).numpy()
"""


class MissingPeer(ValueError):
    """Another renderer or filter is not installed, or does not run here."""


@cache
def llvm_fault() -> str | None:
    """Why `llvm_ad_rgb` does not run here, None if it does; tried in a process of its own, as it may abort."""
    with TemporaryDirectory(prefix="warpgi-mitsuba-") as folder:
        # a home where Dr.Jit finds no kernels that another LLVM compiled, and Python what it finds here
        home = os.environ | {"HOME": folder, "LOCALAPPDATA": folder, "PYTHONPATH": os.pathsep.join(sys.path)}
        done = subprocess.run([sys.executable, "-c", TRIAL], capture_output=True, text=True, timeout=120, env=home)
    if done.returncode == 0:
        return None
    lines = [line for line in done.stderr.splitlines() if "LLVM" in line]
    return lines[-1].strip() if lines else f"it ended with status {done.returncode}"


def require(variant: str) -> Any:
    """The mitsuba module with that variant set.

    Raises:
        MissingPeer: Mitsuba is not installed, or LLVM is missing or too old.
    """
    try:
        import mitsuba
    except ImportError as error:
        raise MissingPeer("mitsuba is not installed, expected it for its peers: pip install warpgi[peers]") from error
    if variant == LLVM and llvm_fault() is not None:
        raise MissingPeer(
            f"mitsuba's {LLVM} does not run here ({llvm_fault()}), expected a newer LLVM: apt install libllvm19, or "
            "name the library in DRJIT_LIBLLVM_PATH"
        )
    mitsuba.set_variant(variant)
    return mitsuba


class MitsubaPeer:
    """A scene loaded into Mitsuba, to be rendered over and over.

    Attributes:
        seconds: time of the last picture, without compiling kernels; see `indirect` for what it counts there.
        compile_seconds: time in which all pictures so far compiled kernels; 0 in a scalar variant, and near 0 where
            Dr.Jit finds them in its cache on disk.
        version: Mitsuba's.
        exact: whether it renders our scene exactly; else materials are close ones of its own (`gi.to_mitsuba`).

    Args:
        scene: what to render.
        size: (width, height) in pixels.
        max_depth: longest path in segments; 1 sees emitters only, in Mitsuba as here; None is unlimited.
        threads: CPU threads.
        variant: one of `VARIANTS`; it is set, here and at each picture, for the whole process.
        roulette_depth: segments after which Russian roulette may end a path; None switches it off.
        exact: as in `gi.to_mitsuba`; None: in vectorised variants, as a scalar one would run Python for it.

    Raises:
        MissingPeer: Mitsuba is not installed, or the variant does not run here.
        NoCounterpart: the scene holds what Mitsuba would render otherwise.
    """

    def __init__(
        self,
        scene: Scene,
        size: tuple[int, int],
        max_depth: int | None,
        threads: int,
        variant: str = SCALAR,
        roulette_depth: int | None = None,
        exact: bool | None = None,
    ) -> None:
        self.mitsuba = require(variant)
        import drjit

        self.drjit, self.variant, self.threads = drjit, variant, threads
        self.version: str = self.mitsuba.__version__
        exact = variant != SCALAR if exact is None else exact
        self.exact = exact or not needs_plugins(scene)
        self.pixels = size[0] * size[1]
        description = to_mitsuba(scene, size, max_depth, roulette_depth, exact)
        path = description["integrator"]
        self.scene = self.mitsuba.load_dict(description)
        self.path = self.scene.integrator()
        self.direct = self.mitsuba.load_dict(path | {"max_depth": min(2, max_depth or 2)})
        self.seconds = self.compile_seconds = 0.0

    def render(self, spp: int, seed: int) -> np.ndarray:
        """Linear radiance, shape (H, W, 3), float32."""
        largest = spp if self.variant == SCALAR else max(1, WAVEFRONT // self.pixels)
        return self._mean(self._timed, spp, seed, largest)

    def indirect(self, spp: int, seed: int) -> np.ndarray:
        """Light after two scatterings and more, shape (H, W, 3), float32: our `indirect` layer.

        Mitsuba's integrators do not keep layers apart. So each pass is rendered again up to one scattering and taken
        away: both draw the same random numbers up to there, and what remains is the indirect light of the very same
        paths, without noise of direct light. `seconds` counts the full passes alone.
        """

        def difference(spp: int, number: int) -> np.ndarray:
            picture = self._timed(spp, number)
            return picture - self._render(self.direct, spp, number)

        # a scalar variant draws a pixel's samples one after another: its second ones would differ
        return self._mean(difference, spp, seed, 1 if self.variant == SCALAR else max(1, WAVEFRONT // self.pixels))

    def _mean(self, render: Callable[[int, int], np.ndarray], spp: int, seed: int, largest: int) -> np.ndarray:
        """Mean of passes of at most `largest` samples per pixel, which `render` makes from Mitsuba's own seed."""
        self.mitsuba.set_variant(self.variant)
        self.seconds, total = 0.0, 0.0
        firsts = range(0, spp, largest)
        for index, first in enumerate(firsts):
            count = min(largest, spp - first)
            total = total + count * render(count, SEED_STEP * (seed * len(firsts) + index)).astype(np.float64)
        return (total / spp).astype(np.float32)

    def _timed(self, spp: int, number: int) -> np.ndarray:
        """A picture by the path integrator, its time added to `seconds` and `compile_seconds`."""
        vectorised = self.variant != SCALAR
        if vectorised:
            self.drjit.set_flag(self.drjit.JitFlag.KernelHistory, True)
            self.drjit.kernel_history_clear()
        start = time.perf_counter()
        picture = self._render(self.path, spp, number)
        seconds = time.perf_counter() - start
        if vectorised:
            # in milliseconds, where kernels were not at hand
            kernels = self.drjit.kernel_history()
            self.drjit.set_flag(self.drjit.JitFlag.KernelHistory, False)
            compiling = 1e-3 * sum(kernel.get("backend_time", 0.0) for kernel in kernels)
            self.compile_seconds += compiling
            seconds -= compiling
        self.seconds += seconds
        return picture

    def _render(self, integrator: Any, spp: int, number: int) -> np.ndarray:
        # the main thread is one of them
        self.drjit.set_thread_count(self.threads)
        picture = self.mitsuba.render(self.scene, integrator=integrator, spp=spp, seed=number)
        return np.array(picture, dtype=np.float32)
