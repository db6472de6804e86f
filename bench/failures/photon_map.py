"""Where photon maps fail: blotches of few photons, dark edges, thin walls, and caustics that are blurred."""

from __future__ import annotations

from functools import lru_cache

import numpy as np

import warpgi as gi
from bench.failures.failure import Failure, Value, indirect, inside_ring, mean_value

SIZE = (48, 48)


def _room(method: gi.PhotonMap, device: gi.Device, seed: int) -> tuple[np.ndarray, np.ndarray]:
    """Indirect radiance and positions in a furnace, whose light is the same everywhere."""
    scene, _ = gi.scenes.furnace(albedo=0.5)
    render = gi.render(scene, method, SIZE, seed, device)
    return render.layers["indirect"].mean(axis=2, dtype=np.float64), render.layers["position"]


def blotches(device: gi.Device) -> Value:
    """Scatter of what is evenly lit, in blocks of 8 x 8 pixels: noise that no averaging over a pixel takes away."""
    values = []
    for seed in range(4):
        image, position = _room(gi.PhotonMap(photons=20_000, spp=4), device, seed)
        blocks = image.reshape(6, 8, 6, 8).mean(axis=(1, 3))
        inner = (np.sort(np.abs(position), axis=2)[..., 1] < 0.8).reshape(6, 8, 6, 8).all(axis=(1, 3))
        values.append(float(blocks[inner].std() / blocks[inner].mean()))
    return mean_value(values)


def _edge(edge_rays: int, photons: int, device: gi.Device, corner: bool = False) -> Value:
    values = []
    for seed in range(4):
        image, position = _room(gi.PhotonMap(photons=photons, spp=4, edge_rays=edge_rays), device, seed)
        # the wall is at 1 in one coordinate; how near are the others to it?
        least, second, _ = np.moveaxis(np.sort(np.abs(position), axis=2), 2, 0)
        near = least > 0.9 if corner else second > 0.95
        values.append(float(1.0 - image[near].mean() / image[second < 0.8].mean()))
    return mean_value(values)


def dark_edges(device: gi.Device) -> Value:
    """What is missing along edges of an evenly lit room without the correction."""
    return _edge(0, 50_000, device)


def corrected_edges(device: gi.Device) -> Value:
    """The same with it, of either sign."""
    value = _edge(8, 50_000, device)
    return Value(abs(value.value), value.error)


def dark_corners(device: gi.Device) -> Value:
    """What is missing in corners of an evenly lit room without the correction."""
    return _edge(0, 50_000, device, corner=True)


def corrected_corners(device: gi.Device) -> Value:
    """The same with it, of either sign."""
    value = _edge(8, 50_000, device, corner=True)
    return Value(abs(value.value), value.error)


def _leak(method: gi.PhotonMap | gi.IrradianceCache, device: gi.Device) -> Value:
    scene, _ = gi.scenes.leak(open_front=True)
    values = []
    for seed in range(4):
        render = gi.render(scene, method, SIZE, seed, device)
        light, met = render.layers["indirect"].mean(axis=2), render.layers["depth"][..., 0] > 0.0
        x = render.layers["position"][..., 0]
        values.append(float(light[met & (x > 0.01)].mean() / light[met & (x < -0.01)].mean()))
    return mean_value(values)


def leak(device: gi.Device) -> Value:
    """Mean light of the dark room over that of the lit one."""
    return _leak(gi.PhotonMap(spp=4), device)


def leak_gathered(device: gi.Device) -> Value:
    """The same by final gathering."""
    return _leak(gi.PhotonMap(spp=4, final_gather=8), device)


def leak_cached(device: gi.Device) -> Value:
    """The same by final gathering at the records of an irradiance cache."""
    return _leak(gi.IrradianceCache(spp=4, rays=256, photons=200_000), device)


def leak_any_normal(device: gi.Device) -> Value:
    """The same where photons of any normal are taken."""
    return _leak(gi.PhotonMap(spp=4, normal_angle=180.0), device)


