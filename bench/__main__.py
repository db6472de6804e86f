"""The command line of the bench."""

from __future__ import annotations

import sys
from pathlib import Path

import tyro

from bench import rays

MISUSE = 2  # exit status for a caller's mistake
INTERRUPTED = 130


def rays_command(
    device: str | None = None,
    scenes: tuple[str, ...] = ("cornell-box", "courtyard"),
    size: tuple[int, int] = (256, 256),
    spp: int = 16,
    repeats: int = 7,
    threads: int | None = None,
    peers: bool = False,
    json: Path | None = None,
) -> None:
    """Measure rays and paths per second, compile time, upload time and memory.

    Args:
        device: cpu, cuda, cuda:0, ...; a GPU if there is one.
        scenes: Built-in scenes.
        size: Width and height in pixels.
        spp: Paths per pixel; rays of each kind are width x height x spp too, up to a few millions.
        repeats: Times that everything is measured, in turn; the table shows medians.
        threads: CPU threads; all by default.
        peers: Measure Mitsuba 3 too, on the same pictures, and compare these.
        json: File for the measurements and what they were made with.
    """
    rays.run(rays.Settings(device, scenes, size, spp, repeats, threads, peers), json)


def main(arguments: list[str] | None = None) -> int:
    """Runs one command and returns its exit status: 0, or 2 for a caller's mistake, or 130 after Ctrl-C."""
    app = tyro.extras.SubcommandApp()
    app.command(rays_command, name="rays")
    try:
        app.cli(prog="python -m bench", args=arguments, config=(tyro.conf.FlagCreatePairsOff,))
    except KeyboardInterrupt:
        print("bench: interrupted", file=sys.stderr)
        return INTERRUPTED
    except (ValueError, TypeError, OSError) as error:
        print(f"bench: error: {error}", file=sys.stderr)
        return MISUSE
    return 0


if __name__ == "__main__":
    sys.exit(main())
