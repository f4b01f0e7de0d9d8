"""Export of the loops of a recording as a folder of files for other programs."""

import dataclasses
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from pathlib import Path
from types import MappingProxyType
from typing import Any

import numpy as np
from jaxtyping import Float, Int

from sglpr_jax.data.warning import warn
from sglpr_jax.files import file_name, text_bytes, write_all, write_json
from sglpr_jax.loops.closure import Loop
from sglpr_jax.loops.search import FoundLoops
from sglpr_jax.loops.search_between import AlignedParts, FoundBetween, FoundRecordings, Part
from sglpr_jax.pose_graph.files import (
    write_g2o,
    write_joint_g2o,
    write_kitti,
    write_loops_csv,
    write_loops_jsonl,
    write_rejected_jsonl,
    write_tum,
)
from sglpr_jax.pose_graph.optimize import OptimizedRecordings, placements

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


FIRST_VERTEX = 1_000_000
"""Number of the first vertex of the second recording, at least. The third one begins at twice this number."""


def unique_names(found: FoundRecordings) -> list[str]:
    """Names of the recordings. A repeated name gets the suffix ~2, ~3 and so on."""
    names: list[str] = []
    for one in found.recordings:
        name, number = one.recording.name, 2
        while name in names:
            name, number = f"{one.recording.name}~{number}", number + 1
        names.append(name)
    return names


def vertices(found: FoundRecordings) -> list[Int[np.ndarray, " _"]]:
    """Vertex of each scan in the graph: the scan's number plus a multiple of `FIRST_VERTEX`, the same for a recording.

    If a recording has more scans, the multiple is of the next power of ten.
    """
    numbers = [one.recording.numbers for one in found.recordings]
    most = max(int(rows.max(initial=0)) for rows in numbers)
    step = FIRST_VERTEX
    while step <= most:
        step *= 10
    return [rows + k * step for k, rows in enumerate(numbers)]


def write_several(
    found: FoundRecordings,
    folder: Path | str,
    *,
    optimized: OptimizedRecordings | None = None,
    texts: Mapping[str, str] = MappingProxyType({}),
) -> list[Path]:
    """Write the loops of all recordings to one graph and one table, and the transforms between the recordings.

    Queries and matches are vertices of the graph (`vertices`). If a file cannot be written, all files of an earlier run
    stay as they were. With odometry, each recording has trajectory files. Vertices and corrected trajectories
    of recordings with a common place are in the frame of the first of these recordings.

    Arguments:
      found: Loops within and between the recordings.
      folder: Output folder.
      optimized: Corrected trajectories.
      texts: Further text files to write, by name.

    Returns:
      Paths of the written files.

    Raises:
      WriteError: If a file cannot be written.
    """
    folder, names, of = Path(folder), unique_names(found), vertices(found)
    ids = {
        vertex: scan
        for rows, one in zip(of, found.recordings, strict=True)
        for vertex, scan in zip(rows.tolist(), one.recording.ids, strict=True)
    }
    recordings = {vertex: name for rows, name in zip(of, names, strict=True) for vertex in rows.tolist()}
    loops = [_moved(loop, of[query], of[match]) for query, match, one in _all(found) for loop in one.loops]
    rejected = [
        dataclasses.replace(other, loop=_moved(other.loop, of[query], of[match]))
        for query, match, one in _all(found)
        for other in one.rejected
    ]
    chains = [
        (rows[: one.frames], to_group @ one.odometry[: one.frames])
        for rows, one, (_, to_group) in zip(of, found.recordings, placements(found), strict=True)
        if one.odometry is not None
    ]
    files: dict[str, Callable[[Path], object]] = {
        GRAPH: lambda path: write_joint_g2o(
            path, loops, chains, drift=found.recordings[0].drift, comments=_comments(found, names, of)
        ),
        LINES: partial(write_loops_jsonl, loops=loops, ids=ids, recordings=recordings),
        TABLE: partial(write_loops_csv, loops=loops, recordings=recordings),
        REJECTED: partial(write_rejected_jsonl, rejected=rejected, ids=ids, recordings=recordings),
        FRAMES: partial(write_json, value=frames_json(found)),
    }
    files |= _trajectories(found, names, optimized)
    files |= {name: partial(Path.write_bytes, data=text_bytes(text)) for name, text in texts.items()}
    written = write_all(folder, files)
    warn_of_others(folder, files)
    return written


