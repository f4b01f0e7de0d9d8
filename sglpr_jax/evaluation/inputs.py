"""Reads the inputs of an evaluation: descriptors, a top-k list or scored pairs of any method.

- A .npz file is a descriptor file (`DescriptorFile`).
- A .npy file is a matrix of descriptors, one row per frame.
- A text file with lines `query: frame frame ...` or `query: frame=score ...`, best first, is a top-k list. The line
  `query:` has no answer.
- A text file with lines `i j score [label]` is a list of scored pairs. Label 1 is the same place, 0 different places.

Frames are numbered from 0, in the order of the poses. Higher scores mean closer. In text files, empty lines and lines
that start with # are ignored.
"""

import itertools
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
from jaxtyping import Num

from sglpr_jax.data.formats.pose_files import Trajectory
from sglpr_jax.data.poses import poses_at_scans
from sglpr_jax.data.recording import Recording
from sglpr_jax.evaluation.protocols.protocol import Input, ScoredPairs, TopK
from sglpr_jax.files import in_short, naming
from sglpr_jax.numpy_files import read_array
from sglpr_jax.retrieval.descriptor_file import DescriptorFile
from sglpr_jax.retrieval.distances import distance_function
from sglpr_jax.se3 import poses_of

SAME_M = 0.01
"""Positions in two files are the same up to this difference in metres, because programs round what they write."""
SAME_S = 0.001
"""Times in two files are the same up to this difference in seconds."""


def read_input(
    path: Path,
    trajectory: Trajectory | None,
    *,
    sequence: str,
    distance: str | None = None,
    fallback: Trajectory | None = None,
) -> Input:
    """Read an input file of any kind.

    Arguments:
      trajectory: Positions and times of the frames. If None, only those in the file are used.
      sequence: Name of the sequence, for files that do not contain it.
      distance: Name of the distance between the descriptors of a .npy file, L2 by default. A .npz file has its own.
      fallback: Trajectory of a .npz file without positions, if `trajectory` is None. Other files ignore it.

    Raises ValueError, with the name of the file, if the file is invalid or does not fit the other arguments.
    """
    if not path.is_file():
        raise FileNotFoundError(f"{path}: expected a descriptor file, .npy, top-k list or scored pairs, found none")
    if distance is not None:
        distance_function(distance)
    if path.suffix == ".npy":
        return _read_matrix(path, trajectory, sequence=sequence, distance=distance or "l2")
    if distance is not None:
        raise ValueError(f"{path}: expected a .npy file with --distance, found a file that defines its own distance")
    if path.suffix == ".npz":
        return read_descriptor_file(path, trajectory, fallback)
    if ":" in next((line for _, line in _read_lines(path)), ""):
        return _read_top_k_list(path, trajectory, sequence=sequence)
    return _read_pair_list(path, trajectory, sequence=sequence)


def read_methods(
    paths: Sequence[Path],
    *,
    poses: Trajectory | None = None,
    dataset: Trajectory | None = None,
    sequence: str | None = None,
    distance: str | None = None,
) -> dict[str, Input]:
    """Read the file of each method by `read_input`. Returns the inputs by method name: the file name without suffix.

    Files without positions use those of the first file. Files without times use those of the first file that has times.

    Arguments:
      paths: Files of the methods. If file names are equal, the whole path is the name of the method.
      poses: Positions that replace those of every file.
      dataset: Positions for files without their own, if the first file has none and `poses` is None.
      sequence: Name of the sequence. By default the name of each file.
      distance: Name of the distance between descriptors, for the first file and for every .npy file.
    """
    methods: dict[str, Input] = {}
    first_trajectory = None
    file_names = [path.stem for path in paths]
    for path in paths:
        trajectory = poses if path.suffix == ".npz" else first_trajectory or poses or dataset
        name = path.stem if file_names.count(path.stem) == 1 else str(path)
        file_distance = distance if path == paths[0] or path.suffix == ".npy" else None
        method = read_input(
            path,
            trajectory,
            sequence=sequence or path.stem,
            distance=file_distance,
            fallback=first_trajectory or dataset,
        )
        if not methods and isinstance(method, DescriptorFile) and method.positions is not None:
            source = method.pose_source or method.sequence
            first_trajectory = Trajectory(method.positions, method.times, source)
        methods[name] = method
    timed = {name: method for name, method in methods.items() if not isinstance(method, ScoredPairs)}
    times = next((method.times for method in timed.values() if method.times is not None), None)
    for name, method in timed.items():
        if times is not None and method.times is None and len(method) == len(times):
            methods[name] = replace(method, times=times)
    return methods


