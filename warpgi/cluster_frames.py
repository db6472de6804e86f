"""Frames of a sequence on a cluster: what is sent, what a worker does, what comes back."""

from __future__ import annotations

from collections.abc import Callable, Generator
from uuid import uuid4

import warpgi
from warpgi.cluster import Cluster, worker_device
from warpgi.frame_renderer import FrameRenderer
from warpgi.result import Render

# On a worker: the run whose frames it made last, and what rendered them.
_last: dict[str, FrameRenderer] = {}


def cluster_frames(
    cluster: Cluster, renderer: FrameRenderer, numbers: tuple[int, ...], find: Callable[[int, str], Render | None]
) -> Generator[tuple[int, str, Render, bool]]:
    """Frames in any order: number, identity, picture, and whether it was rendered and not found.

    The sequence goes to the workers once, pickled with the functions in it, and pictures come back, so that workers
    need none of this machine's files. Of a method that carries state a worker also prepares the frames between its own.
    """
    missing: dict[int, str] = {}
    for number, identity in renderer.identities(numbers):
        picture = find(number, identity)
        if picture is None:
            missing[number] = identity
        else:
            yield number, identity, picture, False
    if not missing:
        return
    run, recipe = uuid4().hex, cluster.keep(_recipe(renderer))
    for number, (identity, picture) in cluster.run(_render, ((number, run, recipe, number) for number in missing)):
        if identity != missing[number]:
            want = f"warpgi {warpgi.__version__} as here"
            raise ValueError(f"cluster {cluster.name}: a worker made another frame {number}, expected {want}")
        yield number, identity, picture, True


def _recipe(renderer: FrameRenderer) -> bytes:
    import cloudpickle

    sequence, device = renderer.sequence, renderer.device
    settings = sequence, renderer.method, renderer.size, renderer.seed, renderer.vary_seed
    try:
        return cloudpickle.dumps((settings, device.name, device.memory_limit))
    except Exception as error:  # pickling calls whatever the sequence holds
        raise TypeError(f"sequence {sequence.name} cannot be sent to a cluster: {error}") from error


def _render(run: str, recipe: bytes, number: int) -> tuple[str, Render]:
    renderer = _last.pop(run, None)
    if renderer is None or (renderer.carries and number < renderer.next):
        renderer = _made(recipe)
    frame = renderer.open(number)
    picture = renderer.render(frame)
    # after an error it is not kept: its state may be of half a frame
    _last.clear()
    _last[run] = renderer
    return frame.identity, picture


def _made(recipe: bytes) -> FrameRenderer:
    import pickle

    settings, name, memory_limit = pickle.loads(recipe)
    sequence, method, size, seed, vary_seed = settings
    return FrameRenderer(sequence, method, size, seed, worker_device(name, memory_limit), vary_seed)
