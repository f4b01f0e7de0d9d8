"""Inputs of an evaluation: descriptors, a top-k list or scored pairs of any method.

- A .npz file is a descriptor file (`DescriptorFile`).
- A .npy file is a matrix of descriptors, one row per frame.
- A text with lines `query: frame frame ...` or `query: frame=score ...`, best first, is a top-k list. The line `query:`
  has no answer.
- A text with lines `i j score [label]` is a list of scored pairs. Label 1 is the same place, 0 different places.

Frames are numbered from 0, in the order of the poses. Higher scores mean closer. In texts, empty lines and lines that
start with # are ignored.
"""

import itertools
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
from jaxtyping import Num

from sglpr_jax.data.formats.pose_files import Trajectory
from sglpr_jax.data.poses import poses_at_scans, poses_of
from sglpr_jax.data.recording import Recording
from sglpr_jax.evaluation.protocols.protocol import Input, ScoredPairs, TopK
from sglpr_jax.files import in_short, naming
from sglpr_jax.numpy_files import read_array
from sglpr_jax.retrieval.descriptor_file import DescriptorFile
from sglpr_jax.retrieval.distances import distance_function

SAME_M = 0.01
"""Largest difference of equal positions, in metres. Programs round the numbers in their files."""
SAME_S = 0.001
"""Largest difference of equal times, in seconds."""


def read_input(path: Path, trajectory: Trajectory | None, *, sequence: str, distance: str | None = None) -> Input:
    """Read an input file of any kind.

    Arguments:
      path: File to read.
      trajectory: Positions and times of the frames. If None, only those in the file are used.
      sequence: Name of the sequence, for files that do not contain it.
      distance: Name of the distance between the descriptors of a .npy file, L2 by default. Other files define their
        own distance.

    Raises:
      ValueError: If the file is invalid or does not fit the other arguments. The message names the file.
    """
    if not path.is_file():
        raise FileNotFoundError(f"{path}: expected a descriptor file, .npy, top-k list or scored pairs, found none")
    if distance is not None:
        distance_function(distance)
    if path.suffix == ".npy":
        return _read_matrix(path, trajectory, sequence=sequence, distance=distance or "l2")
    if distance is not None:
        raise ValueError(f"{path}: expected a .npy beside --distance, found a file that defines its own distance")
    if path.suffix == ".npz":
        return read_descriptor_file(path, trajectory)
    if ":" in next((line for _, line in _lines(path)), ""):
        return _read_top_k_list(path, trajectory, sequence=sequence)
    return _read_pair_list(path, trajectory)


def read_methods(
    paths: Sequence[Path],
    *,
    poses: Trajectory | None = None,
    dataset: Trajectory | None = None,
    sequence: str | None = None,
    distance: str | None = None,
) -> dict[str, Input]:
    """Read the file of every method by `read_input`. Returns the inputs by method name, which is the name of the file.

    Arguments:
      paths: Files of the methods.
      poses: Positions that replace those of every file. Without times, all files get those of the first that has any.
      dataset: Positions for files without positions, if the first file has no positions either.
      sequence: Name of the sequence. By default the name of each file.
      distance: Name of the distance between descriptors, for the first file and for every .npy file.
    """
    methods: dict[str, Input] = {}
    poses_of_first = None
    for path in paths:
        trajectory = poses if path.suffix == ".npz" else poses_of_first or poses or dataset
        options = {"distance": distance} if path == paths[0] or path.suffix == ".npy" else {}
        name = path.stem if sum(other.stem == path.stem for other in paths) == 1 else str(path)
        method = read_input(path, trajectory, sequence=sequence or path.stem, **options)
        if not methods and isinstance(method, DescriptorFile) and method.positions is not None:
            source = method.pose_source or method.sequence
            poses_of_first = Trajectory(method.positions, method.times, source, by_row=True)
        methods[name] = method
    if poses is not None:
        retrievals = {name: method for name, method in methods.items() if not isinstance(method, ScoredPairs)}
        times = next((method.times for method in retrievals.values() if method.times is not None), None)
        methods |= {name: replace(method, times=times) for name, method in retrievals.items() if method.times is None}
    return methods


def recording_trajectory(recording: Recording) -> Trajectory | None:
    """Return the positions and times of a recording, or None if it has no positions."""
    if recording.positions is None:
        return None
    return Trajectory(recording.positions, recording.times, recording.pose_source or recording.name)