def recording_trajectory(recording: Recording) -> Trajectory | None:
    """Return the positions and times of a recording, or None if it has no positions."""
    if recording.positions is None:
        return None
    return Trajectory(recording.positions, recording.times, recording.pose_source or recording.name)


def recording_rows(recording: Recording, source: Input) -> Mapping[int, int]:
    """Return the row in the recording of each frame number of `source`.

    Frames are matched by id. Without matching ids, frame i is row i. Raises ValueError if `source` and the recording
    then have different numbers of frames.
    """
    row_of_id = {frame_id: row for row, frame_id in enumerate(recording.ids)}
    if isinstance(source, DescriptorFile) and set(source.ids) <= set(row_of_id):
        return {frame: row_of_id[frame_id] for frame, frame_id in enumerate(source.ids)}
    n = len(recording) if source.positions is None else len(source.positions)
    if n != len(recording):
        raise ValueError(
            f"--data: expected {n} frames in sequence {recording.name}, as in the input, found {len(recording)}"
        )
    return {frame: frame for frame in range(n)}


def as_descriptors(
    rows: Num[np.ndarray, "n d"], trajectory: Trajectory, *, sequence: str, method: str, distance: str
) -> DescriptorFile:
    """Return descriptors, one for each pose, as a file. Raises ValueError if a number is infinite in float32 or NaN."""
    with np.errstate(over="ignore"):  # numbers too large for float32 become infinite, which `DescriptorFile` rejects
        descriptors = np.array(rows, dtype=np.float32)
    return DescriptorFile(
        sequence=sequence,
        ids=_row_ids(len(rows)),
        positions=trajectory.positions,
        times=trajectory.times,
        descriptors=descriptors,
        pose_source=trajectory.source,
        config={"method": method},
        weights_hash="",
        distance=distance,
    )


def _row_ids(n: int) -> tuple[str, ...]:
    """Return the ids of frames that are known only by their row."""
    return tuple(f"{row:06d}" for row in range(n))


def read_descriptor_file(
    path: Path, trajectory: Trajectory | None = None, fallback: Trajectory | None = None
) -> DescriptorFile:
    """Read a descriptor file, optionally with the positions of another trajectory, or of `fallback` if it has none.

    If the times of the trajectory and the file differ, positions are interpolated (`poses_at_scans`) and frames without
    a pose are dropped. The times of the file are kept if it has any, except with `Trajectory.by_row`. If `bin/embed`
    skipped scans, the trajectory may have a pose for every scan or only for the scans of the file.

    Raises ValueError if the trajectory does not fit, or if neither the file nor the trajectory has positions.
    """
    file = DescriptorFile.load(path)
    if trajectory is None and file.positions is None:
        trajectory = fallback
    if trajectory is None:
        if file.positions is None:
            raise ValueError(f"{path}: expected positions to score against, found descriptors of scans without poses")
        return file
    positions, times = trajectory.positions, trajectory.times
    in_file = file.is_described
    if len(positions) == len(in_file) != len(file):  # poses of all scans, but some scans are not in the file
        positions = positions[in_file]
        times = None if times is None else times[in_file]
    with naming(path):
        scan_poses = poses_at_scans(
            trajectory.source,
            poses_of(positions),
            None if trajectory.by_row else times,
            file.times,
            scans=len(file),
            item=f"frame of {path.name}",
        )
        file = file if scan_poses.has_pose.all() else file.only(scan_poses.has_pose)
        keep_times = times is None or (file.times is not None and not trajectory.by_row)
        return replace(
            file,
            positions=scan_poses.poses[:, :3, 3],
            times=file.times if keep_times else times,
            pose_source=", ".join(filter(None, (trajectory.source, scan_poses.note))),
        )


