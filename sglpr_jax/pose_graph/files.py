"""Loops and trajectories in the file formats of pose-graph programs: g2o, TUM, KITTI, JSON lines, csv.

Files are written atomically. Poses are those of the LiDAR (x forward, y left, z up) in a fixed frame.
"""

import csv
import io
import itertools
import json
import re
from collections import Counter
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float, Int

from sglpr_jax.data.formats.pose_files import CAMERA_FROM_LIDAR, parse_numbers
from sglpr_jax.data.poses import as_poses
from sglpr_jax.files import in_short, parse_json, warn, write_text
from sglpr_jax.loops.closure import LoopClosure, RejectedClosure
from sglpr_jax.loops.odometry_deviation import step_deviations
from sglpr_jax.odometry.drift_model import DriftModel
from sglpr_jax.se3 import from_quaternions, have_unit_length, inverse, quaternions

LOOPS_JSONL = "loops.jsonl"
"""File of the loops in an output folder and in a live map."""
VERTEX, EDGE = "VERTEX_SE3:QUAT", "EDGE_SE3:QUAT"
OTHER_TYPE = re.compile(r"FIX|(VERTEX|EDGE|PARAMS|CACHE)_[A-Z0-9_:]+")
"""First word of a line of g2o: other types than those that are read."""
UPPER_TRIANGLE = np.triu_indices(6)
"""Indices of the 21 numbers of an information matrix in a g2o file: upper triangle by rows, translation first."""
Ids = Sequence[str] | Mapping[int, str]
"""Id or recording of each frame, by frame number."""
CSV_COLUMNS = ("query", "match", "x", "y", "z", "qx", "qy", "qz", "qw", "probability", "overlap")
CSV_RECORDING_COLUMNS = ("query_recording", "match_recording")
"""Further columns of a table of loops between several recordings."""


class Graph(NamedTuple):
    """Content of a g2o file."""

    poses: dict[int, Float[np.ndarray, "4 4"]]
    edges: list[tuple[int, int, Float[np.ndarray, "4 4"], Float[np.ndarray, "6 6"]]]
    """First vertex, second vertex, pose of the second in the first, and information matrix, translation first."""


def write_g2o(
    path: Path | str,
    loops: Sequence[LoopClosure],
    chains: Sequence[tuple[Int[np.ndarray, " _"], Float[np.ndarray, "_ 4 4"], DriftModel]] = (),
    *,
    comments: Sequence[str] = (),
) -> None:
    """Write a pose graph: a vertex for each pose, an edge for each step of the odometry, an edge for each loop.

    Arguments:
      path: File to write.
      loops: Loops. Their frames are vertices.
      chains: Vertices, poses of the LiDAR and drift for each session with odometry. The drift determines the
        information matrices of the edges (`step_deviations`). Without chains, only the loops are written.
      comments: Lines at the beginning of the file, which readers ignore.

    Raises WriteError if the file cannot be written.
    """
    lines = [f"# {comment}" for comment in comments]
    for vertices, odometry, drift in chains:
        lines += [f"{VERTEX} {i} {pose}" for i, pose in zip(vertices, _pose_texts(odometry), strict=True)]
        steps = _pose_texts(inverse(odometry[:-1]) @ odometry[1:])
        # metres and radians of each step, each three times: x, y, z, then rotations about x, y, z
        variances = np.repeat(np.stack(step_deviations(odometry, drift), axis=1), 3, axis=1) ** 2
        for (i, j), step, variance in zip(itertools.pairwise(vertices), steps, variances, strict=True):
            lines.append(f"{EDGE} {i} {j} {step} {_rounded_text(np.diag(1 / variance)[UPPER_TRIANGLE])}")
    for loop, pose in zip(loops, _pose_texts([loop.match_from_query for loop in loops]), strict=True):
        lines.append(f"{EDGE} {loop.match} {loop.query} {pose} {_rounded_text(loop.information[UPPER_TRIANGLE])}")
    write_text(Path(path), "".join(f"{line}\n" for line in lines))


