"""Work on many processes or machines, by Dask distributed (the extra `cluster`)."""

from __future__ import annotations

import logging
import re
import signal
import threading
import warnings
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from typing import Any

from warpgi.device import Device

#: Time in which a scheduler must answer and have a worker [s].
CONNECT_SECONDS = 10.0

#: Tasks under way a worker: one that computes, one whose arguments are on their way.
TASKS_PER_WORKER = 2

_one_at_a_time = threading.Lock()


class Cluster:
    """Workers that compute.

    Args:
        client: the `distributed.Client` that leads to them.
        name: how errors call it.
    """

    def __init__(self, client: Any, name: str) -> None:
        self._client, self.name = client, name

    def keep(self, value: Any) -> Any:
        """A value for arguments of many tasks, which the scheduler has once and gives to any worker, also a new one."""
        return self._submit(_same, value)

    def run(self, work: Callable[..., Any], tasks: Iterable[tuple[Any, ...]]) -> Iterator[tuple[Any, Any]]:
        """Results of `work(*arguments)` for each (key, *arguments) as (key, result), in the order in which they come.

        A worker that dies leaves its tasks to others. Tasks are taken as workers get free, so that neither arguments
        nor results pile up.

        Raises:
            OSError: workers died again and again at the same task, or the scheduler is gone.
            ImportError: warpgi, or another module that the work is from, is not installed there.
            What `work` raises.
        """
        from distributed import as_completed

        keys: dict[Any, Any] = {}
        waiting = iter(tasks)
        done = as_completed(loop=self._client.loop)

        def refill() -> None:
            while len(keys) < TASKS_PER_WORKER * max(len(self._client.nthreads()), 1):
                task = next(waiting, None)
                if task is None:
                    return
                future = self._submit(_alone, work, *task[1:])
                keys[future] = task[0]
                done.add(future)

        try:
            refill()
            for future in done:
                key, result = keys.pop(future), self._result(future)
                future.release()
                refill()
                yield key, result
        finally:
            if self._client.status == "running":
                self._client.cancel(list(keys))

    def _submit(self, *call: Any) -> Any:
        with warnings.catch_warnings():
            # of scenes and pictures, which must go there
            warnings.filterwarnings("ignore", "Sending large graph", UserWarning)
            return self._client.submit(*call, pure=False)

    def _result(self, future: Any) -> Any:
        from concurrent.futures import CancelledError

        from distributed import KilledWorker

        try:
            return future.result()
        except KilledWorker as error:
            raise ChildProcessError(
                f"cluster {self.name}: workers died again and again, as where memory is short"
            ) from error
        except (CancelledError, TimeoutError) as error:
            raise ConnectionError(f"cluster {self.name}: the scheduler is gone, expected it to stay") from error
        except ImportError as error:
            raise ImportError(
                f"cluster {self.name}: a worker says {error}, expected it to be installed there"
            ) from error


@contextmanager
def open_cluster(cluster: Any, device: Device) -> Iterator[Cluster | None]:
    """The workers that a caller named; None where that is False.

    Args:
        cluster: True for processes of this machine's that share the device's threads, on a GPU one; the address of a
            scheduler; or a `distributed.Client`, which stays open.
        device: what the local processes share.

    Raises:
        TypeError, ValueError: it is no such thing.
        ImportError: Dask distributed is not installed.
        ConnectionError: there is no scheduler, or it has no worker.
        ChildProcessError: processes of this machine's do not start.
    """
    if cluster is False or cluster is None:
        yield None
        return
    try:
        import distributed
    except ImportError as error:
        raise ImportError(f"cluster needs Dask distributed ({error}): pip install warpgi[cluster]") from error
    if isinstance(cluster, distributed.Client):
        yield Cluster(cluster, str(cluster.scheduler.address if cluster.scheduler else ""))
    elif cluster is True:
        with _local_workers(device) as local, distributed.Client(local) as client:
            yield Cluster(client, "of this machine")
    elif isinstance(cluster, str):
        with _connect(cluster) as client:
            yield Cluster(client, cluster)
    else:
        raise TypeError(
            f"cluster is {type(cluster).__name__}, expected an address, a distributed.Client, True or False"
        )


def _local_workers(device: Device) -> Any:
    import distributed

    ours = threading.current_thread() is threading.main_thread()
    # a Ctrl-C goes to all processes of a terminal: this one is to end the others, which are to say nothing
    before = signal.signal(signal.SIGINT, signal.SIG_IGN) if ours else None
    try:
        return distributed.LocalCluster(
            n_workers=1 if device.is_cuda else device.threads,
            threads_per_worker=device.threads if device.is_cuda else 1,
            dashboard_address=":0",
            memory_limit=None,
            silence_logs="CRITICAL",
        )
    except RuntimeError as error:
        raise ChildProcessError(
            f"cluster of this machine: processes did not start ({error}); they import the script, "
            "expected it to ask for them under if __name__ == '__main__':"
        ) from error
    finally:
        if ours:
            signal.signal(signal.SIGINT, before)


def _connect(address: str) -> Any:
    import distributed

    # what it has to tell, that the scheduler is gone, is an error's to say
    logging.getLogger("distributed.client").setLevel(logging.CRITICAL)
    if not re.fullmatch(r"(\w+://)?[^/\s]+:\d+", address):
        raise ValueError(f"cluster is {address!r}, expected the address of a Dask scheduler such as tcp://host:8786")
    try:
        client = distributed.Client(address, timeout=CONNECT_SECONDS, set_as_default=False)
    except (OSError, ValueError) as error:
        raise ConnectionError(f"cluster {address} cannot be reached, expected a Dask scheduler there") from error
    try:
        client.wait_for_workers(1, timeout=CONNECT_SECONDS)
    except TimeoutError as error:
        client.close()
        raise ConnectionError(f"cluster {address} has no worker, expected one: dask worker {address}") from error
    return client


def worker_device(name: str, memory_limit: int) -> Device:
    """On a worker: the device with the threads that the worker has."""
    from distributed import get_worker

    return Device(name, get_worker().state.nthreads, memory_limit)


def _same(value: Any) -> Any:
    return value


def _alone(work: Callable[..., Any], *arguments: Any) -> Any:
    # Warp modules must not be loaded by two threads; a task takes all threads of its worker anyway
    with _one_at_a_time:
        return work(*arguments)
