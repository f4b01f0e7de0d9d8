"""Cut sequences of real images into short recordings, and find the transforms between them.

    python -m benchmarks.quality.split_recordings --data BEV_IMAGES --seqs 00 02 06

Each recording has `scans` images, every `step`-th of a sequence, and its poses in its own frame as odometry. Pairs are
drawn at random: pairs of one sequence with at least 50 m of path in common, and pairs of different sequences. The
errors are those of `two_recordings`.
"""

import itertools
import json
from pathlib import Path
from typing import Any

import numpy as np
import tyro
from jaxtyping import Float

import sglpr_jax
from benchmarks.quality.two_recordings import Poses, judged, report
from sglpr_jax.data.formats.pose_files import read_poses
from sglpr_jax.data.scan_stream import only
from sglpr_jax.loops.config import DetectorConfig
from sglpr_jax.loops.search import Searched, prepared, search_pair, search_session
from sglpr_jax.models.params import Params
from sglpr_jax.se3 import inverse, travelled

NEAR_M, COMMON_M = 4.0, 50.0
"""Scans of one place are at most this far apart, over at least this length of path, in metres."""


def main(
    *,
    data: Path,
    seqs: tuple[str, ...] = ("00", "02", "06"),
    scans: int = 100,
    step: int = 3,
    pairs: int = 20,
    strangers: int = 20,
    weights: str = "sglpr",
    seed: int = 0,
) -> None:
    """Search the recordings and print the errors.

    Args:
        data: folder in the layout NN/imgs/*.png with NN/pose.txt.
        seqs: sequences.
        scans: number of scans of each recording.
        step: every k-th image is taken.
        pairs: number of pairs with a common place.
        strangers: number of pairs of different sequences.
        weights: the model that describes the images.
        seed: seed of the choice of pairs.
    """
    params, rng = sglpr_jax.load(weights), np.random.default_rng(seed)
    poses = {seq: _poses(data, seq) for seq in seqs}
    windows = [(seq, start) for seq in seqs for start in range(0, len(poses[seq]) - scans * step + 1, scans * step)]
    both = list(itertools.combinations(windows, 2))
    true = {(seq, start): poses[seq][start : start + scans * step : step] for seq, start in windows}
    common = [
        (a, b)
        for a, b in both
        if a[0] == b[0] and b[1] - a[1] > scans * step and _common_m(true[a], true[b]) >= COMMON_M
    ]
    apart = [(a, b) for a, b in both if a[0] != b[0]]
    done: dict[tuple[str, int], Searched] = {}
    rows, invented = [], 0
    for kind, chosen, count in (("common", common, pairs), ("strangers", apart, strangers)):
        for k in rng.permutation(len(chosen))[:count]:
            for window in chosen[k]:
                if window not in done:
                    done[window] = _search(params, data, window, true[window], step)
            searches = done[chosen[k][0]], done[chosen[k][1]]
            loops, _, transforms = search_pair(0, 1, searches)
            row: dict[str, Any] = {"first": chosen[k][0], "second": chosen[k][1], "loops": len(loops)}
            if kind == "common":
                rows.append(row | judged(loops, transforms, searches, [true[window] for window in chosen[k]]))
                row = rows[-1]
            else:
                invented += bool(transforms)
            print(kind, json.dumps(row), flush=True)
    report(rows, invented, min(strangers, len(apart)))


def _poses(data: Path, seq: str) -> Poses:
    """Pose of the LiDAR at each image of a sequence."""
    rows = read_poses(data / seq / "pose.txt")
    found = np.tile(np.eye(4), (len(rows), 1, 1))
    found[:, :3] = rows[:, :3]
    return found


def _common_m(first: Poses, second: Poses) -> float:
    """Length of the second path that is near the first one."""
    apart = np.linalg.norm(second[:, None, :3, 3] - first[None, :, :3, 3], axis=-1).min(axis=1)
    return float(np.diff(travelled(second), prepend=0.0)[apart <= NEAR_M].sum())


def _search(
    params: Params, data: Path, window: tuple[str, int], true: Float[np.ndarray, "n 4 4"], step: int
) -> Searched:
    """Search one recording, with its poses in the frame of its first scan."""
    whole = sglpr_jax.open_recording(data, window[0])
    recording = only(whole, list(range(window[1], window[1] + step * len(true), step)))
    given = prepared(recording, inverse(true[0]) @ true, DetectorConfig(), registered=False)
    return search_session(given, params)


if __name__ == "__main__":
    tyro.cli(main)
