"""`to_mitsuba`: a scene in the terms of Mitsuba 3 (Jakob et al. 2022), to render it there."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from warpgi import checks
from warpgi.camera import Camera
from warpgi.lights import DistantLight, Environment, Light, PointLight, SpotLight
from warpgi.materials import Coated, Colour, Conductor, Dielectric, Diffuse, Material, Texture
from warpgi.mitsuba_plugins import SPOT, SURFACE, register
from warpgi.scene import Scene, Shape

# Roulette begins beyond every path: it is off.
NEVER = 1 << 30

# The back of a surface that emits on both sides is a copy, this part of the scene's size behind it. Closer to the
# surface than any ray starts, and farther from it than rounding.
SHELL = 1e-5

# The camera sees this many times as far as the scene can reach; Mitsuba wants some end.
REACH = 4.0
NEAR = 1e-8  # of that


def to_mitsuba(
    scene: Scene,
    size: tuple[int, int] = (256, 256),
    max_depth: int | None = None,
    roulette_depth: int | None = 5,
    exact: bool = True,
) -> dict[str, Any]:
    """A scene as the dictionary that `mitsuba.load_dict` takes, with a path integrator, camera, box-filtered film.

    Needs `pip install 'warpgi[peers]'` and a Mitsuba RGB variant that has been set; the dictionary holds meshes and
    textures as objects of that variant. The same picture comes out but for noise, and but for shapes that emit: these
    are flat, as Mitsuba would let shading normals steer the emission.

    Args:
        scene: what to export.
        size: (width, height) in pixels.
        max_depth: longest path in segments, 1 sees emitters only; None is unlimited.
        roulette_depth: segments after which Russian roulette may end a path; None switches it off.
        exact: surfaces with shading normals, rough metal and spot lights are plugins written in Python
            (`warpgi.mitsuba_plugins`), which cost nothing in a vectorised variant and much in a scalar one. False takes
            Mitsuba's own, which are close: foliage comes out some per cent brighter as shading normals let light
            through, metal is of the Beckmann distribution, a spot light's edge is linear in the angle. Coated
            surfaces are roughplastic then, and have no exact counterpart.

    Returns:
        A new dictionary; change its "integrator" and "sensor" or add to it as you like.

    Raises:
        ImportError: Mitsuba is not installed.
        ValueError: no RGB variant is set, or an argument is out of range.
        NoCounterpart: the scene holds what Mitsuba would render otherwise.

    Example:
        >>> import warpgi as gi
        >>> import mitsuba
        >>> mitsuba.set_variant("scalar_rgb")
        >>> there = mitsuba.load_dict(gi.to_mitsuba(gi.scenes.cornell_box(), size=(8, 8)))
        >>> mitsuba.render(there, spp=1).shape
        (8, 8, 3)
    """
    if not isinstance(scene, Scene):
        raise TypeError(f"scene is {type(scene).__name__}, expected Scene")
    size = checks.image_size(size)
    depth = -1 if max_depth is None else checks.count("max_depth", max_depth)
    roulette = NEVER if roulette_depth is None else checks.count("roulette_depth", roulette_depth)
    mi = require_mitsuba()
    register(mi)
    result: dict[str, Any] = {
        "type": "scene",
        "integrator": {"type": "path", "max_depth": depth, "rr_depth": roulette},
        "sensor": _sensor(mi, scene, size),
    }
    exporter = _Exporter(mi, scene, exact)
    for index, shape in enumerate(scene.shapes):
        for part, mesh in exporter.meshes(shape).items():
            result[f"shape{index}{part}"] = mesh
    for index, light in enumerate(scene.lights):
        result[f"light{index}"] = _light(mi, light, exact)
    return result


def needs_plugins(scene: Scene) -> bool:
    """Whether anything in it is not exact in Mitsuba but for plugins of ours, if at all."""
    smooth = (s.normals is not None and s.emission is None for s in scene.shapes if not _is_glass(s))
    metal = (isinstance(shape.material, (Conductor, Coated)) for shape in scene.shapes)
    return any(smooth) or any(metal) or any(isinstance(light, SpotLight) for light in scene.lights)


def require_mitsuba() -> Any:
    """The mitsuba module, with an RGB variant set.

    Raises:
        ImportError: Mitsuba is not installed.
        ValueError: no variant is set, or one of another colour representation.
    """
    try:
        import mitsuba
    except ImportError as error:
        raise ImportError("mitsuba is not installed: pip install 'warpgi[peers]'") from error
    variant = mitsuba.variant()
    if variant is None or not variant.endswith("_rgb"):
        raise ValueError(f"mitsuba's variant is {variant}, expected an RGB one: mitsuba.set_variant('llvm_ad_rgb')")
    return mitsuba


class NoCounterpart(ValueError):
    """A scene holds something that Mitsuba would render otherwise."""


class _Exporter:
    """Makes Mitsuba's objects; materials and textures that shapes share are made once."""

    def __init__(self, mi: Any, scene: Scene, exact: bool) -> None:
        self.mi, self.exact = mi, exact
        low, high = scene.bounds()
        self.shell = SHELL * float(np.linalg.norm(high - low))
        self._textures: dict[int, Any] = {}
        self._surfaces: dict[tuple[int, bool], Any] = {}

    def meshes(self, shape: Shape) -> dict[str, Any]:
        """The shape's mesh, and its back where that emits too, by the ends of their names."""
        if shape.emission is None:
            return {"": self._mesh(shape, shape.vertices, shape.faces, None)}
        if not shape.emission.two_sided:
            return {"": self._mesh(shape, shape.vertices, shape.faces, shape.emission.radiance)}
        if _is_glass(shape):
            raise NoCounterpart(f"{shape.name} is glass that emits on both sides, which Mitsuba has no counterpart for")
        # triangles of their own, so that each moves along its own normal
        corners = shape.vertices[shape.faces]
        normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        normals /= np.linalg.norm(normals, axis=1, keepdims=True)
        behind = (corners - self.shell * normals[:, None]).reshape(-1, 3)
        faces = np.arange(len(behind), dtype=np.int32).reshape(-1, 3)
        uv = None if shape.uv is None else shape.uv[shape.faces].reshape(-1, 2)
        radiance = shape.emission.radiance
        front = self._mesh(shape, shape.vertices, shape.faces, radiance)
        back = self._mesh(Shape(behind, faces[:, ::-1], shape.material, uv=uv), behind, faces[:, ::-1], radiance)
        return {"": front, "back": back}

    def _mesh(self, shape: Shape, vertices: np.ndarray, faces: np.ndarray, radiance: Colour | None) -> Any:
        smooth = shape.normals is not None and radiance is None
        props = self.mi.Properties()
        props["bsdf"] = self._surface(shape.material, smooth)
        props["face_normals"] = not smooth
        if radiance is not None:
            props["emitter"] = self.mi.load_dict({"type": "area", "radiance": rgb(radiance)})
        with_uv = shape.uv is not None
        mesh = self.mi.Mesh(
            shape.name, len(vertices), len(faces), props, has_vertex_normals=smooth, has_vertex_texcoords=with_uv
        )
        params = self.mi.traverse(mesh)
        params["vertex_positions"] = vertices.astype(np.float32).ravel()
        params["faces"] = faces.astype(np.uint32).ravel()
        if with_uv:
            # there v = 0 is the image's first row, here v = 1
            params["vertex_texcoords"] = np.stack([shape.uv[:, 0], 1.0 - shape.uv[:, 1]], axis=1).astype("f4").ravel()
        if smooth:
            params["vertex_normals"] = shape.normals.astype(np.float32).ravel()
        params.update()
        return mesh

    def _surface(self, material: Material, smooth: bool) -> Any:
        key = (id(material), smooth)
        if key not in self._surfaces:
            self._surfaces[key] = self.mi.load_dict(self._surface_dict(material, smooth))
        return self._surfaces[key]

    def _surface_dict(self, material: Material, smooth: bool) -> dict[str, Any]:
        if isinstance(material, Dielectric):
            return {"type": "dielectric", "int_ior": material.ior, "ext_ior": 1.0}
        if isinstance(material, Conductor):
            return self._metal(material) if self.exact else {"type": "twosided", "bsdf": self._nearly_metal(material)}
        if isinstance(material, Coated):
            return {"type": "twosided", "bsdf": self._nearly_coated(material)}
        is_diffuse = isinstance(material, Diffuse)
        colour = material.albedo if isinstance(material, Diffuse) else material.reflectance
        if smooth and self.exact:
            kind = "diffuse" if is_diffuse else "mirror"
            return {"type": SURFACE, "kind": kind, "reflectance": self._texture(colour)}
        own = {"type": "diffuse", "reflectance": self._texture(colour)}
        if not is_diffuse:
            own = {"type": "conductor", "material": "none", "specular_reflectance": self._texture(colour)}
        return {"type": "twosided", "bsdf": own}

    def _metal(self, metal: Conductor) -> dict[str, Any]:
        result = {"type": SURFACE, "kind": "conductor", "exponent": 1.0 / metal.roughness}
        result["reflectance"] = self._texture(metal.reflectance)
        if metal.eta is not None:
            result |= {"eta": self.mi.ScalarVector3f(metal.eta), "k": self.mi.ScalarVector3f(metal.k)}
        return result

    def _nearly_coated(self, coated: Coated) -> dict[str, Any]:
        if self.exact:
            raise NoCounterpart("Coated is only nearly Mitsuba's roughplastic, expected exact=False")
        result = {"type": "roughplastic", "nonlinear": True, "int_ior": coated.ior, "ext_ior": 1.0}
        beckmann = {"distribution": "beckmann", "alpha": _beckmann(coated.roughness)}
        return result | beckmann | {"diffuse_reflectance": self._texture(coated.albedo)}

    def _nearly_metal(self, metal: Conductor) -> dict[str, Any]:
        result = {"type": "roughconductor", "distribution": "beckmann", "alpha": _beckmann(metal.roughness)}
        if metal.eta is not None:
            return result | {"eta": rgb(metal.eta), "k": rgb(metal.k)}
        # eta 1 and such a k reflect this much at normal incidence (Pharr, Jakob, Humphreys 2023, sec. 9.4)
        texture = metal.reflectance if isinstance(metal.reflectance, Texture) else None
        colour = np.minimum(np.asarray(metal.reflectance if texture is None else texture.pixels), 0.9999)
        k = 2.0 * np.sqrt(colour / (1.0 - colour))
        return result | {"eta": rgb((1.0, 1.0, 1.0)), "k": rgb(k) if texture is None else self._bitmap(k)}

    def _texture(self, colour: Colour | Texture) -> Any:
        if not isinstance(colour, Texture):
            return rgb(colour)
        if id(colour) not in self._textures:
            # rounded as on our device
            self._textures[id(colour)] = self._bitmap(colour.pixels.astype(np.float16))
        return self._textures[id(colour)]

    def _bitmap(self, pixels: np.ndarray) -> Any:
        bitmap = {"type": "bitmap", "bitmap": self.mi.Bitmap(pixels.astype(np.float32)), "raw": True}
        return self.mi.load_dict(bitmap | {"filter_type": "bilinear", "wrap_mode": "repeat"})