def _read_matrix(path: Path, trajectory: Trajectory | None, *, sequence: str, distance: str) -> DescriptorFile:
    """Read descriptors (n, d) of any real type from a .npy file. Raises ValueError for files that need pickle."""
    expected = f"{path}: expected descriptors (n, d) as numbers"
    try:
        with path.open("rb") as stream:
            rows = read_array(stream, size=path.stat().st_size)
    except MemoryError as error:
        raise ValueError(f"{expected}, found an array larger than the memory") from error
    except Exception as error:  # numpy parses the header as Python, which can raise any exception
        raise ValueError(f"{expected}, found no valid .npy file ({in_short(error)})") from error
    if rows.ndim != 2 or rows.dtype.kind not in "fiub" or rows.size == 0:
        raise ValueError(f"{expected}, found {rows.dtype} {rows.shape}")
    trajectory = _require_trajectory(path, trajectory)
    n = len(trajectory.positions)
    if len(rows) != n:
        raise ValueError(
            f"{path}: expected {n} descriptors, one for each pose of {trajectory.source}, found {len(rows)}"
        )
    with naming(path):
        return as_descriptors(rows, trajectory, sequence=sequence, method=path.stem, distance=distance)


def _read_top_k_list(path: Path, trajectory: Trajectory | None, *, sequence: str) -> TopK:
    """Read lines `query: frame frame ...` or `query: frame=score ...`. Either all frames have a score or none has."""
    trajectory = _require_trajectory(path, trajectory)
    queries, frames, scores = [], [], []
    for line_name, line in _read_lines(path):
        query, colon, answers = line.partition(":")
        if not colon:
            raise ValueError(f"{line_name}: expected `query: frame frame ...`, found {line.strip()[:80]!r}")
        words = [word.partition("=") for word in answers.split()]
        queries.append(_parse_frame(query.strip(), line_name, trajectory))
        frames.append([_parse_frame(frame, line_name, trajectory) for frame, _, _ in words])
        scores.append([_parse_score(score, line_name) if equals else None for _, equals, score in words])
    all_scores = [score for row in scores for score in row]
    missing = all_scores.count(None)
    if 0 < missing < len(all_scores):
        raise ValueError(
            f"{path}: expected a score for every retrieved frame or for none, found {missing} without a score"
        )
    k = max([1, *map(len, frames)])  # shorter rows are padded
    with naming(path):
        return TopK(
            sequence=sequence,
            positions=trajectory.positions,
            times=trajectory.times,
            pose_source=trajectory.source,
            queries=np.array(queries),
            nearest=np.array([row + [-1] * (k - len(row)) for row in frames]),
            scores=None if missing == len(all_scores) else np.array([row + [0] * (k - len(row)) for row in scores]),
        )


def _read_pair_list(path: Path, trajectory: Trajectory | None, *, sequence: str) -> ScoredPairs:
    """Read lines `i j score [label]`, with a label in every line or in none. Without labels, positions are required."""
    rows = [(line_name, line.split()) for line_name, line in _read_lines(path)]
    if not rows:
        raise ValueError(f"{path}: expected lines `i j score [label]` or `query: frame frame ...`, found none")
    columns = len(rows[0][1])
    for line_name, words in rows:
        if len(words) != columns or columns not in (3, 4):
            expected = columns if columns in (3, 4) else "3 or 4"
            raise ValueError(
                f"{line_name}: expected {expected} numbers `i j score [label]`, found {' '.join(words)[:80]!r}"
            )
        if columns == 4 and words[3] not in ("0", "1"):
            raise ValueError(f"{line_name}: expected a label 0 or 1, found {words[3]!r}")
    labels = np.array([words[3] == "1" for _, words in rows]) if columns == 4 else None
    trajectory = trajectory if labels is not None else _require_trajectory(path, trajectory)
    pairs = np.array([[_parse_frame(word, line_name, trajectory) for word in words[:2]] for line_name, words in rows])
    scores = np.array([_parse_score(words[2], line_name) for line_name, words in rows])
    if trajectory is None:
        return ScoredPairs(pairs, scores, labels, sequence=sequence)
    return ScoredPairs(pairs, scores, labels, trajectory.positions, trajectory.source, sequence)


