"""Export of the loops of a search as a folder of files for other programs."""

import dataclasses
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from pathlib import Path
from types import MappingProxyType
from typing import Any

import numpy as np
from jaxtyping import Float, Int

from sglpr_jax.files import file_name, text_bytes, warn, write_all, write_json
from sglpr_jax.loops.closure import LoopClosure, RejectedClosure, renumbered
from sglpr_jax.loops.frame_alignment import TrajectorySegment
from sglpr_jax.loops.result import LoopSearchResult
from sglpr_jax.odometry.drift_model import DriftModel
from sglpr_jax.pose_graph.files import Ids, write_g2o, write_kitti, write_loops_csv, write_loops_jsonl, write_tum
from sglpr_jax.pose_graph.optimize import OptimizedTrajectory, placements

GRAPH, LINES, TABLE = "loops.g2o", "loops.jsonl", "loops.csv"
REJECTED = "rejected.jsonl"
FRAMES = "frames.json"
"""Transforms between the frames of several sessions."""
TRAJECTORIES = ("trajectory.tum", "trajectory.kitti", "trajectory-optimized.tum", "trajectory-optimized.kitti")
FIRST_VERTEX = 1_000_000
"""Number of the first vertex of the second session, at least. The third one begins at twice this number."""
Writers = dict[str, Callable[[Path], object]]
"""Function that writes a file to a path, by file name (`files.write_all`)."""


def write_found(
    result: LoopSearchResult,
    folder: Path | str,
    *,
    optimized: OptimizedTrajectory | None = None,
    texts: Mapping[str, str] = MappingProxyType({}),
) -> list[Path]:
    """Write loops as g2o, JSON lines and csv, rejected pairs as JSON lines, and trajectories if there is odometry.

    Frames have the numbers of the whole recording (`Recording.numbers`), also if scans without a pose were left out.
    Trajectories are written as TUM and KITTI. Their times are those of the recording or, without times, the frame
    numbers. Trajectories of earlier runs that this call does not overwrite stay, and a warning names them.

    Several sessions share one graph and one table, whose frames are vertices (`vertices`). Names of recordings are
    added, and the transforms between their frames are written. Vertices and corrected trajectories of sessions with a
    common place are in the frame of the first of these sessions.

    Arguments:
      result: Loops within and between sessions.
      folder: Output folder.
      optimized: Corrected trajectories.
      texts: Further text files to write, by name.

    Returns:
      Paths of the written files.

    Raises WriteError if a file cannot be written. All files of an earlier run then stay as they were.
    """
    folder, names, numbers, placed = Path(folder), unique_names(result), vertices(result), placements(result)
    ids, recordings, chains = dict[int, str](), dict[int, str](), []
    for name, rows, (_, group_from_session), session in zip(names, numbers, placed, result.sessions, strict=True):
        ids |= zip(rows.tolist(), session.recording.ids, strict=True)
        recordings |= dict.fromkeys(rows.tolist(), name)
        if session.odometry is not None:
            chains.append((rows[: session.frames], group_from_session @ session.odometry[: session.frames]))
    named: dict[str, Any] = {"ids": ids, "recordings": recordings if len(names) > 1 else None}
    loops = [renumbered(loop, numbers) for loop in result.loops]
    rejected = [dataclasses.replace(one, loop=renumbered(one.loop, numbers)) for one in result.rejected]
    comments = _comments(result, names, numbers) if len(names) > 1 else []
    files = graph_files(loops, rejected, chains, drift=result.sessions[0].drift, comments=comments, **named)
    files[LINES] = partial(write_loops_jsonl, loops=loops, **named)
    if len(names) > 1:
        files[FRAMES] = partial(write_json, value=_frames_json(result, names, numbers))
    files |= _trajectories(result, names, optimized)
    files |= {name: partial(Path.write_bytes, data=text_bytes(text)) for name, text in texts.items()}
    written = write_all(folder, files)
    older = {path.name for path in folder.glob("trajectory-*.*")} - set(TRAJECTORIES)
    others = [
        name for name in (*TRAJECTORIES, *sorted(older), FRAMES) if name not in files and (folder / name).exists()
    ]
    if others:
        warn(f"{folder}: {', '.join(others)} are from an earlier run and do not belong to these loops")
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
) -> Writers:
    """Writers of the graph, the table and the rejected pairs. See `write_g2o` for the arguments."""
    return {
        GRAPH: partial(write_g2o, loops=loops, chains=chains, drift=drift, comments=comments),
        TABLE: partial(write_loops_csv, loops=loops, recordings=recordings),
        REJECTED: partial(write_loops_jsonl, loops=rejected, ids=ids, recordings=recordings),
    }


