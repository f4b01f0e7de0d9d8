"""Two recordings of one town without a common frame, whose loops and transform are known without a search."""

import dataclasses
from pathlib import Path

import numpy as np
from drives import along, loop_at
from recordings import of_images

from sglpr_jax.data.recording import Recording
from sglpr_jax.loops.closure import LoopClosure
from sglpr_jax.loops.frame_alignment import SegmentAlignment, TrajectorySegment, align_frames
from sglpr_jax.loops.result import LoopSearchResult, Session
from sglpr_jax.odometry.drift_model import DriftModel
from sglpr_jax.se3 import inverse, transform, travelled

MATCH_FROM_QUERY = transform(40.0, -25.0, 2.0)
"""Pose of the second frame in the first one."""


def two_drives() -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """True poses of both recordings, each in its own frame, and the transform between the frames.

    The second drive follows 80 m of the first one in the opposite direction.
    """
    first = along([(0, 0), (100, 0), (100, 60)], 2.0)
    second = along([(160, 3), (105, 3), (20, 3), (20, 40)], 2.0)
    return first, inverse(MATCH_FROM_QUERY) @ second, MATCH_FROM_QUERY


def loops_between(first: np.ndarray, second: np.ndarray, true: np.ndarray, *, seed: int = 0) -> list[LoopClosure]:
    """Loops with noise, from each scan of the second drive that is within 5 m of a scan of the first one."""
    rng, found = np.random.default_rng(seed), []
    for query, pose in enumerate(true @ second):
        apart = np.linalg.norm(first[:, :2, 3] - pose[:2, 3], axis=1)
        if apart.min() < 5:
            found.append(loop_at(query, int(apart.argmin()), inverse(first[apart.argmin()]) @ pose, rng))
    return found


def found_pair(*, odometry: tuple[np.ndarray, np.ndarray] | None = None) -> LoopSearchResult:
    """Result of a search in both recordings, with true odometry unless other `odometry` is given."""
    first, second, true = two_drives()
    loops = loops_between(first, second, true)
    given = (first, second) if odometry is None else odometry
    parts = [TrajectorySegment(session, 0, len(poses) - 1, True) for session, poses in enumerate(given)]
    ways = {"match_travelled_m": travelled(given[0]), "query_travelled_m": travelled(given[1])}
    alignment = align_frames(loops, *given, **ways, drift=DriftModel())
    sessions = tuple(
        Session(_recording(len(poses), name), len(poses), poses)
        for name, poses in zip(("monday", "tuesday"), given, strict=True)
    )
    between = tuple(dataclasses.replace(loop, query_session=1) for loop in loops)
    return LoopSearchResult(sessions, between, transforms=(SegmentAlignment(*parts, *alignment, len(loops)),))


def _recording(scans: int, name: str) -> Recording:
    images = {Path(f"{i:06d}.png"): np.eye(20, dtype=np.float32) for i in range(scans)}
    return of_images(images, times=np.arange(float(scans)), name=name)
