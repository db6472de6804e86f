"""Where paths can leave a light: a domain of even density for each light, and the way from a lit point back to it."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from warpgi.device_scene import DeviceScene
from warpgi.kernels.photons import Emission
from warpgi.lights import DistantLight, Environment, PointLight, SpotLight

ENVIRONMENT = -1


@dataclass(frozen=True, eq=False)
class Domain:
    """Paths of one light, or one side of a lamp, are aimed at a unit square in which light is even.

    Attributes:
        light: what stays the same from frame to frame: ("shape", index, side) or ("light", index).
        share: of all light, as if lights were picked by power.
        records: numbers of the light's records on the device; of a lamp those of its triangles.
    """

    light: tuple
    share: float
    records: np.ndarray
    triangles: np.ndarray | None = None
    """Of a lamp: corners relative to the scene's centre, shape (F, 3, 3)."""
    normals: np.ndarray | None = None
    """Of a lamp: unit normals on the side that emits, shape (F, 3)."""
    position: np.ndarray | None = None
    """Of a point or a spot light, relative to the scene's centre."""
    direction: np.ndarray | None = None
    """Of a spot or parallel light."""
    cone: tuple[float, float] | None = None
    """Cosines of the inner and the outer angle."""
    radius: float = 1.0
    """Of parallel light: of the disc that it comes through."""

    @property
    def side(self) -> float:
        """Of a lamp."""
        return float(self.light[2]) if self.light[0] == "shape" else 1.0

    def embed(self, aim: np.ndarray) -> np.ndarray:
        """Points in a space in which distances are those of directions, shape (N, 2) or (N, 3)."""
        if self.position is not None and self.cone is None:
            return square_to_sphere(aim)
        if self.cone is not None:
            r, phi = np.sqrt(aim[:, :1]), 2.0 * math.pi * aim[:, 1]
            return r * np.stack([np.cos(phi), np.sin(phi)], axis=1)
        return square_to_disc(aim)

    def origins(self, face: np.ndarray, u: np.ndarray) -> np.ndarray:
        """Where paths begin, shape (N, 3); `face` counts a lamp's triangles. Parallel light begins nowhere."""
        if self.triangles is not None:
            r = np.sqrt(u[:, :1])
            a, b, c = (self.triangles[face][:, i] for i in range(3))
            return a * (1.0 - r) + b * (r * (1.0 - u[:, 1:])) + c * (r * u[:, 1:])
        return np.broadcast_to(np.zeros(3) if self.position is None else self.position, (len(face), 3))

    def directions(self, face: np.ndarray, u: np.ndarray, aim: np.ndarray) -> np.ndarray:
        """Where paths go, shape (N, 3)."""
        if self.triangles is not None:
            assert self.normals is not None
            disc = square_to_disc(aim)
            up = np.sqrt(np.maximum(1.0 - np.square(disc).sum(axis=1), 0.0))
            s, t = frame(self.normals[face])
            return s * disc[:, :1] + t * disc[:, 1:] + self.normals[face] * up[:, None]
        if self.position is None:
            return self._parallel(u)
        if self.cone is None:
            return square_to_sphere(aim)
        assert self.direction is not None
        inner, outer, total = self._cone()
        v = aim[:, 0] * total
        edge = outer + (inner - outer) * np.cbrt(np.maximum((total - v) * 3.0 / (inner - outer), 0.0))
        cos = np.where(v > 1.0 - inner, edge, 1.0 - v)
        sin, phi = np.sqrt(np.maximum(1.0 - cos * cos, 0.0)), 2.0 * math.pi * aim[:, 1]
        s, t = frame(np.broadcast_to(self.direction, (len(aim), 3)))
        return s * (sin * np.cos(phi))[:, None] + t * (sin * np.sin(phi))[:, None] + self.direction * cos[:, None]

    def aim_at(self, face: np.ndarray, u: np.ndarray, p: np.ndarray, far: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """The aims of paths that reach points p, or that go along p where `far`, and which there can be."""
        if self.position is None and self.triangles is None:
            d = self._parallel(u)
            s, t = frame(d)
            disc = np.stack([(s * p).sum(axis=1), (t * p).sum(axis=1)], axis=1) / self.radius
            return disc_to_square(disc), np.square(disc).sum(axis=1) <= 1.0
        d = np.where(far[:, None], p, p - self.origins(face, u))
        d = d / np.maximum(np.linalg.norm(d, axis=1, keepdims=True), 1e-30)
        if self.triangles is not None:
            assert self.normals is not None
            s, t = frame(self.normals[face])
            disc = np.stack([(s * d).sum(axis=1), (t * d).sum(axis=1)], axis=1)
            return disc_to_square(disc), (self.normals[face] * d).sum(axis=1) > 0.0
        if self.cone is None:
            phi = np.arctan2(d[:, 1], d[:, 0]) / (2.0 * math.pi)
            return np.stack([0.5 - 0.5 * d[:, 2], phi % 1.0], axis=1), np.ones(len(p), bool)
        assert self.direction is not None
        inner, outer, total = self._cone()
        s, t = frame(np.broadcast_to(self.direction, d.shape))
        cos = d @ self.direction
        edge = total - (inner - outer) / 3.0 * (np.maximum(cos - outer, 0.0) / (inner - outer)) ** 3
        v = np.where(cos < inner, edge, 1.0 - cos) / total
        phi = np.arctan2((t * d).sum(axis=1), (s * d).sum(axis=1)) / (2.0 * math.pi)
        return np.stack([v, phi % 1.0], axis=1), cos > outer

    def _parallel(self, u: np.ndarray) -> np.ndarray:
        if self.direction is None:
            return square_to_sphere(u)
        return np.broadcast_to(self.direction, (len(u), 3))

    def _cone(self) -> tuple[float, float, float]:
        assert self.cone is not None
        inner, outer = self.cone
        return inner, outer, (1.0 - inner) + (inner - outer) / 3.0


def domains(scene: DeviceScene, emission: Emission) -> list[Domain]:
    """One for each light of a scene, and for each side of a lamp; of share 0 where it is off."""
    record_face = scene.struct.lights.numpy()["face"]
    power = np.diff(scene.struct.light_cdf.numpy().astype(np.float64), prepend=0.0) * (1.0 - emission.environment)
    record_of_face = dict(zip(record_face.tolist(), range(len(record_face)), strict=True))
    result = []
    for i, shape in enumerate(scene.scene.shapes):
        if shape.emission is None:
            continue
        faces = range(int(scene.first_face[i]), int(scene.first_face[i + 1]))
        records = np.array([record_of_face.get(face, 0) for face in faces])
        lit = faces[0] in record_of_face
        share = float(power[records].sum()) if lit else 0.0
        triangles = shape.vertices[shape.faces] - scene.centre
        normals = np.cross(triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0])
        normals /= np.linalg.norm(normals, axis=1, keepdims=True)
        for side in (1, -1) if shape.emission.two_sided else (1,):
            part = share / (2.0 if shape.emission.two_sided else 1.0)
            result.append(Domain(("shape", i, side), part, records, triangles, normals * side))
    others = iter(np.flatnonzero(record_face < 0))
    for i, light in enumerate(scene.scene.lights):
        of = ("light", i)
        if isinstance(light, Environment):
            result.append(Domain(of, emission.environment, np.array([ENVIRONMENT]), radius=scene.radius))
            continue
        strength = light.irradiance if isinstance(light, DistantLight) else light.intensity
        on = float(np.mean(strength)) > 0.0  # type: ignore[arg-type]
        record = next(others) if on else 0
        share, records = (float(power[record]), np.array([record])) if on else (0.0, np.zeros(1, int))
        direction = None if isinstance(light, PointLight) else np.asarray(light.direction, dtype=np.float64)
        if isinstance(light, DistantLight):
            result.append(Domain(of, share, records, direction=direction, radius=scene.radius))
            continue
        position = np.asarray(light.position, dtype=np.float64) - scene.centre
        cone = None
        if isinstance(light, SpotLight):
            # the device's float32 cone never has width 0
            outer = math.cos(light.outer_angle)
            cone = (max(math.cos(light.inner_angle), outer + 1e-6), outer)
        result.append(Domain(of, share, records, position=position, direction=direction, cone=cone))
    return result


