"""What the chart compares: every method at several settings of its quality knob, and other renderers where installed.

A method of the library takes one line in `LADDERS`; anything else that makes an indirect layer, one in `PEERS`.
"""

from __future__ import annotations

import dataclasses
import hashlib
import time
from collections.abc import Callable
from functools import cache

import warpgi as gi
from bench.contender import Contender, Place, Run, Settings, own_run, powers
from bench.peer_contenders import mitsuba, oidn
from bench.report import CHECKOUT


def rays(*pairs: tuple[int, int]) -> tuple[Settings, ...]:
    """Samples and reconstruction rays per pixel."""
    return tuple({"spp": spp, "rays": count} for spp, count in pairs)


# Support of an irradiance filter on what is nearly free of noise: its bias is what is left.
NARROW = {"support": 0.2, "min_radius": 2.0, "max_radius": 8.0, "angle": 30.0}

#: Name in METHODS -> values of its quality knob, cheapest first.
LADDERS: dict[str, tuple[Settings, ...]] = {
    "path": powers(512),
    "light-field": rays((1, 16), (1, 64), (2, 64), (4, 64), (4, 256), (8, 128), (8, 256), (8, 512), (16, 512)),
    "photon-map": tuple(
        {"spp": spp, "photons": photons, "caustic_photons": photons, "final_gather": rays}
        for spp, photons, rays in (
            (1, 20_000, 0),
            (4, 50_000, 4),
            (8, 100_000, 8),
            (16, 200_000, 16),
        )
    ),
    "instant-radiosity": tuple({"paths": paths} for paths in (10, 32, 64, 256, 1024)),
    "irradiance-cache": tuple(
        {"rays": rays, "tolerance": tolerance, "light_samples": 8}
        for rays, tolerance in ((64, 0.5), (256, 0.4), (1024, 0.3), (4096, 0.3), (4096, 0.2))
    ),
    "a-trous": powers(16),
    "random-parameter-filter": powers(8),
    "irradiance-filter": powers(64),
    "meshless-hierarchy": tuple(
        {"spp": spp, "rays": rays, "tolerance": tolerance, "primary_hits": max(4, spp)}
        for spp, rays, tolerance in ((1, 64, 0.5), (2, 64, 0.4), (4, 128, 0.4), (8, 256, 0.4), (16, 512, 0.3))
    ),
}

#: The same with an irradiance cache: samples, primary hits and rays per pixel, rays of a record, and recursions, which
#: tell on smooth surfaces alone.
CACHED_LIGHT_FIELD: tuple[Settings, ...] = tuple(
    {"spp": spp, "primary_hits": hits, "light_samples": hits, "rays": rays, "record_rays": record, "cache": True}
    | {"recursive": recursions, "recursive_rays": 4, "tolerance": 0.3}
    for spp, hits, rays, record, recursions in (
        (1, 2, 2, 64, 0),
        (1, 4, 4, 64, 0),
        (1, 4, 4, 128, 1),
        (1, 8, 8, 128, 0),
        (1, 8, 16, 256, 1),
        (1, 16, 16, 256, 0),
        (1, 8, 64, 1024, 1),
        (2, 16, 64, 1024, 1),
        (4, 16, 256, 2048, 1),
    )
)

#: Photon maps that get finer, one for every four camera paths, most of whose photons make caustics.
PROGRESSIVE: tuple[Settings, ...] = tuple(
    {"spp": spp, "map_spp": 4, "photons": 50_000, "caustic_photons": 200_000, "final_gather": 4} for spp in (4, 16, 64)
)

#: Few reconstruction rays whose light is filtered: samples, primary hits and rays per pixel.
SPARSE_FILTER: tuple[Settings, ...] = (
    {"spp": 1, "rays": 4, "primary_hits": 4},
    {"spp": 1, "rays": 16, "primary_hits": 4},
    {"spp": 8, "rays": 32, **NARROW},
    {"spp": 8, "rays": 128, **NARROW},
)

#: Methods without an indirect layer, and why.
NO_LIGHT = {
    "ambient-occlusion": "its picture is occlusion, not light",
    "temporal-light-field": "it reconstructs the whole picture, not its indirect light",
}

#: Name -> maker of a contender that needs more than the library, or is a second line of one of its methods; an
#: ImportError or ValueError says what is missing.
PEERS: dict[str, Callable[[], Contender]] = {
    "mitsuba scalar_rgb": lambda: mitsuba("scalar_rgb"),
    "mitsuba llvm_ad_rgb": lambda: mitsuba("llvm_ad_rgb"),
    "oidn": oidn,
    "light-field cache": lambda: own("light-field", CACHED_LIGHT_FIELD, "light-field cache"),
    "photon-map progressive": lambda: own("photon-map", PROGRESSIVE, "photon-map progressive"),
    "irradiance-filter sparse": lambda: own("irradiance-filter", SPARSE_FILTER, "irradiance-filter sparse"),
}


def own(name: str, ladder: tuple[Settings, ...], called: str | None = None) -> Contender:
    """A method of the library, under its name or another."""
    kind = gi.METHODS[name]
    fields = {field.name for field in dataclasses.fields(kind)}

    def load(place: Place) -> Callable[[Settings, int], Run]:
        depth = {"max_depth": place.max_depth} if "max_depth" in fields else {}
        start = time.perf_counter()
        place.device.load(kind(**depth, **ladder[0]).kernels)
        compile_seconds = time.perf_counter() - start

        def run(settings: Settings, seed: int) -> Run:
            render = gi.render(place.scene, kind(**depth, **settings), place.size, seed, place.device)
            return own_run(render, render.layers["indirect"], compile_seconds)

        return run

    return Contender(called or name, ladder, load, sources())


@cache
def sources() -> str:
    """Digest of the library's sources, on which errors and seconds of its methods depend."""
    digest = hashlib.blake2b(digest_size=10)
    for folder in ("kernels", "warpgi"):
        for path in sorted((CHECKOUT / folder).rglob("*.py")):
            digest.update(path.relative_to(CHECKOUT).as_posix().encode() + path.read_bytes())
    return digest.hexdigest()


def contenders(names: tuple[str, ...] = ()) -> tuple[list[Contender], list[str]]:
    """Those of the given names, or all, and a line for each that is left out.

    Raises:
        ValueError: there is no such contender.
    """
    known = [*gi.METHODS, *PEERS]
    for name in names:
        if name not in known:
            raise ValueError(f"methods holds {name!r}, expected some of {', '.join(known)}")
    found: list[Contender] = []
    notes: list[str] = []
    for name in names or known:
        if name in NO_LIGHT:
            notes.append(f"{name} is left out: {NO_LIGHT[name]}")
        elif name in PEERS:
            try:
                found.append(PEERS[name]())
            except (ImportError, ValueError) as error:
                notes.append(f"{name} is left out: {error}")
        elif name in LADDERS:
            found.append(own(name, LADDERS[name]))
        else:
            notes.append(f"{name} is left out: it has no line in bench/contenders.py")
    return found, notes
