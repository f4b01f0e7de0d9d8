"""Text files: poses, times, and the lists that other programs hand in."""

import functools
import io
from pathlib import Path
from random import Random
from typing import Any

import numpy as np

from sglpr_jax.data.formats.pose_files import Trajectory, read_times, read_trajectory
from sglpr_jax.data.readers.nclt import read_ground_truth
from sglpr_jax.evaluation.inputs import read_input

from .damage import (
    BYTES,
    Damage,
    Damaged,
    change_word,
    drop_word,
    empty_line,
    windows_lines,
)
from .road import POSITIONS, TIMES, N, Road


def rows_text(rows: Any, separator: str = " ") -> bytes:
    return "".join(separator.join(f"{value:.17g}" for value in row) + "\n" for row in rows).encode()


def rows_of(content: bytes, separator: str | None = None, skip: int = 0) -> np.ndarray:
    """What a plain parser finds: a row of numbers for every line that is no comment."""
    lines = content.decode(errors="replace").rstrip().splitlines()[skip:]
    return np.array([[float(word) for word in line.split(separator)] for line in lines if not line.startswith("#")])


def break_rotation(content: bytes, draw: Random) -> Damaged:
    """A rotation of zeros, twice too long, or mirrored."""
    rows = rows_of(content)
    turn = slice(4, 8) if rows.shape[1] == 8 else [0, 1, 2, 4, 5, 6, 8, 9, 10]
    rows[draw.randrange(len(rows)), turn] *= draw.choice((0, 2) if rows.shape[1] == 8 else (0, 2, -1))
    return Damaged(rows_text(rows))


def backwards(content: bytes, draw: Random, *, skip: int = 0) -> Damaged:
    """Two rows in the wrong order: times run backwards."""
    lines = content.decode().splitlines()
    a = draw.randrange(skip, len(lines) - 1)
    lines[a], lines[a + 1] = lines[a + 1], lines[a]
    return Damaged("\n".join(lines).encode() + b"\n")


def nanoseconds(content: bytes, draw: Random) -> Damaged:
    """Times in another unit, in the first column."""
    separator = "," if b"," in content else " "
    lines = [line.split(separator) for line in content.decode().splitlines()]
    lines = [[f"{(1.7e9 + float(w[0])) * 1e9:.0f}", *w[1:]] if w[0][0] not in "t" else w for w in lines]
    return Damaged("\n".join(separator.join(words) for words in lines).encode() + b"\n")


def double_column(content: bytes, draw: Random) -> Damaged:
    """A header that names a column twice, or none of three."""
    header, _, rest = content.partition(b"\n")
    names = header.split(b",")
    names[draw.randrange(len(names))] = draw.choice((b"x", b"y", b"z", b"", b"w"))
    return Damaged(b",".join(names) + b"\n" + rest, "same" if b",".join(names) == header else "either")


TEXT: dict[str, Damage] = {
    **BYTES,
    "word": change_word,
    "missing": drop_word,
    "empty": empty_line,
    "crlf": windows_lines,
}
COMMAS: dict[str, Damage] = {
    **BYTES,
    "word": functools.partial(change_word, separator=",", skip=1),
    "missing": functools.partial(drop_word, separator=",", skip=1),
    "crlf": windows_lines,
}
TWELVE = rows_text(np.concatenate([np.broadcast_to(np.eye(3), (N, 3, 3)), POSITIONS[:, :, None]], 2).reshape(N, 12))
TUM = rows_text(np.column_stack([TIMES, POSITIONS, np.tile([0, 0, 0, 1], (N, 1))]))
CSV = b"timestamp,x,y,z\n" + rows_text(np.column_stack([TIMES, POSITIONS]), ",")
UTIMES = np.column_stack([np.arange(N) * 500000 + 1326652795280148, POSITIONS, np.zeros((N, 3))])
NCLT = b"".join(b"%d," % row[0] + rows_text([row[1:]], ",") for row in UTIMES)


def _same_clock(found: Any, values: np.ndarray) -> bool:
    """Numbers of rows are no times, as in a file of which only the first row is left."""
    if values[0] in (0, 1) and (np.diff(values) == 1).all():
        return found is None
    return np.array_equal(found, values)


def _same_poses(found: Trajectory, content: bytes) -> bool:
    rows = rows_of(content)
    if rows.shape[1] == 12:
        x, y, z = rows[:, [3, 7, 11]].T
        return np.array_equal(found.positions, np.stack([z, -x, -y], 1)) and found.times is None
    return np.array_equal(found.positions, rows[:, 1:4]) and _same_clock(found.times, rows[:, 0])


