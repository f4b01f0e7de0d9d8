"""Export of the loops of a search as a folder of files for other programs."""

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
from sglpr_jax.loops.closure import LoopClosure, RejectedClosure, renumbered
from sglpr_jax.loops.frame_alignment import SegmentAlignment, TrajectorySegment
from sglpr_jax.loops.result import LoopSearchResult
from sglpr_jax.odometry.config import DriftModel
from sglpr_jax.pose_graph.files import (
    Ids,
    write_g2o,
    write_kitti,
    write_loops_csv,
    write_loops_jsonl,
    write_rejected_jsonl,
    write_tum,
)
from sglpr_jax.pose_graph.optimize import OptimizedTrajectory, placements

GRAPH, LINES, TABLE = "loops.g2o", "loops.jsonl", "loops.csv"
REJECTED = "rejected.jsonl"
FRAMES = "frames.json"
"""Transforms between the frames of several sessions."""
TRAJECTORIES = ("trajectory.tum", "trajectory.kitti", "trajectory-optimized.tum", "trajectory-optimized.kitti")
FIRST_VERTEX = 1_000_000
"""Number of the first vertex of the second session, at least. The third one begins at twice this number."""


def write_found(
    found: LoopSearchResult,
    folder: Path | str,
    *,
    optimized: OptimizedTrajectory | None = None,
    texts: Mapping[str, str] = MappingProxyType({}),
) -> list[Path]:
    """Write loops as g2o, JSON lines and csv, rejected pairs as JSON lines, and trajectories if there is odometry.

    If a file cannot be written, all files of an earlier run stay as they were (`files.write_all`).
    Frames have the numbers of the whole recording (`Recording.numbers`), also if scans without a pose were left out.
    Trajectories are written as TUM and KITTI. Their times are those of the recording or, without times, the frame
    numbers. Trajectories of earlier runs that this call does not overwrite stay, and a warning names them.

    Several sessions share one graph and one table, whose frames are vertices (`vertices`). Names of recordings are
    added, and the transforms between their frames are written. Vertices and corrected trajectories of sessions with a
    common place are in the frame of the first of these sessions.

    Arguments:
      found: Loops within and between sessions.
      folder: Output folder.
      optimized: Corrected trajectories.
      texts: Further text files to write, by name.

    Returns:
      Paths of the written files.

    Raises:
      WriteError: If a file cannot be written.
    """
    folder, names, of = Path(folder), unique_names(found), vertices(found)
    each = list(zip(of, names, found.sessions, strict=True))
    ids = {vertex: scan for rows, _, one in each for vertex, scan in zip(rows.tolist(), one.recording.ids, strict=True)}
    recordings = {vertex: name for rows, name, _ in each for vertex in rows.tolist()} if len(each) > 1 else None
    loops = [renumbered(loop, of) for loop in found.loops]
    rejected = [dataclasses.replace(one, loop=renumbered(one.loop, of)) for one in found.rejected]
    chains = [
        (rows[: one.frames], to_group @ one.odometry[: one.frames])
        for (rows, _, one), (_, to_group) in zip(each, placements(found), strict=True)
        if one.odometry is not None
    ]
    comments, drift = _comments(found, names, of), found.sessions[0].drift
    files = graph_files(loops, rejected, chains, drift=drift, comments=comments, ids=ids, recordings=recordings)
    files[LINES] = partial(write_loops_jsonl, loops=loops, ids=ids, recordings=recordings)
    if recordings is not None:
        files[FRAMES] = partial(write_json, value=frames_json(found))
    files |= _trajectories(found, names, optimized)
    files |= {name: partial(Path.write_bytes, data=text_bytes(text)) for name, text in texts.items()}
    written = write_all(folder, files)
    _warn_of_others(folder, files)
    return written


def graph_files(
    loops: Sequence[LoopClosure],
    rejected: Sequence[RejectedClosure],
    chains: Sequence[tuple[Int[np.ndarray, " _"], Float[np.ndarray, "_ 4 4"]]],
    *,
    drift: DriftModel,
    comments: Sequence[str] = (),
    ids: Ids | None = None,
    recordings: Ids | None = None,
) -> dict[str, Callable[[Path], object]]:
    """Writers of the graph, the table and the rejected pairs, by file name. See `write_g2o` for the arguments."""
    return {
        GRAPH: partial(write_g2o, loops=loops, chains=chains, drift=drift, comments=comments),
        TABLE: partial(write_loops_csv, loops=loops, recordings=recordings),
        REJECTED: partial(write_rejected_jsonl, rejected=rejected, ids=ids, recordings=recordings),
    }


