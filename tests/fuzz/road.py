"""What a road is: one kind of file that is read, and how its damaged ones are judged."""

import dataclasses
from collections.abc import Callable, Mapping
from pathlib import Path
from random import Random
from typing import Any, NamedTuple

import numpy as np

from .damage import BYTES, Damage, Damaged

N = 5


class Case(NamedTuple):
    """A damaged file among others that are whole."""

    kind: str
    """Name of the damage."""
    file: str
    damaged: Damaged
    beside: Mapping[str, bytes]


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
    written: str = ""
    """Pattern of the files that reading may write, relative to the folder."""
    slow: bool = False
    """Whether the first case takes long, because programs are compiled."""

    def intact(self) -> Case:
        """The case of the whole file."""
        return Case("none", self.file, Damaged(self.whole, "same"), self.beside)

    def case(self, draw: Random) -> Case:
        """A damaged file."""
        kind = draw.choice(sorted(self.damages))
        return Case(kind, self.file, self.damages[kind](self.whole, draw), self.beside)

    def opened(self, case: Case) -> str:
        """What is read: a file or folder, relative to the folder of the case."""
        return case.file

    def says(self, found: Any, case: Case) -> bool:
        """Whether a result is what the files of the case say."""
        return self.same(found, case.damaged.content)


@dataclasses.dataclass(frozen=True)
class FolderRoad:
    """One way in that reads a folder, of which any file may be damaged."""

    name: str
    folder: str
    """What the folder is called."""
    files: Callable[[], Mapping[str, bytes]]
    """Whole files by their path in the folder. They are made once, when they are needed."""
    read: Callable[[Path], Any]
    same: Callable[[Any, Mapping[str, bytes]], bool]
    """Whether a result is what the files say."""
    damages: Callable[[str], Mapping[str, Damage]] = lambda file: BYTES
    """Damages of a file, by its path."""
    cost: int = 1
    written: str = ""
    slow: bool = False

    def intact(self) -> Case:
        """The case of whole files."""
        (file, content), *_ = self._files().items()
        return Case("none", file, Damaged(content, "same"), self._files())

    def case(self, draw: Random) -> Case:
        """A damaged file among whole ones."""
        files = self._files()
        file = draw.choice(sorted(files))
        damages = self.damages(file)
        kind = draw.choice(sorted(damages))
        return Case(kind, file, damages[kind](files[file], draw), files)

    def opened(self, case: Case) -> str:
        """What is read."""
        return self.folder

    def says(self, found: Any, case: Case) -> bool:
        """Whether a result is what the files of the case say."""
        files = {**case.beside, case.file: case.damaged.content}
        return self.same(found, {file.removeprefix(f"{self.folder}/"): content for file, content in files.items()})

    def _files(self) -> dict[str, bytes]:
        return {f"{self.folder}/{file}": content for file, content in self.files().items()}


def plain(value: Any) -> Any:
    """Arrays, dataclasses and tuples as what compares and prints."""
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        return {field.name: plain(getattr(value, field.name)) for field in dataclasses.fields(value)}
    if isinstance(value, dict):
        return {name: plain(one) for name, one in value.items()}
    if isinstance(value, list | tuple):
        return [plain(one) for one in value]
    return [str(value.dtype), value.shape, np.asarray(value).tobytes()] if hasattr(value, "dtype") else value


def as_whole(read: Callable[[Path], Any], expected: Any) -> dict[str, Any]:
    """The fields of a road whose result may only be that of the whole file."""
    wanted = plain(expected)
    return {"read": read, "same": lambda found, content: plain(found) == wanted}


DRAWN = np.random.default_rng(0)
POSITIONS = np.round(DRAWN.normal(scale=30, size=(N, 3)), 3)
TIMES = np.arange(N) * 0.5
DESCRIPTORS = DRAWN.normal(size=(N, 4)).astype(np.float32)
