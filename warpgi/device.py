"""Which device computes, and how a grid of threads gets there: every core on cpu, one grid on cuda."""

from __future__ import annotations

import functools
import os
import sys
import tempfile
import threading
from collections.abc import Iterable, Sequence
from concurrent.futures import ThreadPoolExecutor, wait
from typing import Any

import warp as wp

from warpgi import checks

#: What a card with 4 GiB can hold beside a desktop and the CUDA context.
DEFAULT_MEMORY_LIMIT = 3 << 30

DRIVER_NOTICE = b"Warp CUDA warning: Could not find or load the NVIDIA CUDA driver."

# Pieces a thread gets on average: enough to even out costly parts of a picture, few enough for launches to cost little.
CHUNKS_PER_THREAD = 8


class Device:
    """A place where kernels run.

    Args:
        name: "cpu", "cuda", "cuda:0", ...; None picks cuda:0 if there is one, else cpu.
        threads: CPU threads, None for all that this process may use; no result depends on it.
        memory_limit: bytes that arrays of a render may take on the device; no result depends on it.
        chunk: grid threads a CPU thread takes at a time, None for a size by the number of threads.

    Raises:
        ValueError: there is no such device, or a number is out of range.
    """

    def __init__(
        self,
        name: str | None = None,
        threads: int | None = None,
        memory_limit: int = DEFAULT_MEMORY_LIMIT,
        chunk: int | None = None,
    ) -> None:
        wp.config.log_level = max(wp.config.log_level, wp.LOG_WARNING)
        if name is None:
            name = "cuda:0" if _cuda_count() else "cpu"
        if name == "cuda":
            name = "cuda:0"
        known = ["cpu", *(f"cuda:{i}" for i in range(_cuda_count()))]
        if name not in known:
            raise ValueError(f"device is {name!r}, expected one of {', '.join(known)} on this machine")
        available = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
        self.name = name
        self.threads = available if threads is None else checks.count("threads", threads)
        self.memory_limit = checks.count("memory_limit", memory_limit, 1, 2**63 - 1)
        self.chunk = None if chunk is None else checks.count("chunk", chunk)
        self.warp = wp.get_device(name)
        self._pool: ThreadPoolExecutor | None = None

    @property
    def is_cuda(self) -> bool:
        """Whether it is a GPU."""
        return bool(self.warp.is_cuda)

    def load(self, kernels: Iterable[wp.Kernel]) -> None:
        """Compiles what is not compiled yet and loads it; threads must not do it at the same time."""
        for module in {kernel.module for kernel in kernels}:
            # a launch on cpu asks for blocks of one thread; without that the module would be compiled twice
            module.load(self.warp, None if self.is_cuda else 1)

    @property
    def slots(self) -> int:
        """How many threads of `launch` may write at a time; with atomics, which a GPU has and a CPU has not, one."""
        return 1 if self.is_cuda else self.threads

    def launch(
        self,
        kernel: wp.Kernel,
        count: int,
        inputs: Sequence[Any],
        outputs: Sequence[Any] = (),
        with_slot: bool = False,
    ) -> None:
        """Runs `kernel` for the indices 0 to count - 1 and returns when all are done on cpu, at once on cuda.

        The kernel's first parameter is an int offset that it adds to its thread number, the second, `with_slot`, the
        number of the slot that it alone writes to; `inputs` and `outputs` follow.
        A Ctrl-C waits for the end of the launch, so that what it writes is whole.
        """
        if count <= 0:
            return
        self.load([kernel])
        threads = min(self.threads, count)
        if self.is_cuda or (threads == 1 and self.chunk is None):
            _launch(kernel, count, [0, 0] if with_slot else [0], inputs, outputs, self.warp)
            return
        chunk = self.chunk or max(1, -(-count // (threads * CHUNKS_PER_THREAD)))
        starts = iter(range(0, count, chunk))
        lock = threading.Lock()
        stop = threading.Event()

        def work(slot: int) -> None:
            while not stop.is_set():
                with lock:
                    start = next(starts, None)
                if start is None:
                    return
                try:
                    place = [start, slot] if with_slot else [start]
                    _launch(kernel, min(chunk, count - start), place, inputs, outputs, self.warp)
                except BaseException:
                    stop.set()
                    raise

        if self._pool is None:
            self._pool = ThreadPoolExecutor(self.threads, thread_name_prefix="warpgi")
        jobs = [self._pool.submit(work, slot) for slot in range(threads)]
        interrupt: KeyboardInterrupt | None = None
        while True:
            try:
                wait(jobs)
                break
            except KeyboardInterrupt as error:
                interrupt = error
        for job in jobs:
            job.result()
        if interrupt is not None:
            raise interrupt

    def synchronize(self) -> None:
        """Waits for what is under way on a GPU."""
        wp.synchronize_device(self.warp)

    def array(self, values: Any, dtype: Any) -> wp.array:
        """A copy of `values` on the device."""
        return wp.array(values, dtype=dtype, device=self.warp)

    def zeros(self, shape: int | tuple[int, ...], dtype: Any) -> wp.array:
        """Zeros on the device."""
        return wp.zeros(shape, dtype=dtype, device=self.warp)


def as_device(device: str | Device | None) -> Device:
    """The device that a caller named, or one already made."""
    if isinstance(device, Device):
        return device
    if device is not None and not isinstance(device, str):
        raise TypeError(f"device is {type(device).__name__}, expected a name such as 'cpu', a Device or None")
    return Device(device)


def _launch(kernel: wp.Kernel, count: int, place: list[int], inputs: Sequence, outputs: Sequence, device: Any) -> None:
    wp.launch(kernel, count, inputs=[*place, *inputs], outputs=list(outputs), device=device, record_tape=False)


def _cuda_count() -> int:
    _init_warp()
    return wp.get_cuda_device_count()


@functools.cache
def _init_warp() -> None:
    """Starts Warp without its notice that there is no CUDA driver: native code prints it wherever there is no GPU."""
    try:
        saved = os.dup(2)
    except OSError:  # no standard error at all
        wp.init()
        return
    with tempfile.TemporaryFile() as heard:
        sys.stderr.flush()
        os.dup2(heard.fileno(), 2)
        try:
            wp.init()
        finally:
            os.dup2(saved, 2)
            os.close(saved)
        heard.seek(0)
        lines = [line for line in heard.read().splitlines(keepends=True) if not line.startswith(DRIVER_NOTICE)]
    os.write(2, b"".join(lines))