def _same_csv(found: Trajectory, content: bytes) -> bool:
    """By the names in the header."""
    names = [n.strip().lower() for n in content.decode(errors="replace").partition("\n")[0].split(",")]
    rows = rows_of(content, ",", skip=1)
    clock = [name for name in names if name in ("t", "time", "timestamp")]
    times = found.times is None if not clock else _same_clock(found.times, rows[:, names.index(clock[0])])
    return times and np.array_equal(found.positions, np.stack([rows[:, names.index(axis)] for axis in "xyz"], 1))


def _same_truth(found: tuple[np.ndarray, np.ndarray], content: bytes) -> bool:
    rows = np.loadtxt(io.BytesIO(content), delimiter=",", ndmin=2)
    rows = rows[np.isfinite(rows).all(1)]
    return np.array_equal(found[0], rows[:, 0].astype(np.int64)) and np.array_equal(
        found[1], rows[:, 1:4] * [1, -1, -1]
    )


TRAJECTORY = Trajectory(POSITIONS, TIMES, "poses")
TOP_K = b"0: 1=0.5 2=0.25\n3: 4=2\n4:\n"
PAIRS = b"1 0 0.5 1\n2 0 0.25 0\n4 3 2 1\n"


def _same_top_k(found: Any, content: bytes) -> bool:
    said = {}
    for line in content.decode(errors="replace").splitlines():
        if line.strip() and not line.startswith("#"):
            query, _, rest = line.partition(":")
            said[int(query)] = [tuple(map(float, word.split("="))) for word in rest.split()]
    listed = {}
    for row, query in enumerate(found.queries):
        frames = [frame for frame in found.nearest[row] if frame >= 0]
        scores = [] if found.scores is None else found.scores[row][: len(frames)]
        listed[int(query)] = (
            [(float(f), float(s)) for f, s in zip(frames, scores, strict=True)]
            if len(scores)
            else [(float(f),) for f in frames]
        )
    return listed == said


def _same_pairs(found: Any, content: bytes) -> bool:
    rows = rows_of(b"\n".join(line for line in content.splitlines() if line.strip()))
    labels = found.labels is None if rows.shape[1] == 3 else np.array_equal(found.labels, rows[:, 3] == 1)
    return labels and np.array_equal(found.pairs, rows[:, :2]) and np.array_equal(found.scores, rows[:, 2])


def frame_outside(content: bytes, draw: Random) -> Damaged:
    """A frame that there is not, a number that is none, or a query twice."""
    changes = ((b"4", b"7"), (b"0", b"-1"), (b"2 ", b"2.5 "), (b"3: ", b"0: "), (b"4 3", b"4 99999999999"))
    return Damaged(content.replace(*draw.choice(changes), 1), "either")


def _read_list(path: Path) -> Any:
    return read_input(path, TRAJECTORY, sequence="08")


POSES = {**TEXT, "rotation": break_rotation}
ORDER: dict[str, Damage] = {"backwards": backwards, "nanoseconds": nanoseconds}
LIST: dict[str, Damage] = {**BYTES, "frame": frame_outside, "crlf": windows_lines}
HEADED: dict[str, Damage] = {"header": double_column, "backwards": functools.partial(backwards, skip=1)}


def _same_times(found: np.ndarray, content: bytes) -> bool:
    return np.array_equal(found, rows_of(content).ravel())


ROADS = (
    Road("top-k list", "top.txt", TOP_K, _read_list, _same_top_k, LIST),
    Road(
        "scored pairs", "pairs.txt", PAIRS, _read_list, _same_pairs, {**LIST, "missing": drop_word, "word": change_word}
    ),
    Road("KITTI poses", "poses.txt", TWELVE, lambda path: read_trajectory(path, format="kitti"), _same_poses, POSES),
    Road("TUM poses", "poses.tum", TUM, read_trajectory, _same_poses, {**POSES, **ORDER}),
    Road("csv poses", "poses.csv", CSV, read_trajectory, _same_csv, {**COMMAS, **ORDER, **HEADED}),
    Road(
        "times",
        "times.txt",
        rows_text(TIMES[:, None]),
        read_times,
        _same_times,
        {**TEXT, **ORDER, "missing": empty_line},
    ),
    Road(
        "NCLT ground truth",
        "groundtruth_2012-01-15.csv",
        NCLT,
        read_ground_truth,
        _same_truth,
        {**BYTES, "backwards": backwards},
    ),
)
