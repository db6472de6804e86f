"""Built-in scenes, in metres with y up; those whose light is known also say what it is."""

from __future__ import annotations

import difflib
import inspect
from collections.abc import Callable
from typing import Any

from warpgi.scene import Scene
from warpgi.scenes.butterflies import butterflies
from warpgi.scenes.caustic import caustic
from warpgi.scenes.cornell import cornell_box, cornell_spheres
from warpgi.scenes.courtyard import courtyard
from warpgi.scenes.moving_ball import moving_ball
from warpgi.scenes.moving_car import moving_car
from warpgi.scenes.moving_light import moving_light
from warpgi.scenes.rooms import Expected, furnace, integrating_sphere, leak, room
from warpgi.scenes.statuettes import statuettes
from warpgi.sequence import Sequence

#: Name on the command line -> function. Some return a Scene, some (Scene, Expected).
SCENES: dict[str, Callable[..., Any]] = {
    "cornell-box": cornell_box,
    "cornell-spheres": cornell_spheres,
    "furnace": furnace,
    "integrating-sphere": integrating_sphere,
    "room": room,
    "statuettes": statuettes,
    "courtyard": courtyard,
    "caustic": caustic,
    "leak": leak,
    "butterflies": butterflies,
}

#: Name on the command line -> function that returns a Sequence.
SEQUENCES: dict[str, Callable[..., Sequence]] = {
    "moving-light": moving_light,
    "moving-ball": moving_ball,
    "moving-car": moving_car,
}

__all__ = [
    "SCENES",
    "SEQUENCES",
    "Expected",
    "build",
    "build_sequence",
    "butterflies",
    "caustic",
    "cornell_box",
    "cornell_spheres",
    "courtyard",
    "furnace",
    "integrating_sphere",
    "leak",
    "moving_ball",
    "moving_car",
    "moving_light",
    "room",
    "statuettes",
]


def build(name: str, **parameters: Any) -> Scene:
    """A built-in scene by its name.

    Args:
        name: one of `SCENES`.
        parameters: keyword parameters of its function.

    Returns:
        The scene alone; call the function itself for what is known of its light.

    Raises:
        ValueError: there is no such scene or parameter, or a parameter's type or value is not one it takes.

    Example:
        >>> import warpgi as gi
        >>> gi.scenes.build("courtyard", detail=0.05).name
        'courtyard'
    """
    built = _call("scene", SCENES, name, parameters)
    return built[0] if isinstance(built, tuple) else built


def build_sequence(name: str, **parameters: Any) -> Sequence:
    """A built-in sequence by its name.

    Args:
        name: one of `SEQUENCES`.
        parameters: keyword parameters of its function.

    Raises:
        ValueError: there is no such sequence or parameter, or a parameter's type or value is not one it takes.

    Example:
        >>> import warpgi as gi
        >>> gi.scenes.build_sequence("moving-light", frames=10).frames
        10
    """
    return _call("sequence", SEQUENCES, name, parameters)


def _call(kind: str, table: dict[str, Callable[..., Any]], name: str, parameters: dict[str, Any]) -> Any:
    if name not in table:
        raise ValueError(f"{kind} {name!r} is unknown{_closest(name, table)}, expected one of {', '.join(table)}")
    known = inspect.signature(table[name]).parameters
    for parameter in parameters:
        if parameter not in known:
            want = ", ".join(known)
            raise ValueError(
                f"{kind} {name} has no parameter {parameter!r}{_closest(parameter, known)}, expected {want}"
            )
    for parameter, value in parameters.items():
        # A flag given as "no" or 0 would pass for true or false without a word.
        if isinstance(known[parameter].default, bool) and not isinstance(value, bool):
            raise ValueError(f"{kind} {name}: {parameter} is {value!r}, expected True or False")
    try:
        return table[name](**parameters)
    except TypeError as error:
        raise ValueError(f"{kind} {name}: {error}") from error


def _closest(word: str, known: Any) -> str:
    close = difflib.get_close_matches(str(word), list(known), n=1)
    return f", did you mean {close[0]!r}" if close else ""
