"""Three metal statuettes of decreasing gloss on a glossy ground: the set-up of LALD12's MONKEY HEADS (fig. 9)."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import trimesh

from warpgi import checks
from warpgi.camera import Camera
from warpgi.lights import DistantLight, Environment, Light
from warpgi.materials import Conductor
from warpgi.scene import Scene
from warpgi.scenes.figure import hare
from warpgi.scenes.primitives import Mesh, merge, quad, vertex_normals

ROUGHNESS = (0.01, 0.05, 0.25)  # of the statuettes, left to right (LALD12, footnote 2)
GROUND_ROUGHNESS = 0.01
COLOURS = ((0.93, 0.89, 0.83), (0.94, 0.68, 0.38), (0.93, 0.56, 0.45))  # silver, bronze, copper
HEIGHT, WIDTH = 1.3, 1.0  # what a statuette fits into [m]
SUNK = 0.004  # how deep a statuette stands in the ground, so that no two surfaces lie in one plane [m]

Figure = str | Path | tuple[Any, Any] | None


def statuettes(figure: Figure = None, resolution: int = 64, sky: float = 0.0) -> Scene:
    """Three copies of a figure, roughness 0.01, 0.05 and 0.25, on a ground of roughness 0.01 under parallel light.

    All materials are metals with the Blinn distribution, so what is not lit straight towards the camera is seen by
    the light of its neighbours: the paper's picture shows the one-bounce indirect light alone.

    Args:
        figure: a mesh file, or its (vertices, faces), looking along +z with y up; None is a hare made in code. It
            is scaled to fit 1.3 m of height and 1 m of width, and stood on the ground.
        resolution: of the hare, cells over its height, 16 to 256; about 4 resolution^2 triangles each.
        sky: radiance from all around, W/(sr m^2); the paper has none.
    """
    checks.number("sky", sky, 0.0)
    mesh = hare(checks.count("resolution", resolution, 16, 256)) if figure is None else _given(figure)
    low, high = mesh.vertices.min(axis=0), mesh.vertices.max(axis=0)
    foot = [0.5 * (low[0] + high[0]), low[1], 0.5 * (low[2] + high[2])]
    mesh = mesh._replace(vertices=(mesh.vertices - foot) * min(HEIGHT / (high[1] - low[1]), WIDTH / (high[0] - low[0])))

    ground = quad((-25, 0, 25), (50, 0, 0), (0, 0, -50))
    shapes = [ground.shape(Conductor(GROUND_ROUGHNESS, (0.62, 0.64, 0.68)), "ground")]
    places = zip(ROUGHNESS, COLOURS, (-1.05, 0.0, 1.05), (0.5, 0.15, -0.35), (-0.15, 0.15, -0.15), strict=True)
    for roughness, colour, x, angle, z in places:
        shape = mesh.turn(angle).move((x, -SUNK, z)).shape(Conductor(roughness, colour), f"statuette {roughness:g}")
        shapes.append(shape)
    lights: list[Light] = [DistantLight((0.55, -0.75, -0.55), (9.0, 8.6, 8.0))]
    if sky > 0.0:
        lights.append(Environment((0.85 * sky, 0.95 * sky, 1.1 * sky)))
    camera = Camera((0.0, 2.45, 5.5), (0.0, 0.5, 0.0), fov=30.0)
    return Scene(shapes, camera, lights, name="statuettes")


def _given(figure: Any) -> Mesh:
    if isinstance(figure, (str, Path)):
        from warpgi.load import load_scene  # late: only this parameter needs the loader

        shapes = load_scene(figure).shapes
        meshes = [(shape.vertices, shape.faces) for shape in shapes]
    else:
        try:
            vertices, faces = figure
        except (TypeError, ValueError) as error:
            raise TypeError(f"figure is {type(figure).__name__}, expected a file or (vertices, faces)") from error
        vertices = checks.finite_array("figure vertices", vertices, (None, 3))
        meshes = [(vertices, checks.finite_array("figure faces", faces, (None, 3), np.int64))]
    return merge(_smooth(*mesh) for mesh in meshes)


def _smooth(vertices: np.ndarray, faces: np.ndarray) -> Mesh:
    """A mesh with shading normals: those of the faces about a vertex, weighted by area."""
    welded = trimesh.Trimesh(vertices, faces, process=True)  # files split vertices along seams
    vertices, faces = np.asarray(welded.vertices), np.asarray(welded.faces)
    return Mesh(vertices, faces, vertex_normals(vertices, faces), np.zeros((len(vertices), 2)))
