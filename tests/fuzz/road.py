"""What a road is: one kind of file that is read, and how its damaged ones are judged."""

import dataclasses
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from .damage import (
    Damage,
)

N = 5


@dataclasses.dataclass(frozen=True)
class Road:
    """One way in."""

    name: str
    file: str
    """What the file is called."""
    whole: bytes
    read: Callable[[Path], Any]
    same: Callable[[Any, bytes], bool]
    """Whether a result is what the content says: that of the whole file, or what a plain parser finds there."""
    damages: Mapping[str, Damage]
    beside: Mapping[str, bytes] = dataclasses.field(default_factory=dict)
    """Whole files that must lie beside it."""
    cost: int = 1
    """How many times as long as others a case takes: so many times fewer are tried."""


def plain(value: Any) -> Any:
    """Arrays, dataclasses and tuples as what compares and prints."""
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        return {field.name: plain(getattr(value, field.name)) for field in dataclasses.fields(value)}
    if isinstance(value, dict):
        return {name: plain(one) for name, one in value.items()}
    if isinstance(value, list | tuple):
        return [plain(one) for one in value]
    return [str(value.dtype), value.shape, value.tobytes()] if isinstance(value, np.ndarray) else value


def as_whole(read: Callable[[Path], Any], expected: Any) -> dict[str, Any]:
    """The fields of a road whose result may only be that of the whole file."""
    wanted = plain(expected)
    return {"read": read, "same": lambda found, content: plain(found) == wanted}


DRAWN = np.random.default_rng(0)
POSITIONS = np.round(DRAWN.normal(scale=30, size=(N, 3)), 3)
TIMES = np.arange(N) * 0.5
DESCRIPTORS = DRAWN.normal(size=(N, 4)).astype(np.float32)
