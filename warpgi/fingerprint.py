"""Digests of what a picture depends on, so that a file can say whether it is the one that is wanted."""

from __future__ import annotations

import dataclasses
import hashlib
from collections.abc import Mapping
from enum import Enum
from typing import Any

import numpy as np


def fingerprint(*values: Any) -> str:
    """SHA-256 of numbers, texts, arrays, enums, dataclasses, and sequences and mappings of these.

    Values that print alike but are not, such as 1 and 1.0, differ; arrays differ by type and shape too.

    Example:
        >>> fingerprint(1, "a") == fingerprint(1, "a"), fingerprint(1) == fingerprint(1.0)
        (True, False)
    """
    digest = hashlib.sha256()
    _feed(digest, values)
    return digest.hexdigest()


def _feed(digest: Any, value: Any) -> None:
    if isinstance(value, np.ndarray):
        digest.update(f"{value.dtype.str}{value.shape}".encode())
        digest.update(np.ascontiguousarray(value))
    elif hasattr(value, "fingerprint"):
        digest.update(value.fingerprint.encode())  # kept by what does not change
    elif dataclasses.is_dataclass(value):
        digest.update(f"{type(value).__name__}(".encode())
        for field in dataclasses.fields(value):
            digest.update(field.name.encode())
            _feed(digest, getattr(value, field.name))
    elif isinstance(value, Mapping):
        _feed(digest, list(value.items()))
    elif isinstance(value, (list, tuple)):
        digest.update(f"[{len(value)}".encode())
        for item in value:
            _feed(digest, item)
    else:
        digest.update(f"{value.value if isinstance(value, Enum) else value!r};".encode())
