"""Export of the loops of a search as a folder of files for other programs."""

from collections.abc import Callable, Mapping, Sequence
from functools import partial
from pathlib import Path
from types import MappingProxyType
from typing import Any

import numpy as np
from jaxtyping import Float, Int

from sglpr_jax.files import file_name, text_bytes, warn, write_all, write_json, write_text
from sglpr_jax.loops.closure import LoopClosure, RejectedClosure, convert_rejected, renumbered
from sglpr_jax.loops.frame_alignment import TrajectorySegment
from sglpr_jax.loops.result import LoopSearchResult
from sglpr_jax.odometry.drift_model import DriftModel
from sglpr_jax.pose_graph.files import (
    LOOPS_JSONL,
    Ids,
    loop_lines,
    write_g2o,
    write_kitti,
    write_loops_csv,
    write_tum,
)
from sglpr_jax.pose_graph.optimize import OptimizedTrajectory, placements

LOOPS_G2O, LOOPS_CSV = "loops.g2o", "loops.csv"
REJECTED = "rejected.jsonl"
FRAMES = "frames.json"
"""File of the transforms between the frames of several sessions."""
TRAJECTORIES = ("trajectory.tum", "trajectory.kitti", "trajectory-optimized.tum", "trajectory-optimized.kitti")
FIRST_VERTEX = 1_000_000
"""Minimum offset between the vertex numbers of consecutive sessions."""
Writers = dict[str, Callable[[Path], object]]
"""For each file name, a function that writes the file to a path (argument of `files.write_all`)."""


def write_loop_folder(
    result: LoopSearchResult,
    folder: Path | str,
    *,
    optimized: OptimizedTrajectory | None = None,
    texts: Mapping[str, str] = MappingProxyType({}),
) -> list[Path]:
    """Write loops as g2o, JSON lines and csv, rejected pairs as JSON lines, and trajectories if there is odometry.

    Frames keep their numbers in the recording (`Recording.numbers`), also if scans without a pose were removed.
    Trajectories are written as TUM and KITTI, with the frame numbers as times if the recording has no times. If
    trajectories of an earlier run remain, a warning names them.

    Several sessions share one graph and one table, whose frames are named by `vertex_numbers`. The names of the
    recordings and the transforms between their frames are written, too. Sessions with a common place are in the frame
    of the first of them.

    Arguments:
      result: Loops within and between sessions.
      folder: Output folder.
      optimized: Corrected trajectories.
      texts: Further text files to write, by name.

    Returns:
      Paths of the written files.

    Raises WriteError if a file cannot be written. All files of an earlier run then stay as they were.
    """
    folder, names, numbers, placed = Path(folder), result.unique_names, vertex_numbers(result), placements(result)
    ids, recordings = dict[int, str](), dict[int, str]()  # by vertex number
    chains = []  # vertex numbers, poses and drift of each session with odometry
    comments = []  # vertex numbers and frame of each session, if there are several
    for name, vertices, (group, group_from_session), session in zip(
        names, numbers, placed, result.sessions, strict=True
    ):
        ids |= zip(vertices.tolist(), session.recording.ids, strict=True)
        recordings |= dict.fromkeys(vertices.tolist(), name)
        frame = ""
        if session.odometry is not None:
            poses = group_from_session @ session.odometry[: session.frames]
            chains.append((vertices[: session.frames], poses, session.drift))
            frame = f"; poses in the frame of {names[group]}"
        if len(names) > 1:
            offset = vertices[0] - session.recording.numbers[0]
            comments.append(f"{name}: vertex = {offset} + number of the scan{frame}")
    loops = [renumbered(loop, numbers) for loop in result.loops]
    rejected = convert_rejected(result.rejected, lambda loop: renumbered(loop, numbers))
    named_recordings = recordings if len(names) > 1 else None
    files = graph_files(loops, rejected, chains, comments=comments, ids=ids, recordings=named_recordings)
    if len(names) > 1:
        files[FRAMES] = partial(write_json, value=_frames_json(result, names, numbers))
    files |= _trajectory_files(result, names, optimized)
    files |= {name: partial(Path.write_bytes, data=text_bytes(text)) for name, text in texts.items()}
    written = write_all(folder, files)
    session_trajectories = {path.name for path in folder.glob("trajectory-*.*")} - set(TRAJECTORIES)
    possible = (*TRAJECTORIES, *sorted(session_trajectories), FRAMES)
    outdated = [name for name in possible if name not in files and (folder / name).exists()]
    if outdated:
        warn(f"{folder}: {', '.join(outdated)} are from an earlier run and do not belong to these loops")
    return written