def frames_json(found: FoundRecordings) -> dict[str, Any]:
    """Recordings with their first vertices, and transforms between their frames, as a JSON value."""
    names, of = unique_names(found), vertices(found)
    recordings = [
        {"name": name, "scans": one.frames, "first_vertex": int(rows[0] - one.recording.numbers[0])}
        for name, rows, one in zip(names, of, found.recordings, strict=True)
    ]
    transforms = [_transform(names, one, aligned, found) for one in found.between for aligned in one.aligned]
    without = [[names[one.match], names[one.query]] for one in found.between if not one.aligned]
    return {"recordings": recordings, "transforms": transforms, "no_common_place": without}


def _transform(
    names: Sequence[str], one: FoundBetween, aligned: AlignedParts, found: FoundRecordings
) -> dict[str, Any]:
    """A transform between two frames as a JSON value."""
    match, query = (found.recordings[number].recording.numbers for number in (one.match, one.query))
    return {
        "match_recording": names[one.match],
        "query_recording": names[one.query],
        "match_frame": _frame(aligned.match, match),
        "query_frame": _frame(aligned.query, query),
        "match_from_query": aligned.alignment.match_from_query.tolist(),
        "covariance": aligned.alignment.covariance.tolist(),
        "loops": aligned.loops,
    }


def _frame(part: Part, numbers: Int[np.ndarray, " n"]) -> dict[str, Any]:
    """The frame of a part, and the scans whose poses are known in it."""
    first, last = int(numbers[part.first]), int(numbers[part.last])
    return {"frame": "odometry" if part.is_odometry else f"LiDAR at scan {first}", "first": first, "last": last}


def _all(found: FoundRecordings) -> list[tuple[int, int, Any]]:
    """Results with loops and rejected pairs, each with the recordings of its queries and of its matches."""
    within = [(number, number, one) for number, one in enumerate(found.recordings)]
    return within + [(one.query, one.match, one) for one in found.between]


def _moved(loop: Loop, queries: Int[np.ndarray, " n"], matches: Int[np.ndarray, " m"]) -> Loop:
    """The loop, with vertices instead of rows."""
    return dataclasses.replace(loop, query=int(queries[loop.query]), match=int(matches[loop.match]))


def _comments(found: FoundRecordings, names: Sequence[str], of: Sequence[Int[np.ndarray, " _"]]) -> list[str]:
    """Lines that state the vertices and the frame of each recording."""
    lines = []
    for name, rows, (group, _), one in zip(names, of, placements(found), found.recordings, strict=True):
        offset = int(rows[0] - one.recording.numbers[0])
        frame = f"; poses in the frame of {names[group]}" if one.odometry is not None else ""
        lines.append(f"{name}: vertex = {offset} + number of the scan{frame}")
    return lines


def _trajectories(
    found: FoundRecordings, names: Sequence[str], optimized: OptimizedRecordings | None
) -> dict[str, Callable[[Path], object]]:
    """Writers of the trajectories, by file name."""
    files: dict[str, Callable[[Path], object]] = {}
    for number, (name, one) in enumerate(zip(names, found.recordings, strict=True)):
        times, numbers = one.recording.times, one.recording.numbers[: one.frames]
        clock = numbers.astype(np.float64) if times is None else times[: one.frames]
        given = None if one.odometry is None else one.odometry[: one.frames]
        corrected = None if optimized is None else optimized.poses[number]
        for stem, poses in (("trajectory", given), ("trajectory-optimized", corrected)):
            if poses is not None:
                files |= _trajectory(f"{stem}-{file_name(name)}", poses, clock)
    return files


def _trajectory(
    stem: str, poses: Float[np.ndarray, "n 4 4"], clock: Float[np.ndarray, " n"]
) -> dict[str, Callable[[Path], object]]:
    """Writers of a trajectory as TUM and KITTI, by file name."""
    return {
        f"{stem}.tum": partial(write_tum, poses=poses, times=clock),
        f"{stem}.kitti": partial(write_kitti, poses=poses),
    }