def _beckmann(roughness: float) -> float:
    """Beckmann's roughness for a Blinn exponent of 1 / roughness (Walter et al. 2007, sec. 5.2)."""
    return math.sqrt(2.0 / (1.0 / roughness + 2.0))


def _is_glass(shape: Shape) -> bool:
    return isinstance(shape.material, Dielectric)


def _sensor(mi: Any, scene: Scene, size: tuple[int, int]) -> dict[str, Any]:
    camera: Camera = scene.camera
    origin, target, up = (list(v) for v in (camera.position, camera.target, camera.up))
    low, high = scene.bounds()
    far = REACH * float(np.linalg.norm(np.maximum(np.abs(low - origin), np.abs(high - origin))))
    result = {
        "type": "perspective",
        "fov": camera.fov,
        "fov_axis": "y",
        "near_clip": NEAR * far,
        "far_clip": far,
        "to_world": mi.ScalarTransform4f().look_at(origin=origin, target=target, up=up),
        "sampler": {"type": "independent"},
        "film": {
            "type": "hdrfilm",
            "width": size[0],
            "height": size[1],
            "pixel_format": "rgb",
            "component_format": "float32",
            "rfilter": {"type": "box"},
        },
    }
    if camera.lens_radius > 0.0:
        distance = camera.focus_distance or float(np.linalg.norm(np.subtract(target, origin)))
        result |= {"type": "thinlens", "aperture_radius": camera.lens_radius, "focus_distance": distance}
        result["far_clip"] = max(far, REACH * distance)
    return result