def read_g2o(path: Path | str) -> Graph:
    """Read vertices and edges of a g2o file (`VERTEX_SE3:QUAT`, `EDGE_SE3:QUAT`). Lines of other types are left out,
    with a `DataWarning` that counts them.

    Edges without an information matrix, 9 numbers instead of 30, get the unit matrix.

    Raises:
      FileNotFoundError: If the file does not exist.
      ValueError: If all lines have other types, if a line has too few numbers, repeats a vertex or begins with
        an unknown word, or if an information matrix is not positive semidefinite. The message names the line.
    """
    path, graph = Path(path), Graph({}, [])
    edge_columns = 0  # numbers of an edge, set by the first one
    other_types = Counter[str]()
    if not path.is_file():
        raise FileNotFoundError(f"{path}: expected a g2o file, found none")
    content = path.read_bytes()
    if b"\0" in content:
        raise ValueError(f"{path}: expected text in UTF-8, found bytes that are 0, as in UTF-16 or in a damaged file")
    for number, line in enumerate(content.decode(errors="replace").splitlines(), start=1):
        words, where = line.split(), f"{path}, line {number}"
        if not words or words[0].startswith("#"):
            continue
        if words[0] == VERTEX:
            values = parse_numbers(words[1:], columns=8, where=where)
            (frame,) = _frame_numbers(values[:1], where)
            if frame in graph.poses:
                raise ValueError(f"{where}: expected each vertex once, found vertex {frame} again")
            graph.poses[frame] = _pose_of_numbers(values[1:], where)
        elif words[0] == EDGE:
            edge_columns = edge_columns or (9 if len(words) == 10 else 30)  # a later edge with fewer is cut off
            values = parse_numbers(words[1:], columns=edge_columns, where=where)
            information = np.eye(6)
            if edge_columns == 30:
                information[UPPER_TRIANGLE] = values[9:]
                information += np.triu(information, 1).T  # make it symmetric
                eigenvalues = np.linalg.eigvalsh(information)
                if eigenvalues[0] < -1e-6 * abs(eigenvalues[-1]):
                    found = in_short(" ".join(words[10:]))
                    raise ValueError(f"{where}: expected a positive semidefinite matrix, found {found}")
            first, second = _frame_numbers(values[:2], where)
            graph.edges.append((first, second, _pose_of_numbers(values[2:9], where), information))
        elif OTHER_TYPE.fullmatch(words[0]):
            other_types[words[0]] += 1
        else:
            raise ValueError(f"{where}: expected a type of g2o, such as {VERTEX}, found {words[0][:40]!r}")
    found = ", ".join(f"{name} ({count})" for name, count in other_types.most_common())
    if found and not graph.poses and not graph.edges:
        raise ValueError(f"{path}: expected lines of {VERTEX} or {EDGE}, found {found}")
    if found:
        warn(f"{path}: only {VERTEX} and {EDGE} are read, other lines are left out: {found}")
    return graph


def _frame_numbers(values: Float[np.ndarray, " n"], where: str) -> list[int]:
    """Return numbers of a g2o line as frame numbers. Raises ValueError if one is negative or not an integer."""
    if (values < 0).any() or (values != np.round(values)).any():
        raise ValueError(f"{where}: expected frames, counted from 0, found {' '.join(map(str, values))}")
    return [int(value) for value in values]


def _pose_of_numbers(values: Float[np.ndarray, " 7"], where: str) -> Float[np.ndarray, "4 4"]:
    """Return the pose of x y z qx qy qz qw. Raises ValueError if the quaternion is not of length 1 (within 0.01)."""
    if not have_unit_length(values[None, 3:])[0]:
        raise ValueError(f"{where}: expected a quaternion of length 1, found {values[3:]}")
    return from_quaternions(values[None, :3], values[None, 3:])[0]


def write_tum(path: Path | str, poses: Float[np.ndarray, "n 4 4"], times: Float[np.ndarray, " n"]) -> None:
    """Write a TUM file: a line `time x y z qx qy qz qw` for each pose, in seconds and metres."""
    lines = (f"{time:.9f} {pose}\n" for time, pose in zip(times, _pose_texts(poses), strict=True))
    write_text(Path(path), "".join(lines))


def write_kitti(path: Path | str, poses: Float[np.ndarray, "n 4 4"]) -> None:
    """Write a KITTI file: 12 numbers a line, in KITTI's camera axes (x right, y down, z forward)."""
    camera = CAMERA_FROM_LIDAR @ poses @ CAMERA_FROM_LIDAR.T
    write_text(Path(path), "".join(f"{_exact_text(pose[:3].reshape(-1))}\n" for pose in camera))


def write_loops_csv(path: Path | str, loops: Sequence[LoopClosure], recordings: Ids | None = None) -> None:
    """Write a csv table with the columns `CSV_COLUMNS`. The overlap is empty if it is unknown. If the `recordings` of
    the frames are given, the table also has the columns `CSV_RECORDING_COLUMNS`."""
    text = io.StringIO()
    table = csv.writer(text, lineterminator="\n")
    table.writerow(CSV_COLUMNS if recordings is None else (*CSV_COLUMNS, *CSV_RECORDING_COLUMNS))
    for loop, pose in zip(loops, _pose_texts([loop.match_from_query for loop in loops]), strict=True):
        overlap = "" if loop.overlap is None else f"{loop.overlap:.4f}"
        names = [] if recordings is None else [recordings[loop.query], recordings[loop.match]]
        table.writerow([loop.query, loop.match, *pose.split(), f"{loop.probability:.6f}", overlap, *names])
    write_text(Path(path), text.getvalue())