def _read_lines(path: Path) -> Iterator[tuple[str, str]]:
    """Yield the name (for errors: file and number) and the text of each line that is neither empty nor a comment."""
    for number, line in enumerate(path.read_text(errors="replace").splitlines(), start=1):
        if line.strip() and not line.startswith("#"):
            yield f"{path}, line {number}", line


def _parse_frame(word: str, line_name: str, trajectory: Trajectory | None) -> int:
    """Return the number of a frame. Raises ValueError if it is no number, or if the trajectory has no such frame."""
    if not (word.isascii() and word.isdigit() and len(word) < 10):
        raise ValueError(f"{line_name}: expected a frame number, found {word!r}")
    frame = int(word)
    if trajectory is not None and frame >= (n := len(trajectory.positions)):
        raise ValueError(f"{line_name}: expected frames from 0 to {n - 1} ({trajectory.source}), found {frame}")
    return frame


def _parse_score(word: str, line_name: str) -> float:
    """Return a finite number. Raises ValueError, with the name of the line, for other words."""
    try:
        score = float(word if word.isascii() and "_" not in word else "")  # Python reads 1_0 as 10
    except ValueError as error:
        raise ValueError(f"{line_name}: expected a score, found {word!r}") from error
    if not np.isfinite(score):
        raise ValueError(f"{line_name}: expected a finite score, found {word!r}")
    return score


def _require_trajectory(path: Path, trajectory: Trajectory | None) -> Trajectory:
    if trajectory is None:
        raise ValueError(f"{path}: expected positions to score against (--poses, or --data with poses), found none")
    return trajectory


def check_agreement(first: Input, other: Input) -> None:
    """Raise ValueError if `other` has other frames, positions or times than `first`: scores are then not comparable.

    The ids of a file are not compared if they are row numbers and no scan was skipped, as in a .npy file.
    """
    if isinstance(first, DescriptorFile) and isinstance(other, DescriptorFile) and first.ids != other.ids:
        has_row_ids = any(file.ids == _row_ids(len(file)) and file.is_described.all() for file in (first, other))
        if len(first) != len(other) or not has_row_ids:
            pairs = itertools.zip_longest(first.ids, other.ids, fillvalue="none more")
            first_id, other_id = next((a, b) for a, b in pairs if a != b)
            expected = f"expected the frames of the first file, {len(first)} with {first_id!r}"
            raise ValueError(f"{expected}, found {len(other)} with {other_id!r}")
    if not isinstance(first, ScoredPairs) and not isinstance(other, ScoredPairs):
        first_times, other_times = ("none" if source.times is None else "times" for source in (first, other))
        if first_times != other_times:
            raise ValueError(
                "expected times in both files or in neither, "
                f"found {first_times} in the first and {other_times} in this one"
            )
    for name, tolerance in (("positions", SAME_M), ("times", SAME_S)):
        expected, found = getattr(first, name, None), getattr(other, name, None)
        if expected is None or found is None:
            continue
        if len(expected) != len(found):
            raise ValueError(f"expected {len(expected)} {name}, as in the first file, found {len(found)}")
        difference = np.abs(expected - found).reshape(len(expected), -1).max(axis=1)
        row = int(difference.argmax())
        if difference[row] > tolerance:
            raise ValueError(
                f"expected the {name} of the first file, {expected[row].tolist()} in row {row}, "
                f"found {found[row].tolist()}"
            )