def unique_names(found: LoopSearchResult) -> list[str]:
    """Names of the recordings. A repeated name gets the suffix ~2, ~3 and so on."""
    names: list[str] = []
    for one in found.sessions:
        name, number = one.recording.name, 2
        while name in names:
            name, number = f"{one.recording.name}~{number}", number + 1
        names.append(name)
    return names


def vertices(found: LoopSearchResult) -> list[Int[np.ndarray, " _"]]:
    """Vertex of each scan in the graph: the scan's number plus a multiple of `FIRST_VERTEX`, the same for a session.

    If a recording has more scans, the multiple is of the next power of ten.
    """
    numbers = [one.recording.numbers for one in found.sessions]
    most = max(int(rows.max(initial=0)) for rows in numbers)
    step = FIRST_VERTEX
    while step <= most:
        step *= 10
    return [rows + k * step for k, rows in enumerate(numbers)]


def frames_json(found: LoopSearchResult) -> dict[str, Any]:
    """Recordings with their first vertices, and transforms between their frames, as a JSON value."""
    names, of = unique_names(found), vertices(found)
    recordings = [
        {"name": name, "scans": one.frames, "first_vertex": int(rows[0] - one.recording.numbers[0])}
        for name, rows, one in zip(names, of, found.sessions, strict=True)
    ]
    without = [
        [names[match], names[query]] for match, query in found.pairs if not found.between(match, query).transforms
    ]
    transforms = [_transform(names, aligned, found) for aligned in found.transforms]
    return {"recordings": recordings, "transforms": transforms, "no_common_place": without}


def _transform(names: Sequence[str], aligned: SegmentAlignment, found: LoopSearchResult) -> dict[str, Any]:
    """A transform between two frames as a JSON value."""
    return {
        "match_recording": names[aligned.match.session],
        "query_recording": names[aligned.query.session],
        "match_frame": _frame(aligned.match, found),
        "query_frame": _frame(aligned.query, found),
        "match_from_query": aligned.match_from_query.tolist(),
        "covariance": aligned.covariance.tolist(),
        "loops": aligned.loops,
    }


def _frame(part: TrajectorySegment, found: LoopSearchResult) -> dict[str, Any]:
    """The frame of a part, and the scans whose poses are known in it."""
    numbers = found.sessions[part.session].recording.numbers
    first, last = int(numbers[part.first]), int(numbers[part.last])
    return {"frame": "odometry" if part.is_odometry else f"LiDAR at scan {first}", "first": first, "last": last}


def _comments(found: LoopSearchResult, names: Sequence[str], of: Sequence[Int[np.ndarray, " _"]]) -> list[str]:
    """Lines that state the vertices and the frame of each of several sessions."""
    lines = []
    for name, rows, (group, _), one in zip(names, of, placements(found), found.sessions, strict=True):
        offset = int(rows[0] - one.recording.numbers[0])
        frame = f"; poses in the frame of {names[group]}" if one.odometry is not None else ""
        lines.append(f"{name}: vertex = {offset} + number of the scan{frame}")
    return lines if len(names) > 1 else []


def _trajectories(
    found: LoopSearchResult, names: Sequence[str], optimized: OptimizedTrajectory | None
) -> dict[str, Callable[[Path], object]]:
    """Writers of the trajectories, by file name. Names of several sessions are part of it."""
    files: dict[str, Callable[[Path], object]] = {}
    corrected = [None] * len(names) if optimized is None else found.split(optimized.poses)
    for name, one, poses in zip(names, found.sessions, corrected, strict=True):
        times, numbers = one.recording.times, one.recording.numbers[: one.frames]
        clock = numbers.astype(np.float64) if times is None else times[: one.frames]
        given = None if one.odometry is None else one.odometry[: one.frames]
        suffix = f"-{file_name(name)}" if len(names) > 1 else ""
        for stem, some in ((f"trajectory{suffix}", given), (f"trajectory-optimized{suffix}", poses)):
            if some is not None:
                files[f"{stem}.tum"] = partial(write_tum, poses=some, times=clock)
                files[f"{stem}.kitti"] = partial(write_kitti, poses=some)
    return files


def _warn_of_others(folder: Path, files: Mapping[str, object]) -> None:
    """Warn if a folder has trajectories or transforms of an earlier run, which are not among the written `files`."""
    there = sorted({path.name for path in folder.glob("trajectory-*.*")} - set(TRAJECTORIES))
    others = [name for name in (*TRAJECTORIES, *there, FRAMES) if name not in files and (folder / name).exists()]
    if others:
        warn(f"{folder}: {', '.join(others)} are from an earlier run and do not belong to these loops")