def _light(mi: Any, light: Light, exact: bool) -> dict[str, Any]:
    if isinstance(light, Environment):
        return {"type": "constant", "radiance": rgb(light.radiance)}
    if isinstance(light, DistantLight):
        return {"type": "directional", "direction": list(light.direction), "irradiance": rgb(light.irradiance)}
    if isinstance(light, PointLight):
        return {"type": "point", "position": list(light.position), "intensity": rgb(light.intensity)}
    if not exact:
        target = np.add(light.position, light.direction).tolist()
        up = [0.0, 0.0, 1.0] if abs(light.direction[2]) < 0.9 else [1.0, 0.0, 0.0]
        return {
            "type": "spot",
            "to_world": mi.ScalarTransform4f().look_at(origin=list(light.position), target=target, up=up),
            "intensity": rgb(light.intensity),
            "beam_width": math.degrees(light.inner_angle),
            "cutoff_angle": math.degrees(light.outer_angle),
        }
    return {
        "type": SPOT,
        "position": mi.ScalarVector3f(light.position),
        "direction": mi.ScalarVector3f(light.direction),
        "intensity": rgb(light.intensity),
        "inner": light.inner_angle,
        "outer": light.outer_angle,
    }


def rgb(colour: Any) -> dict[str, Any]:
    """A colour as Mitsuba's dictionaries write it."""
    return {"type": "rgb", "value": [float(value) for value in colour]}