def frame(n: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Two axes around unit vectors, shape (N, 3) each, those of `kernels.sampling.make_frame` (Duff et al. 2017)."""
    x, y, z = n.T
    sign = np.where(z >= 0.0, 1.0, -1.0)
    a = -1.0 / (sign + z)
    b = x * y * a
    s = np.stack([1.0 + sign * x * x * a, sign * b, -sign * x], axis=1)
    return s, np.stack([b, sign + y * y * a, -y], axis=1)


def square_to_sphere(u: np.ndarray) -> np.ndarray:
    """As on the device."""
    z, phi = 1.0 - 2.0 * u[:, 0], 2.0 * math.pi * u[:, 1]
    r = np.sqrt(np.maximum(1.0 - z * z, 0.0))
    return np.stack([r * np.cos(phi), r * np.sin(phi), z], axis=1)


def square_to_disc(u: np.ndarray) -> np.ndarray:
    """As on the device, concentric (Shirley, Chiu 1997)."""
    a, b = 2.0 * u.T - 1.0
    wide = np.abs(a) > np.abs(b)
    r = np.where(wide, a, b)
    safe = np.where(r == 0.0, 1.0, r)
    phi = np.where(wide, 0.25 * math.pi * b / safe, 0.5 * math.pi - 0.25 * math.pi * a / safe)
    return np.stack([r * np.cos(phi), r * np.sin(phi)], axis=1)


def disc_to_square(p: np.ndarray) -> np.ndarray:
    """The inverse."""
    x, y = p.T
    r = np.hypot(x, y)
    wide = np.abs(x) > np.abs(y)
    a = np.where(wide, np.copysign(r, x), 0.0)
    b = np.where(wide, 0.0, np.copysign(r, y))
    with np.errstate(divide="ignore", invalid="ignore"):
        b = np.where(wide, a * np.arctan(np.where(wide, y / x, 0.0)) * 4.0 / math.pi, b)
        a = np.where(wide, a, b * np.arctan(np.where(wide | (y == 0.0), 0.0, x / y)) * 4.0 / math.pi)
    return np.clip(0.5 * np.stack([a, b], axis=1) + 0.5, 0.0, 1.0)