def recording_rows(recording: Recording, source: Input) -> Mapping[int, int]:
    """Return the row in the recording of each frame of `source`.

    Frames are matched by id or, if ids do not match, by number. Raises ValueError if the numbers of frames differ, too.
    """
    n = len(recording) if source.positions is None else len(source.positions)
    row_of = {name: row for row, name in enumerate(recording.ids)}
    if isinstance(source, DescriptorFile) and set(source.ids) <= set(row_of):
        return {frame: row_of[name] for frame, name in enumerate(source.ids)}
    if n != len(recording):
        raise ValueError(
            f"--data: expected {n} frames in sequence {recording.name}, as in the input, found {len(recording)}"
        )
    return {frame: frame for frame in range(n)}


def as_descriptors(
    rows: Num[np.ndarray, "n d"], trajectory: Trajectory, *, sequence: str, method: str, distance: str
) -> DescriptorFile:
    """Return descriptors from an array of real numbers. Row i belongs to pose i.

    Raises ValueError if a row is not finite.
    """
    with np.errstate(over="ignore"):  # numbers too large for float32 become infinite, which `DescriptorFile` rejects
        descriptors = np.array(rows, dtype=np.float32)
    return DescriptorFile(
        sequence=sequence,
        ids=tuple(f"{row:06d}" for row in range(len(rows))),
        positions=trajectory.positions,
        times=trajectory.times,
        descriptors=descriptors,
        pose_source=trajectory.source,
        config={"method": method},
        weights_hash="",
        distance=distance,
    )


def read_descriptor_file(path: Path, trajectory: Trajectory | None = None) -> DescriptorFile:
    """Read a descriptor file, optionally with the positions of another trajectory.

    Times of the trajectory replace those of the file if the file has none, or if they were given for the frames
    (`Trajectory.by_row`). If `bin/embed` skipped scans, the trajectory may have a pose for every scan. If the times
    differ, positions are interpolated (`poses_at_scans`) and frames without a pose are dropped.

    Raises ValueError if the trajectory does not fit or if there are no positions.
    """
    file = DescriptorFile.load(path)
    if trajectory is None:
        if file.positions is None:
            raise ValueError(f"{path}: expected positions to score against, found descriptors of scans without poses")
        return file
    positions, times = trajectory.positions, trajectory.times
    is_described = file.is_described
    if len(positions) == len(is_described) != len(file):
        positions, times = positions[is_described], None if times is None else times[is_described]
    with naming(path):
        scan_poses = poses_at_scans(
            trajectory.source,
            poses_of(positions),
            None if trajectory.by_row else times,
            file.times,
            scans=len(file),
            item=f"frame of {path.name}",
        )
        with_pose = file if scan_poses.has_pose.all() else file.only(scan_poses.has_pose)
        keeps_times = times is None or (file.times is not None and not trajectory.by_row)
        return replace(
            with_pose,
            positions=scan_poses.poses[:, :3, 3],
            times=with_pose.times if keeps_times else times,
            pose_source=", ".join(filter(None, (trajectory.source, scan_poses.note))),
        )


def _read_matrix(path: Path, trajectory: Trajectory | None, *, sequence: str, distance: str) -> DescriptorFile:
    """Read descriptors (n, d) of any real type. Files that need pickle are rejected."""
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
    trajectory = _required(path, trajectory)
    if len(rows) != (poses := len(trajectory.positions)):
        raise ValueError(
            f"{path}: expected {poses} descriptors, one for each pose of {trajectory.source}, found {len(rows)}"
        )
    with naming(path):
        return as_descriptors(rows, trajectory, sequence=sequence, method=path.stem, distance=distance)


def _read_top_k_list(path: Path, trajectory: Trajectory | None, *, sequence: str) -> TopK:
    """Read the frames retrieved for each query. Either all frames have a score or none has."""
    trajectory = _required(path, trajectory)
    rows, scores = [], []
    for where, line in _lines(path):
        query, colon, answers = line.partition(":")
        if not colon:
            raise ValueError(f"{where}: expected `query: frame frame ...`, found {line.strip()[:80]!r}")
        words = [word.partition("=") for word in answers.split()]
        rows.append([_frame(word, where, trajectory) for word in (query.strip(), *(frame for frame, _, _ in words))])
        scores.append([_score(score, where) if equals else None for _, equals, score in words])
    retrieved, missing = sum(map(len, scores)), sum(score is None for row in scores for score in row)
    if 0 < missing < retrieved:
        raise ValueError(
            f"{path}: expected a score for every retrieved frame or for none, found {missing} without a score"
        )
    columns = max(2, *map(len, rows))
    frames = np.array([row + [-1] * (columns - len(row)) for row in rows])
    with naming(path):
        return TopK(
            sequence=sequence,
            positions=trajectory.positions,
            times=trajectory.times,
            pose_source=trajectory.source,
            queries=frames[:, 0],
            nearest=frames[:, 1:],
            scores=None if missing == retrieved else np.array([row + [0] * (columns - 1 - len(row)) for row in scores]),
        )


