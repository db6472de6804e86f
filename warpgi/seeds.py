"""Seeds of frames."""

from __future__ import annotations

import hashlib


def frame_seed(seed: int, frame: int) -> int:
    """The seed of one frame, 0 to 2^31 - 1: a hash, so that neighbouring frames and seeds share nothing."""
    return int.from_bytes(hashlib.sha256(f"{seed} {frame}".encode()).digest()[:4], "little") >> 1
