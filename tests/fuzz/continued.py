"""What a command finds of an earlier run: a stopped search, checkpoints of a training, descriptors of a stress test."""

import functools
import tempfile
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import jax
import numpy as np
from loops.kept import WANTED, keep, recalled
from recordings import of_scans

from sglpr_jax.data.corruption import CLEAN
from sglpr_jax.loops.checkpoint import ENDING
from sglpr_jax.methods.method import ScanMethod
from sglpr_jax.retrieval.descriptor_file import DescriptorFile
from sglpr_jax.retrieval.reuse import SETTINGS, _settings, embed_or_reuse
from sglpr_jax.training.checkpoint import Checkpoints
from sglpr_jax.training.state import TrainState, new_state

from .archives import ABOUT, ARRAYS, IDS, NPZ, change_about, double_id
from .damage import BYTES, Damage
from .places import SAFE, another_array, either, written
from .road import DESCRIPTORS, POSITIONS, TIMES, FolderRoad, N, Road, plain
from .run_files import RUN, change_value


def files_of(write: Callable[[Path], Any]) -> Callable[[], Mapping[str, bytes]]:
    """The files that a function writes into a folder, which is done once."""

    @functools.cache
    def made() -> Mapping[str, bytes]:
        with tempfile.TemporaryDirectory() as folder:
            write(Path(folder))
            paths = [path for path in sorted(Path(folder).rglob("*")) if path.is_file()]
            return {path.relative_to(folder).as_posix(): path.read_bytes() for path in paths}

    return made


def stop_twice(folder: Path) -> None:
    """A search that was stopped after five frames, and after ten."""
    keep(folder, WANTED, stops=(5, 10))


def frames_of(folder: Path) -> Any:
    return [plain(jax.tree.map(np.asarray, frame)) for frame in recalled(folder, WANTED)]


UNFINISHED = files_of(stop_twice)


@functools.cache
def frames() -> Any:
    """The frames of the whole folder."""
    with tempfile.TemporaryDirectory() as folder:
        stop_twice(Path(folder))
        return frames_of(Path(folder))


def unfinished_damages(file: str) -> Mapping[str, Damage]:
    """Damages of a file of frames, or of the settings. Frames of a damaged file are found again."""
    return {**SAFE, "array": either(another_array)} if file.endswith(ENDING) else {**BYTES, "value": change_value}


def save_twice(folder: Path) -> None:
    """Two checkpoints of a training."""
    kept = Checkpoints(folder)
    for step in (17, 18):
        kept.save(state_of(step), score=0.5)
    kept.close()


@functools.cache
def state_of(step: int) -> TrainState:
    shapes = jax.eval_shape(lambda: new_state(RUN))
    full = jax.tree.map(lambda leaf: np.full(leaf.shape, step, leaf.dtype), shapes)
    return full.replace(step=np.int32(step))


def resume(folder: Path) -> Any:
    kept = Checkpoints(folder)
    try:
        return leaves_of(kept.restore(RUN))
    finally:
        kept.close()


def leaves_of(state: TrainState) -> Any:
    return [plain(np.asarray(leaf)) for leaf in jax.tree.leaves(state)]


DRIVE = of_scans({Path(f"{name}.bin"): np.zeros((1, 3), np.float32) for name in IDS}, positions=POSITIONS, times=TIMES)
METHOD = ScanMethod(lambda points, labels: DESCRIPTORS[0], labels=False, distance="l2", about={"method": "m"})
MADE_WITH = _settings(METHOD, DRIVE, CLEAN, 0)


def described() -> DescriptorFile:
    """Descriptors that a stress test may use again."""
    about = {**ABOUT, "config": {"method": "m", SETTINGS: MADE_WITH}}
    del about["format"]
    return DescriptorFile(**{**about, **ARRAYS, "ids": IDS})


def reused(path: Path) -> DescriptorFile:
    return embed_or_reuse(path, METHOD, DRIVE, CLEAN, seed=0, batch=N)


def same_reused(found: DescriptorFile, content: bytes) -> bool:
    """The arrays are those of the whole file, which was made with the same settings."""
    arrays = {**{name: getattr(found, name) for name in ARRAYS}, "ids": np.array(found.ids)}
    return plain(arrays) == plain(ARRAYS) and found.config[SETTINGS] == MADE_WITH


ROADS = (
    FolderRoad(
        "unfinished",
        "unfinished",
        UNFINISHED,
        frames_of,
        same=lambda found, files: found in (frames()[:0], frames()[:5], frames()),
        damages=unfinished_damages,
    ),
    FolderRoad(
        "checkpoints",
        "checkpoints",
        files_of(save_twice),
        resume,
        same=lambda found, files: found in (leaves_of(state_of(17)), leaves_of(state_of(18))),
        written="checkpoints/(damaged-1|outdated)",
        cost=20,
    ),
    Road(
        "stress test",
        "clean-m.npz",
        written(described().save, "clean-m.npz"),
        reused,
        same_reused,
        {**NPZ, "about": change_about, "double id": double_id},
    ),
)