def _read_pair_list(path: Path, trajectory: Trajectory | None) -> ScoredPairs:
    """Read pairs of frames, the query first. Pairs without a label are labelled by their positions."""
    rows = [(where, line.split()) for where, line in _lines(path)]
    if not rows:
        raise ValueError(f"{path}: expected lines `i j score [label]` or `query: frame frame ...`, found none")
    columns = len(rows[0][1])
    for where, words in rows:
        if len(words) != columns or columns not in (3, 4):
            expected = columns if columns in (3, 4) else "3 or 4"
            raise ValueError(
                f"{where}: expected {expected} numbers `i j score [label]`, found {' '.join(words)[:80]!r}"
            )
        if columns == 4 and words[3] not in ("0", "1"):
            raise ValueError(f"{where}: expected a label 0 or 1, found {words[3]!r}")
    labels = np.array([words[3] == "1" for _, words in rows]) if columns == 4 else None
    trajectory = trajectory if labels is not None else _required(path, trajectory)
    pairs = np.array([[_frame(word, where, trajectory) for word in words[:2]] for where, words in rows])
    scores = np.array([_score(words[2], where) for where, words in rows])
    if trajectory is None:
        return ScoredPairs(pairs, scores, labels)
    return ScoredPairs(pairs, scores, labels, trajectory.positions, trajectory.source)


def _lines(path: Path) -> Iterator[tuple[str, str]]:
    """Yield location (for error messages) and text of every line that is not empty or a comment."""
    for number, line in enumerate(path.read_text(errors="replace").splitlines(), start=1):
        if line.strip() and not line.startswith("#"):
            yield f"{path}, line {number}", line


def _frame(word: str, where: str, trajectory: Trajectory | None) -> int:
    """Return the number of a frame. Raises ValueError if it is no number, or if the trajectory has no such frame."""
    if not (word.isascii() and word.isdigit() and len(word) < 10):
        raise ValueError(f"{where}: expected a frame number, found {word!r}")
    if trajectory is not None and int(word) >= (n := len(trajectory.positions)):
        raise ValueError(f"{where}: expected frames from 0 to {n - 1} ({trajectory.source}), found {int(word)}")
    return int(word)


def _score(word: str, where: str) -> float:
    try:
        score = float(word if word.isascii() and "_" not in word else "")  # Python reads 1_0 as 10
    except ValueError as error:
        raise ValueError(f"{where}: expected a score, found {word!r}") from error
    if not np.isfinite(score):
        raise ValueError(f"{where}: expected a finite score, found {word!r}")
    return score


def _required(path: Path, trajectory: Trajectory | None) -> Trajectory:
    if trajectory is None:
        raise ValueError(f"{path}: expected positions to score against (--poses, or --data with poses), found none")
    return trajectory


def check_agreement(first: Input, other: Input) -> None:
    """Raise ValueError if `other` has other frames, positions or times than `first`. The message names a frame.

    Scores on different recordings cannot be compared.
    """
    if isinstance(first, DescriptorFile) and isinstance(other, DescriptorFile) and first.ids != other.ids:
        pairs = itertools.zip_longest(first.ids, other.ids)
        here, there = next((a, b) for a, b in pairs if a != b)
        raise ValueError(
            f"expected the frames of the first file, {len(first)} with {here or 'none more'!r}, "
            f"found {len(other)} with {there or 'none more'!r}"
        )
    has_times = [source.times is not None for source in (first, other) if not isinstance(source, ScoredPairs)]
    if has_times in ([True, False], [False, True]):
        words = ["times" if has else "none" for has in has_times]
        raise ValueError(
            f"expected times in both files or in neither, found {words[0]} in the first and {words[1]} in this one"
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
            rows = expected[row].tolist(), found[row].tolist()
            raise ValueError(f"expected the {name} of the first file, {rows[0]} in row {row}, found {rows[1]}")