def leak_any_plane(device: gi.Device) -> Value:
    """The same where photons off the plane are taken."""
    return _leak(gi.PhotonMap(spp=4, flatten=1.0), device)


def leak_taking_all(device: gi.Device) -> Value:
    """The same where photons of any normal and plane are taken."""
    return _leak(gi.PhotonMap(spp=4, normal_angle=180.0, flatten=1.0), device)


@lru_cache(maxsize=1)
def _fine_caustic(device: gi.Device) -> tuple[gi.Scene, gi.Render]:
    """A small lamp's caustic, by a hundred times the photons of what is judged and a tenth of the area."""
    scene = gi.scenes.caustic(lamp_radius=0.01)
    fine = gi.PhotonMap(spp=64, map_spp=4, caustic_photons=200_000, caustic_neighbours=20)
    return scene, gi.render(scene, fine, SIZE, 99, device)


def _blur(neighbours: int, device: gi.Device) -> Value:
    """relMSE inside the ring."""
    scene, truth = _fine_caustic(device)
    inside = inside_ring(scene, truth)
    values = []
    for seed in range(4):
        method = gi.PhotonMap(caustic_photons=20_000, caustic_neighbours=neighbours)
        picture = indirect(scene, method, SIZE, seed, device)
        values.append(gi.compare(picture[inside][None], truth.layers["indirect"][inside][None])["relmse"])
    return mean_value(values)


def gathered_dots(device: gi.Device) -> Value:
    """Pixels 1.5 times as bright as all but one around: gather rays that met a caustic by chance."""
    values = []
    for seed in range(4):
        image = indirect(gi.scenes.caustic(), gi.PhotonMap(spp=4, final_gather=4), SIZE, seed, device).mean(axis=2)
        padded = np.pad(image, 1, mode="reflect")
        shifts = [(y, x) for y in range(3) for x in range(3) if (y, x) != (1, 1)]
        around = np.stack([padded[y : y + SIZE[1], x : x + SIZE[0]] for y, x in shifts])
        values.append(float((image > 1.5 * np.partition(around, -2, axis=0)[-2]).mean()))
    return mean_value(values)


def blurred_caustic(device: gi.Device) -> Value:
    """k = 200: sharp edges of light are wide."""
    return _blur(200, device)


def caustic_by_default(device: gi.Device) -> Value:
    """k = 20, as it is unless told otherwise."""
    return _blur(20, device)


def blotchy_caustic(device: gi.Device) -> Value:
    """k = 10: they are sharp, and rough."""
    return _blur(10, device)


ROWS = (
    Failure("photon-map", "furnace", "scatter of even light over 8 x 8 pixels, 20 000 paths", None, blotches),
    Failure("photon-map", "furnace", "light missing along edges, no correction", None, dark_edges),
    Failure("photon-map", "furnace", "light wrong along edges, corrected", 0.04, corrected_edges),
    Failure("photon-map", "furnace", "light missing in corners, no correction", None, dark_corners),
    Failure("photon-map", "furnace", "light wrong in corners, corrected", 0.1, corrected_corners),
    Failure("photon-map", "leak", "light of the dark room over the lit one's", 0.03, leak),
    Failure("photon-map", "leak", "the same by final gathering", 0.03, leak_gathered),
    Failure("photon-map", "leak", "the same by gathering at cached records", 0.03, leak_cached),
    Failure("photon-map", "leak", "the same, photons of any normal taken", None, leak_any_normal),
    Failure("photon-map", "leak", "the same, photons off the plane taken", None, leak_any_plane),
    Failure("photon-map", "leak", "the same, all normals and planes taken", None, leak_taking_all),
    Failure("photon-map", "caustic", "relMSE inside the ring, small lamp, k = 10", None, blotchy_caustic),
    Failure("photon-map", "caustic", "relMSE inside the ring, small lamp, k = 20", None, caustic_by_default),
    Failure("photon-map", "caustic", "relMSE inside the ring, small lamp, k = 200", None, blurred_caustic),
    Failure("photon-map", "caustic", "share of pixels that stand out, 16 gather rays", None, gathered_dots),
)
