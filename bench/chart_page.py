"""The chart as one HTML page that needs nothing else: numbers, pictures and a viewer for them."""

from __future__ import annotations

import base64
import json
import zlib
from pathlib import Path

import numpy as np

from warpgi.image import atomic_write

RESULTS = "results.json"
STABILITY = "stability.json"
RUNS = "runs"
PAGE = "index.html"

PARTS = Path(__file__).parent / "page"
SCRIPTS = ("pictures.js", "chart.js", "viewer.js", "main.js")

# The last bits of a half float's mantissa that the page does without: what is left is within 2^-8 of a value, half a
# step of an 8-bit display, at any exposure.
DROPPED_BITS = 3
LARGEST = 65000.0  # below the largest half float by more than the rounding


def write_page(out: Path) -> None:
    """Writes index.html out of results.json, the runs and, if it is there, stability.json of a folder.

    Raises:
        OSError: a file cannot be read or written.
    """
    data = json.loads((out / RESULTS).read_text())
    stability = out / STABILITY
    data["stability"] = json.loads(stability.read_text()) if stability.exists() else None
    pictures: list[str] = []

    def embed(name: str) -> int:
        with np.load(out / RUNS / name) as file:
            pictures.append(encode_picture(file["indirect"]))
        return len(pictures) - 1

    for scene in data["scenes"].values():
        scene["width"], scene["height"] = data["settings"]["size"]
        scene["reference"]["picture"] = embed(scene["reference"]["file"])
        for point in scene["points"]:
            point["picture"] = embed(point["runs"][0])
    parts = {
        "STYLE": (PARTS / "style.css").read_text(),
        "SCRIPT": "\n".join((PARTS / name).read_text() for name in SCRIPTS),
        "PICTURES": "\n".join(
            f'<script type="text/plain" id="picture-{i}">{text}</script>' for i, text in enumerate(pictures)
        ),
        # a name with "</script>" in it would end the element
        "DATA": json.dumps(data, allow_nan=False).replace("<", "\\u003c"),
    }
    page = (PARTS / "page.html").read_text()
    head, *pieces = page.split("@")
    # names between signs, as @DATA@; what is put in is not searched for others
    for name, text in zip(pieces[0::2], pieces[1::2], strict=True):
        head += parts[name] + text
    with atomic_write(out / PAGE) as temporary:
        temporary.write_text(head, encoding="utf-8")


def encode_picture(image: np.ndarray) -> str:
    """Radiance, shape (H, W, 3), as text: half floats of 13 bits, by planes and bytes, deflated, in base 64.

    Colours are alike in their exponents, so that red and blue as differences to green take less. Values below 0, which
    no light has, and NaN become 0.
    """
    half = np.clip(np.nan_to_num(image, posinf=LARGEST), 0.0, LARGEST).astype(np.float16)
    bits = half.view(np.uint16).astype(np.int32)
    red, green, blue = np.moveaxis((bits + (1 << (DROPPED_BITS - 1))) >> DROPPED_BITS, -1, 0)
    planes = np.stack([red - green, green, blue - green]) % (1 << (16 - DROPPED_BITS))
    data = np.stack([planes >> 8, planes & 255]).astype(np.uint8).tobytes()
    return base64.b64encode(zlib.compress(data, 9)).decode()
