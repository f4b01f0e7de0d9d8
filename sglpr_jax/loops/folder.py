"""Export of the loops of a recording as a folder of files for other programs."""

import dataclasses
from pathlib import Path

import numpy as np
from jaxtyping import Float, Int

from sglpr_jax.data.warning import warn
from sglpr_jax.loops.find import FoundLoops
from sglpr_jax.loops.graph_files import (
    write_g2o,
    write_kitti,
    write_loops_csv,
    write_loops_jsonl,
    write_rejected_jsonl,
    write_tum,
)
from sglpr_jax.loops.loop import Loop

GRAPH, LINES, TABLE = "loops.g2o", "loops.jsonl", "loops.csv"
REJECTED = "rejected.jsonl"
TRAJECTORIES = ("trajectory.tum", "trajectory.kitti", "trajectory-optimized.tum", "trajectory-optimized.kitti")


def write_found(
    found: FoundLoops, folder: Path | str, *, optimized: Float[np.ndarray, "n 4 4"] | None = None
) -> list[Path]:
    """Write loops as g2o, JSON lines and csv, rejected pairs as JSON lines, and the trajectory if there is odometry.

    Frames have the numbers of the whole recording (`Recording.numbers`), also if scans without a pose were left out.
    Trajectories are written as TUM and KITTI. Their times are those of the recording or, without times, the frame
    numbers. Trajectories of earlier runs that this call does not overwrite stay, and a warning names them.

    Arguments:
      found: Loops of a recording.
      folder: Output folder.
      optimized: Corrected pose of the LiDAR at each searched frame.

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
    write_g2o(folder / GRAPH, loops, odometry, drift=found.drift, numbers=numbers[: found.frames])
    write_loops_jsonl(folder / LINES, loops, ids)
    write_loops_csv(folder / TABLE, loops)
    write_rejected_jsonl(folder / REJECTED, rejected, ids)
    names = [GRAPH, LINES, TABLE, REJECTED]
    times = found.recording.times
    clock = numbers[: found.frames].astype(np.float64) if times is None else times[: found.frames]
    for stem, poses in (("trajectory", odometry), ("trajectory-optimized", optimized)):
        if poses is not None:
            write_tum(folder / f"{stem}.tum", poses, clock)
            write_kitti(folder / f"{stem}.kitti", poses)
            names += [f"{stem}.tum", f"{stem}.kitti"]
    others = [name for name in TRAJECTORIES if name not in names and (folder / name).exists()]
    if others:
        warn(f"{folder}: {', '.join(others)} are from an earlier run and do not belong to these loops")
    return [folder / name for name in names]


def _numbered(loop: Loop, numbers: Int[np.ndarray, " n"]) -> Loop:
    """The loop, with the numbers of its frames instead of their rows."""
    return dataclasses.replace(loop, query=int(numbers[loop.query]), match=int(numbers[loop.match]))
