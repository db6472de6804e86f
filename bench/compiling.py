"""Seconds that a process spends on compiling and loading the path tracer: with an empty cache, then with a full one.

`python -m bench.compiling DEVICE` prints them for the process that it is.
"""

from __future__ import annotations

import os
import subprocess
import sys
import tempfile
import time

from bench.report import CHECKOUT, Row, row


def compile_rows(device: str) -> list[Row]:
    """One row for the first process ever, one for every later one."""
    with tempfile.TemporaryDirectory(prefix="warpgi-bench-") as cache:
        environment = os.environ | {"WARP_CACHE_PATH": cache}
        seconds = []
        for _ in range(2):
            command = [sys.executable, "-m", "bench.compiling", device]
            done = subprocess.run(command, cwd=CHECKOUT, env=environment, capture_output=True, text=True)
            if done.returncode != 0:
                raise RuntimeError(f"the path tracer does not compile: {done.stderr.strip()}")
            seconds.append(float(done.stdout.split()[-1]))
    return [
        row("-", "compile, empty cache", seconds[0], "s", note="path tracer and tree"),
        row("-", "load, full cache", seconds[1], "s"),
    ]


def main(device: str) -> None:
    """Prints the seconds."""
    import warpgi as gi
    from warpgi.kernels import tree_build

    where = gi.Device(device)
    start = time.perf_counter()
    where.load(gi.PathTracing().kernels)
    gi.Device("cpu").load([tree_build.read_tree])
    print(time.perf_counter() - start)


if __name__ == "__main__":
    main(sys.argv[1])
