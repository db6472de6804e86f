"""Rays, paths and reconstruction rays per second: beside `wp.mesh_query_ray` on the same rays, Mitsuba on the same
pictures, and a yardstick of the machine.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from contextlib import nullcontext
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
import warp as wp

import warpgi as gi
from bench.compiling import compile_rows
from bench.mitsuba_peer import MitsubaPeer
from bench.photons import photon_rows
from bench.reconstruction import AUTHORS, AUTHORS_YARDSTICK, SPP, stage_rows, yardstick
from bench.report import Row, circumstances, paired_ratio, print_table, row, write_json
from bench.turns import take_turns
from bench.vpls import vpl_rows
from warpgi import checks
from warpgi.device_scene import DeviceScene
from warpgi.film import BYTES_PER_PIXEL, Film
from warpgi.image import atomic_write
from warpgi.job import Job
from warpgi.kernels import rays as kernels
from warpgi.kernels import tree_build
from warpgi.mitsuba_scene import NoCounterpart
from warpgi.render import versions
from warpgi.scenes import build

KERNELS = (
    kernels.make_secondary_rays,
    kernels.make_shadow_rays,
    kernels.make_camera_rays,
    kernels.trace_closest_hits,
    kernels.trace_mesh,
    kernels.trace_shadow_rays,
)
MAX_DEPTH = 6
# Rays of a kind: more would measure no better, and fill a small card.
MOST_RAYS = 1 << 22
# Triangles up to which wp.Mesh is fastest with two a leaf; above it is with four.
SMALL_SCENE = 10_000
SEED = 1


@dataclass(frozen=True)
class Settings:
    """What to measure, and where."""

    device: str | None
    scenes: tuple[str, ...]
    size: tuple[int, int]
    spp: int
    repeats: int
    threads: int | None
    peers: bool
    samples: Path | None = None

    def __post_init__(self) -> None:
        for name in ("spp", "repeats"):
            checks.count(name, getattr(self, name))
        for name, value in zip(("width", "height"), self.size, strict=True):
            checks.count(name, value)


@dataclass(frozen=True)
class RaySet:
    """Rays on the device."""

    origins: wp.array
    directions: wp.array
    distances: wp.array | None = None
    """Of shadow rays: where they end."""


class Tracer:
    """Makes rays for one scene, and traces them by ours and by Warp's tree."""

    def __init__(self, scene: gi.Scene, on_device: DeviceScene, device: gi.Device, size: tuple[int, int], spp: int):
        self.device = device
        self.struct = on_device.struct
        self.camera = on_device.camera(size)
        self.rays_per_pixel = max(1, min(spp, MOST_RAYS // (size[0] * size[1])))
        self.count = min(size[0] * size[1] * self.rays_per_pixel, MOST_RAYS)
        self.cdf = np.cumsum(np.concatenate([shape.areas() for shape in scene.shapes]))
        self.random = np.random.default_rng(SEED)
        self.leaf_size = 2 if scene.triangle_count <= SMALL_SCENE else 4
        self.mesh = wp.Mesh(
            wp.clone(on_device.struct.points),
            wp.clone(on_device.struct.indices),
            bvh_constructor="sah",
            bvh_leaf_size=self.leaf_size,
        )
        self.blocked = device.zeros(self.count, int)

    def hits(self) -> kernels.Hits:
        """Room for the hits of as many rays."""
        result = kernels.Hits()
        for name, dtype in (("t", float), ("u", float), ("v", float), ("face", int)):
            setattr(result, name, self.device.zeros(self.count, dtype))
        return result

    def camera_rays(self) -> RaySet:
        """Rays of the path tracer's camera, pixel by pixel."""
        rays = self._empty()
        inputs = [self.camera, SEED, self.rays_per_pixel]
        self.device.launch(kernels.make_camera_rays, self.count, inputs, [rays.origins, rays.directions])
        return rays

    def secondary_rays(self) -> RaySet:
        """Cosine-distributed rays from points uniform over the scene's surface."""
        rays = self._empty()
        inputs = [self.struct, SEED, self._faces()]
        self.device.launch(kernels.make_secondary_rays, self.count, inputs, [rays.origins, rays.directions])
        return rays

    def shadow_rays(self) -> RaySet | None:
        """Rays from such points to sampled lights; None where there is no light to sample."""
        if self.struct.light_count == 0:
            return None
        parts: list[list[np.ndarray]] = []
        found = 0
        while found < self.count:
            rays = self._empty()
            outputs = [rays.origins, rays.directions, self.device.zeros(self.count, float)]
            inputs = [self.struct, SEED + len(parts), self._faces()]
            self.device.launch(kernels.make_shadow_rays, self.count, inputs, outputs)
            arrays = [array.numpy().copy() for array in outputs]
            sent = arrays[2] >= 0.0
            if not sent.any():
                return None
            parts.append([array[sent] for array in arrays])
            found += int(sent.sum())
        o, d, t = (np.concatenate(arrays)[: self.count] for arrays in zip(*parts, strict=True))
        return RaySet(self.device.array(o, wp.vec3), self.device.array(d, wp.vec3), self.device.array(t, float))

    def trace(self, rays: RaySet, hits: kernels.Hits) -> None:
        """The nearest hits, by the path tracer's tree."""
        self.device.launch(kernels.trace_closest_hits, self.count, [self.struct, rays.origins, rays.directions], [hits])

    def trace_mesh(self, rays: RaySet, hits: kernels.Hits) -> None:
        """The nearest hits, by Warp's."""
        self.device.launch(kernels.trace_mesh, self.count, [self.mesh.id, rays.origins, rays.directions], [hits])

    def trace_shadow(self, rays: RaySet) -> None:
        """Which rays are blocked."""
        inputs = [self.struct, rays.origins, rays.directions, rays.distances]
        self.device.launch(kernels.trace_shadow_rays, self.count, inputs, [self.blocked])

    def _empty(self) -> RaySet:
        origins, directions = (self.device.zeros(self.count, wp.vec3) for _ in range(2))
        return RaySet(origins, directions)

    def _faces(self) -> wp.array:
        # in float64: a triangle of a large scene is too small a part of a float32 sum
        faces = np.searchsorted(self.cdf, self.random.random(self.count) * self.cdf[-1], side="right")
        return self.device.array(np.minimum(faces, len(self.cdf) - 1).astype(np.int32), int)


def run(settings: Settings, json: Path | None) -> None:
    """Measures, prints the table and writes the JSON.

    Raises:
        ValueError: a setting is wrong, or a peer is missing.
        OSError: the file cannot be written.
    """
    device = gi.Device(settings.device, settings.threads)
    buffer = None if settings.samples is None else gi.SampleBuffer.load(settings.samples)
    scenes = [build(name) for name in settings.scenes]
    seen = versions()
    peers: dict[str, MitsubaPeer] = {}
    notes: dict[str, str] = {}
    for scene in scenes if settings.peers else ():
        try:
            peers[scene.name] = MitsubaPeer(scene, settings.size, MAX_DEPTH, device.threads)
            seen["mitsuba"] = peers[scene.name].version
        except NoCounterpart as error:
            notes[scene.name] = f"no Mitsuba: {error}"
    about = circumstances(device, seen)
    with atomic_write(json) if json else nullcontext() as file:
        rows = compile_rows(device.name)
        device.load([*KERNELS, *_path_tracing(settings).kernels, *gi.LightField().kernels])
        gi.Device("cpu").load([tree_build.read_tree])
        yard = yardstick(device)
        for scene in scenes:
            rows += scene_rows(scene, settings, device, peers.get(scene.name), notes.get(scene.name, ""))
            samples = gi.sample(scene, SPP, settings.size, SEED, device)
            rows += stage_rows(scene.name, samples, device, settings.repeats, yard)
        if buffer is not None:
            rows += stage_rows(settings.samples.name, buffer, device, settings.repeats, yard)
        if yard is not None and yard.rates:
            rows.append(yard.row())
        print_table(rows)
        if file is not None:
            write_json(file, about, _settings_of_record(settings, device, peers), rows)


def scene_rows(
    scene: gi.Scene, settings: Settings, device: gi.Device, peer: MitsubaPeer | None, note: str
) -> list[Row]:
    """All rows of one scene; `note` says why there is no peer."""
    uploads = []
    for _ in range(min(3, settings.repeats)):
        start = time.perf_counter()
        on_device = DeviceScene(scene, device)
        device.synchronize()
        uploads.append(time.perf_counter() - start)
    pixels = settings.size[0] * settings.size[1]
    return [
        row(scene.name, "upload and tree", uploads, "s", note=f"{scene.triangle_count} triangles"),
        row(scene.name, "device memory, scene", on_device.nbytes, "B"),
        row(scene.name, "device memory, film", BYTES_PER_PIXEL * pixels, "B"),
        *ray_rows(Tracer(scene, on_device, device, settings.size, settings.spp), scene.name, settings.repeats),
        *path_rows(scene, on_device, settings, peer, note),
        *photon_rows(scene, on_device, settings.size, settings.repeats, pixels * settings.spp),
        *vpl_rows(scene.name, on_device, settings.size, settings.repeats),
    ]


def ray_rows(tracer: Tracer, scene: str, repeats: int) -> list[Row]:
    """Closest hits of two kinds by two trees, and shadow rays."""
    kinds = {"camera rays": tracer.camera_rays(), "secondary rays": tracer.secondary_rays()}
    shadow = tracer.shadow_rays()
    ours = {name: tracer.hits() for name in kinds}
    theirs = {name: tracer.hits() for name in kinds}
    jobs: dict[str, Callable[[], None]] = {}
    for name, rays in kinds.items():
        jobs[f"closest hit, {name}"] = lambda rays=rays, hits=ours[name]: tracer.trace(rays, hits)
        jobs[f"wp.mesh_query_ray, {name}"] = lambda rays=rays, hits=theirs[name]: tracer.trace_mesh(rays, hits)
    if shadow is not None:
        jobs["shadow rays"] = lambda: tracer.trace_shadow(shadow)
    seconds = take_turns(jobs, repeats, tracer.device)
    rates = {name: tracer.count / np.array(values) for name, values in seconds.items()}
    rows = []
    for name in kinds:
        same, other = f"closest hit, {name}", f"wp.mesh_query_ray, {name}"
        ratio = paired_ratio(rates[same], rates[other])
        misses = np.count_nonzero(ours[name].face.numpy() < 0) / tracer.count
        differ = np.count_nonzero(_differ(ours[name], theirs[name])) / tracer.count
        note = f"{misses:.2%} miss, {differ:.2g} of the rays meet something else"
        rows.append(row(scene, same, rates[same], "rays/s", ratio=ratio, versus="wp.mesh_query_ray", note=note))
        rows.append(row(scene, other, rates[other], "rays/s", note=f"leaf size {tracer.leaf_size}"))
    if shadow is not None:
        note = f"{tracer.blocked.numpy().mean():.1%} blocked"
        rows.append(row(scene, "shadow rays", rates["shadow rays"], "rays/s", note=note))
    return rows


def path_rows(
    scene: gi.Scene, on_device: DeviceScene, settings: Settings, peer: MitsubaPeer | None, note: str
) -> list[Row]:
    """Whole pictures, from the loaded scene to pixels on the host."""
    device, size, spp = on_device.device, settings.size, settings.spp
    method = _path_tracing(settings)
    pictures: list[np.ndarray] = []
    peer_pictures: list[np.ndarray] = []
    rays: list[int] = []

    def render() -> None:
        image, traced = render_picture(on_device, method, size, len(pictures))
        pictures.append(image)
        rays.append(traced)

    jobs: dict[str, Callable[[], None]] = {"path tracing": render}
    if peer is not None:
        jobs["mitsuba"] = lambda: peer_pictures.append(peer.render(spp, len(peer_pictures)))
    seconds = {name: np.array(values) for name, values in take_turns(jobs, settings.repeats, device).items()}
    paths = size[0] * size[1] * spp
    rates = {name: paths / values for name, values in seconds.items()}
    compared: dict[str, Any] = {}
    if peer is not None:
        compared = {"ratio": paired_ratio(rates["path tracing"], rates["mitsuba"]), "versus": "mitsuba"}
    what = f"path tracing, depth {MAX_DEPTH}"
    rows = [
        row(scene.name, what, rates["path tracing"], "paths/s", note=note, **compared),
        # the first picture warmed up and was not timed
        row(scene.name, f"{what}, all rays", np.array(rays[1:]) / seconds["path tracing"], "rays/s"),
    ]
    if peer is not None:
        own = "" if peer.exact else "its own materials, close to ours"
        rows.append(row(scene.name, f"mitsuba {peer.variant} path", rates["mitsuba"], "paths/s", note=own))
        rows += agreement_rows(scene.name, pictures, peer_pictures)
    return rows


def render_picture(
    on_device: DeviceScene, method: gi.PathTracing, size: tuple[int, int], seed: int
) -> tuple[np.ndarray, int]:
    """Linear radiance, shape (H, W, 3), and the number of rays it took; in one pass, as a peer does it."""
    device = on_device.device
    job = Job(on_device, on_device.camera(size), size, seed, device)
    film = Film(size, device, device.memory_limit - on_device.nbytes)
    state = method.prepare(job, film)
    method.estimate(job, state, film, 0, method.spp)
    layers = film.layers(on_device.centre)
    counts = film.counts()
    image = layers["emission"] + layers["direct"] + layers["indirect"]
    return image, counts["closest_hit_rays"] + counts["shadow_rays"]


def agreement_rows(scene: str, pictures: Sequence[np.ndarray], others: Sequence[np.ndarray]) -> list[Row]:
    """Mean radiance here over there, by channel."""
    ours, theirs = (np.mean(images, axis=(1, 2), dtype=np.float64) for images in (pictures, others))
    ratio = ours.mean(axis=0) / theirs.mean(axis=0)
    noise = np.full(3, np.nan)
    if len(ours) > 1:
        relative = [means.std(axis=0, ddof=1) / means.mean(axis=0) / len(means) ** 0.5 for means in (ours, theirs)]
        noise = ratio * np.hypot(*relative)
    return [
        row(scene, f"mean radiance here / mitsuba, {name}", value, "", note=f"standard error {error:.2g}")
        for name, value, error in zip("RGB", ratio, noise, strict=True)
    ]


def _differ(hits: kernels.Hits, others: kernels.Hits) -> np.ndarray:
    """Which rays met surfaces at another distance, beyond what rounding explains; at edges the face may differ."""
    t, s = hits.t.numpy(), others.t.numpy()
    met, also = hits.face.numpy() >= 0, others.face.numpy() >= 0
    return (met != also) | (met & also & (np.abs(t - s) > 1e-3 * np.abs(s)))


def _path_tracing(settings: Settings) -> gi.PathTracing:
    return gi.PathTracing(spp=settings.spp, max_depth=MAX_DEPTH, roulette_depth=None, sampler=gi.Sampler.INDEPENDENT)


def _settings_of_record(settings: Settings, device: gi.Device, peers: dict[str, MitsubaPeer]) -> dict[str, Any]:
    record = asdict(settings) | {"max_depth": MAX_DEPTH, "threads": device.threads, "device": device.name}
    record["samples"] = None if settings.samples is None else str(settings.samples)
    record["authors"] = {
        name: {"rate": rate, "of_yardstick": rate / AUTHORS_YARDSTICK} for name, rate in AUTHORS.items()
    }
    for peer in peers.values():
        threads = {"threads": peer.drjit.thread_count(), "threads_set_by": "drjit.set_thread_count"}
        record["mitsuba"] = {"variant": peer.variant, "integrator": "path", "exact": peer.exact, **threads}
    return record