def unique_names(result: LoopSearchResult) -> list[str]:
    """Names of the recordings. A repeated name gets the suffix ~2, ~3 and so on."""
    names: list[str] = []
    for session in result.sessions:
        name, number = session.recording.name, 2
        while name in names:
            name, number = f"{session.recording.name}~{number}", number + 1
        names.append(name)
    return names


def vertices(result: LoopSearchResult) -> list[Int[np.ndarray, " _"]]:
    """Vertex of each scan in the graph: the scan's number plus a multiple of `FIRST_VERTEX`, the same for a session.

    If a recording has more scans, the multiple is of the next power of ten.
    """
    numbers = [session.recording.numbers for session in result.sessions]
    largest, step = max(int(rows.max(initial=0)) for rows in numbers), FIRST_VERTEX
    while step <= largest:
        step *= 10
    return [rows + number * step for number, rows in enumerate(numbers)]


def _frames_json(
    result: LoopSearchResult, names: Sequence[str], numbers: Sequence[Int[np.ndarray, " _"]]
) -> dict[str, Any]:
    """Recordings with their first vertices, and transforms between their frames, as a JSON value."""

    def frame(segment: TrajectorySegment) -> dict[str, Any]:
        """The frame of a segment, and the first and the last scan whose poses are known in it."""
        scans = result.sessions[segment.session].recording.numbers
        first, last = int(scans[segment.first]), int(scans[segment.last])
        return {"frame": "odometry" if segment.is_odometry else f"LiDAR at scan {first}", "first": first, "last": last}

    recordings = [
        {"name": name, "scans": session.frames, "first_vertex": int(rows[0] - session.recording.numbers[0])}
        for name, rows, session in zip(names, numbers, result.sessions, strict=True)
    ]
    transforms = [
        {
            "match_recording": names[aligned.match.session],
            "query_recording": names[aligned.query.session],
            "match_frame": frame(aligned.match),
            "query_frame": frame(aligned.query),
            "match_from_query": aligned.match_from_query.tolist(),
            "covariance": aligned.covariance.tolist(),
            "loops": aligned.loops,
        }
        for aligned in result.transforms
    ]
    apart = [pair for pair in result.pairs if not result.between(*pair).transforms]
    no_common_place = [[names[match], names[query]] for match, query in apart]
    return {"recordings": recordings, "transforms": transforms, "no_common_place": no_common_place}


def _comments(result: LoopSearchResult, names: Sequence[str], numbers: Sequence[Int[np.ndarray, " _"]]) -> list[str]:
    """Lines that state the vertices and the frame of each session."""
    lines = []
    for name, rows, (group, _), session in zip(names, numbers, placements(result), result.sessions, strict=True):
        offset = int(rows[0] - session.recording.numbers[0])
        frame = f"; poses in the frame of {names[group]}" if session.odometry is not None else ""
        lines.append(f"{name}: vertex = {offset} + number of the scan{frame}")
    return lines


def _trajectories(result: LoopSearchResult, names: Sequence[str], optimized: OptimizedTrajectory | None) -> Writers:
    """Writers of the odometry and of the corrected trajectories. Names of several sessions are part of a file name."""
    files: Writers = {}
    corrected = [None] * len(names) if optimized is None else result.split(optimized.poses)
    for name, session, optimized_poses in zip(names, result.sessions, corrected, strict=True):
        recording = session.recording
        times = recording.numbers.astype(np.float64) if recording.times is None else recording.times
        suffix = f"-{file_name(name)}" if len(names) > 1 else ""
        for stem, poses in (("trajectory", session.odometry), ("trajectory-optimized", optimized_poses)):
            if poses is not None:
                poses = poses[: session.frames]
                files[f"{stem}{suffix}.tum"] = partial(write_tum, poses=poses, times=times[: session.frames])
                files[f"{stem}{suffix}.kitti"] = partial(write_kitti, poses=poses)
    return files
