"""Export of the loops of a recording as a folder of files for other programs."""

import dataclasses
from collections.abc import Callable, Mapping
from functools import partial
from pathlib import Path
from types import MappingProxyType

import numpy as np
from jaxtyping import Float, Int

from sglpr_jax.data.warning import warn
from sglpr_jax.files import text_bytes, write_all
from sglpr_jax.loops.find import FoundLoops
from sglpr_jax.loops.loop import Loop
from sglpr_jax.loops.loop_files import (
    write_g2o,
    write_kitti,
    write_loops_csv,
    write_loops_jsonl,
    write_rejected_jsonl,
    write_tum,
)

GRAPH, LINES, TABLE = "loops.g2o", "loops.jsonl", "loops.csv"
REJECTED = "rejected.jsonl"
FRAMES = "frames.json"
"""Transforms between the frames of several recordings."""
TRAJECTORIES = ("trajectory.tum", "trajectory.kitti", "trajectory-optimized.tum", "trajectory-optimized.kitti")


def write_found(
    found: FoundLoops,
    folder: Path | str,
    *,
    optimized: Float[np.ndarray, "n 4 4"] | None = None,
    texts: Mapping[str, str] = MappingProxyType({}),
) -> list[Path]:
    """Write loops as g2o, JSON lines and csv, rejected pairs as JSON lines, and the trajectory if there is odometry.

    If a file cannot be written, all files of an earlier run stay as they were (`files.write_all`).
    Frames have the numbers of the whole recording (`Recording.numbers`), also if scans without a pose were left out.
    Trajectories are written as TUM and KITTI. Their times are those of the recording or, without times, the frame
    numbers. Trajectories of earlier runs that this call does not overwrite stay, and a warning names them.

    Arguments:
      found: Loops of a recording.
      folder: Output folder.
      optimized: Corrected pose of the LiDAR at each searched frame.
      texts: Further text files to write, by name.

    Returns:
      Paths of the written files.

    Raises:
      WriteError: If a file cannot be written.
    """
    folder = Path(folder)
    odometry = None if found.odometry is None else found.odometry[: found.frames]
    numbers = found.recording.numbers
    ids = dict(zip(numbers.tolist(), found.recording.ids, strict=True))
    loops = [_numbered(loop, numbers) for loop in found.loops]
    rejected = [dataclasses.replace(one, loop=_numbered(one.loop, numbers)) for one in found.rejected]
    files: dict[str, Callable[[Path], object]] = {
        GRAPH: lambda path: write_g2o(path, loops, odometry, drift=found.drift, numbers=numbers[: found.frames]),
        LINES: partial(write_loops_jsonl, loops=loops, ids=ids),
        TABLE: partial(write_loops_csv, loops=loops),
        REJECTED: partial(write_rejected_jsonl, rejected=rejected, ids=ids),
    }
    times = found.recording.times
    clock = numbers[: found.frames].astype(np.float64) if times is None else times[: found.frames]
    for stem, poses in (("trajectory", odometry), ("trajectory-optimized", optimized)):
        if poses is not None:
            files[f"{stem}.tum"] = partial(write_tum, poses=poses, times=clock)
            files[f"{stem}.kitti"] = partial(write_kitti, poses=poses)
    files |= {name: partial(Path.write_bytes, data=text_bytes(text)) for name, text in texts.items()}
    written = write_all(folder, files)
    warn_of_others(folder, files)
    return written


def warn_of_others(folder: Path, files: Mapping[str, object]) -> None:
    """Warn if a folder has trajectories or transforms of an earlier run, which are not among the written `files`."""
    there = sorted({path.name for path in folder.glob("trajectory-*.*")} - set(TRAJECTORIES))
    others = [name for name in (*TRAJECTORIES, *there, FRAMES) if name not in files and (folder / name).exists()]
    if others:
        warn(f"{folder}: {', '.join(others)} are from an earlier run and do not belong to these loops")


def _numbered(loop: Loop, numbers: Int[np.ndarray, " n"]) -> Loop:
    """The loop, with the numbers of its frames instead of their rows."""
    return dataclasses.replace(loop, query=int(numbers[loop.query]), match=int(numbers[loop.match]))
