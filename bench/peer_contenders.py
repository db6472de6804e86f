"""Other programs as contenders: Mitsuba 3's path tracers, and Open Image Denoise on our own noisy input."""

from __future__ import annotations

from collections.abc import Callable

import warpgi as gi
from bench.contender import Contender, Place, Run, Settings, own_run, powers


def mitsuba(variant: str) -> Contender:
    """The path integrator of one of Mitsuba's variants, with Russian roulette from where ours has it.

    Raises:
        ImportError, ValueError: it is not installed, or does not run here.
    """
    from bench.mitsuba_peer import MitsubaPeer, require

    version = require(variant).__version__
    roulette_depth = gi.PathTracing().roulette_depth

    def load(place: Place) -> Callable[[Settings, int], Run]:
        peer = MitsubaPeer(
            place.scene, place.size, place.max_depth, place.device.threads, variant, roulette_depth=roulette_depth
        )

        def run(settings: Settings, seed: int) -> Run:
            picture = peer.indirect(settings["spp"], seed)
            return Run(picture, peer.seconds, peer.compile_seconds, {"render": peer.seconds})

        return run

    return Contender(f"mitsuba {variant}", powers(256, 4), load, version)


def oidn() -> Contender:
    """Intel's denoiser on our path tracer's indirect layer, with albedo and normal; the time is that of both.

    Raises:
        ImportError, ValueError: it is not installed.
    """
    from bench.oidn_peer import OidnPeer

    def load(place: Place) -> Callable[[Settings, int], Run]:
        peer = OidnPeer(place.device.threads)

        def run(settings: Settings, seed: int) -> Run:
            method = gi.PathTracing(max_depth=place.max_depth, **settings)
            render = gi.render(place.scene, method, place.size, seed, place.device)
            clean = peer.denoise(*(render.layers[name] for name in ("indirect", "albedo", "normal")))
            return own_run(render, clean.layer, clean.setup_seconds, denoise=clean.seconds)

        return run

    return Contender("oidn", powers(128, 2), load, OidnPeer(1).version)