def loop_lines(
    loops: Sequence[LoopClosure | RejectedClosure], ids: Ids | None = None, recordings: Ids | None = None
) -> str:
    """Return a line of JSON for each loop or rejected pair, with ids and recordings of its frames if they are given. A
    rejected pair has a reason but no covariance."""
    lines = []
    for closure in loops:
        loop = closure.loop if isinstance(closure, RejectedClosure) else closure
        row: dict[str, Any] = {"query": loop.query, "match": loop.match}
        for suffix, names in (("id", ids), ("recording", recordings)):
            if names is not None:
                row |= {f"query_{suffix}": names[loop.query], f"match_{suffix}": names[loop.match]}
        if isinstance(closure, RejectedClosure):
            row["reason"] = closure.reason
            fields = ("probability", "overlap", "match_from_query")
        else:
            fields = ("match_from_query", "covariance", "probability", "overlap")
        row |= {name: getattr(loop, name) for name in fields}
        lines.append(json.dumps(row, default=np.ndarray.tolist) + "\n")
    return "".join(lines)


def read_loops_jsonl(path: Path | str, *, skip_damaged: bool = False) -> list[LoopClosure]:
    """Read the loops of a file of `loop_lines`. Raises FileNotFoundError, or ValueError, which names the line,
    if a line is not a valid loop. With `skip_damaged`, such a line is left out."""
    path = Path(path)
    if not path.is_file():
        raise FileNotFoundError(f"{path}: expected loops, a JSON object a line, found no file")
    loops = []
    for number, line in enumerate(path.read_bytes().splitlines(), start=1):
        try:
            loops.append(_loop_of_json(line, f"{path}, line {number}"))
        except ValueError:
            if not skip_damaged:
                raise
    return loops


def _loop_of_json(line: bytes, where: str) -> LoopClosure:
    """Parse a line of `loop_lines`. Raises ValueError, which names the place `where`, if it is not a valid loop."""
    value = parse_json(line, source=where)
    try:
        query, match = value["query"], value["match"]
        (pose,) = as_poses([value["match_from_query"]], of="match_from_query")
        covariance = np.array(value["covariance"], np.float64)
        if type(query) is not int or type(match) is not int or not 0 <= match < query:
            raise ValueError(f"match {match} and query {query}")
        if covariance.shape != (6, 6) or not _is_covariance(covariance):
            raise ValueError(f"no covariance, symmetric and positive definite: {covariance.tolist()}")
        overlap = None if value["overlap"] is None else float(value["overlap"])
        loop = LoopClosure(query, match, pose, covariance, float(value["probability"]), overlap)
        if not all(0 <= share <= 1 for share in (loop.probability, loop.overlap or 0.0)):
            raise ValueError(f"probability {loop.probability} and overlap {loop.overlap}")
    except (ValueError, KeyError, TypeError, OverflowError) as error:
        raise ValueError(f"{where}: expected a loop as JSON, found an invalid line ({in_short(error)})") from error
    return loop


def _is_covariance(matrix: Float[np.ndarray, "6 6"]) -> bool:
    """Whether a matrix is finite, symmetric up to rounding, and positive definite."""
    if not np.isfinite(matrix).all() or np.abs(matrix - matrix.T).max() > 1e-6 * np.abs(matrix).max():
        return False
    try:
        np.linalg.cholesky(matrix)
    except np.linalg.LinAlgError:
        return False
    return True


def _pose_texts(poses: Sequence[np.ndarray] | Float[np.ndarray, "n 4 4"]) -> list[str]:
    """Return `x y z qx qy qz qw` of each pose, with all digits: map coordinates may have seven before the point."""
    if not len(poses):
        return []
    poses = np.asarray(poses, np.float64)
    return [_exact_text(row) for row in np.concatenate([poses[:, :3, 3], quaternions(poses)], axis=1)]


def _exact_text(values: Float[np.ndarray, " n"]) -> str:
    """Return numbers as text: nine digits if these read back as the same float64, otherwise all digits."""
    texts = ((value, f"{value:.9g}") for value in values.tolist())
    return " ".join(text if float(text) == value else repr(value) for value, text in texts)


def _rounded_text(values: Float[np.ndarray, " n"]) -> str:
    """Return numbers as text with nine digits."""
    return " ".join(f"{value:.9g}" for value in values)
