"""The chart as a picture: error against seconds, a panel a scene, a line a contender."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from warpgi.image import atomic_write

PICTURE = "chart.png"

# Okabe, Ito 2008: told apart with any kind of colour vision, and by their markers without.
COLOURS = ("#0072b2", "#d55e00", "#009e73", "#cc79a7", "#e69f00", "#56b4e9", "#000000", "#8c6d31", "#7f3c8d", "#888888")
MARKERS = "osD^vP*Xph<"  # one more than colours, so that no pair comes back soon
PANEL = (5.6, 4.4)  # inches


def style(index: int) -> tuple[str, str]:
    """Colour and marker of the contender with that number."""
    return COLOURS[index % len(COLOURS)], MARKERS[index % len(MARKERS)]


def draw(path: Path, results: dict[str, Any]) -> None:
    """Draws a results.json's content; both axes are logarithmic, the Pareto front is a grey band.

    Raises:
        ImportError: matplotlib is not installed.
        OSError: the file cannot be written.
    """
    try:
        import matplotlib
    except ImportError as error:
        raise ImportError("matplotlib is not installed: pip install -e '.[bench]'") from error
    from matplotlib.figure import Figure

    scenes = results["scenes"]
    with matplotlib.rc_context({"font.size": 9, "axes.spines.top": False, "axes.spines.right": False}):
        figure = Figure((PANEL[0] * len(scenes), PANEL[1]), layout="constrained")
        axes = figure.subplots(1, len(scenes), squeeze=False)[0]
        names = list(results["contenders"])
        for panel, (scene, content) in zip(axes, scenes.items(), strict=True):
            _panel(panel, scene, content, names)
        handles, labels = axes[0].get_legend_handles_labels()
        columns = 3 * len(scenes)  # so many names fit
        figure.legend(handles, labels, loc="outside lower center", ncols=columns, frameon=False)
        width, height = results["settings"]["size"]
        figure.suptitle(f"Indirect light, {width} x {height}, {results['device_name']}, {results['threads']} threads")
        with atomic_write(path) as temporary:
            figure.savefig(temporary, format="png", dpi=120)


def _panel(panel: Any, scene: str, content: dict[str, Any], names: list[str]) -> None:
    points = content["points"]
    front = [points[i] for i in content["front"]]
    panel.plot(
        [p["seconds"] for p in front], [p["relmse"] for p in front], color="#d9d9d9", lw=9, solid_capstyle="round",
        solid_joinstyle="round", zorder=0, label="Pareto front",
    )  # fmt: skip
    for index, name in enumerate(names):
        colour, marker = style(index)
        mine = [p for p in points if p["contender"] == name]
        line = [points[i] for i in content["lines"].get(name, [])]
        panel.plot([p["seconds"] for p in line], [p["relmse"] for p in line], color=colour, lw=1.4, zorder=2)
        for floored in (False, True):
            some = [p for p in mine if p["at_floor"] is floored]
            panel.scatter(
                [p["seconds"] for p in some], [p["relmse"] for p in some], s=26, marker=marker, zorder=3,
                facecolors="none" if floored else colour, edgecolors=colour, label=None if floored else name,
            )  # fmt: skip
    noise = content["reference"]["noise"]["relmse"]
    if any(p["at_floor"] for p in points):
        panel.axhline(noise, color="#999999", lw=0.8, ls=":", zorder=1)
        place = {"xycoords": ("axes fraction", "data"), "va": "bottom"}
        panel.annotate("noise of the reference", (0.01, noise), fontsize=7, color="#777777", **place)
    panel.set(xscale="log", yscale="log", title=scene, xlabel="seconds", ylabel="relMSE")
    for axis in (panel.xaxis, panel.yaxis):
        axis.set_major_formatter("{x:g}")
    panel.grid(which="major", color="#eeeeee", lw=0.8)
    panel.set_axisbelow(True)