def graph_files(
    loops: Sequence[LoopClosure],
    rejected: Sequence[RejectedClosure],
    chains: Sequence[tuple[Int[np.ndarray, " _"], Float[np.ndarray, "_ 4 4"], DriftModel]],
    *,
    comments: Sequence[str] = (),
    ids: Ids | None = None,
    recordings: Ids | None = None,
) -> Writers:
    """Return writers of the graph (g2o), the table of loops (csv), the rejected pairs and the loops (JSON lines).
    `chains` and `comments` are arguments of `write_g2o`, `ids` and `recordings` of `loop_lines`."""
    return {
        LOOPS_G2O: partial(write_g2o, loops=loops, chains=chains, comments=comments),
        LOOPS_CSV: partial(write_loops_csv, loops=loops, recordings=recordings),
        REJECTED: partial(write_text, text=loop_lines(rejected, ids, recordings)),
        LOOPS_JSONL: partial(write_text, text=loop_lines(loops, ids, recordings)),
    }


def vertex_numbers(result: LoopSearchResult) -> list[Int[np.ndarray, " _"]]:
    """Return the number of each scan's vertex in the graph, for each session.

    It is the scan's number plus an offset: 0, 1, 2, ... times `FIRST_VERTEX`, for the first, second, third session. If
    a scan number is as large as that, the next power of ten that exceeds it is used instead.
    """
    scan_numbers = [session.recording.numbers for session in result.sessions]
    largest = max(int(numbers.max(initial=0)) for numbers in scan_numbers)
    step = FIRST_VERTEX
    while step <= largest:
        step *= 10
    return [numbers + session * step for session, numbers in enumerate(scan_numbers)]


def _frames_json(
    result: LoopSearchResult, names: Sequence[str], numbers: Sequence[Int[np.ndarray, " _"]]
) -> dict[str, Any]:
    """Return the content of `FRAMES`: recordings with their vertex offsets, and transforms between their frames.
    `numbers` is the result of `vertex_numbers`."""

    def describe_frame(segment: TrajectorySegment) -> dict[str, Any]:
        """Return the name of a segment's frame, and the first and the last scan with a pose in this frame."""
        frame = "odometry" if segment.is_odometry else f"LiDAR at scan {segment.first}"
        return {"frame": frame, "first": segment.first, "last": segment.last}

    recordings = [
        {"name": name, "scans": session.frames, "first_vertex": int(vertices[0] - session.recording.numbers[0])}
        for name, vertices, session in zip(names, numbers, result.sessions, strict=True)
    ]
    transforms = [
        {
            "match_recording": names[transform.match.session],
            "query_recording": names[transform.query.session],
            "match_frame": describe_frame(transform.match),
            "query_frame": describe_frame(transform.query),
            "match_from_query": transform.match_from_query.tolist(),
            "covariance": transform.covariance.tolist(),
            "loops": transform.loops,
        }
        for transform in result.transforms
    ]
    no_common_place = [
        [names[match], names[query]] for match, query in result.pairs if not result.between(match, query).transforms
    ]
    return {"recordings": recordings, "transforms": transforms, "no_common_place": no_common_place}


def _trajectory_files(result: LoopSearchResult, names: Sequence[str], optimized: OptimizedTrajectory | None) -> Writers:
    """Return writers of the odometry and of the corrected trajectories of all sessions. If there are several sessions,
    their names are part of the file names."""
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
