"""Creation of a `PlaceMap` from a recording with known poses. A run can skip unreadable scans, stop and resume."""

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
from jaxtyping import Float
from numpy.typing import ArrayLike

from sglpr_jax.data.choices import Scale
from sglpr_jax.data.gravity import with_odometry
from sglpr_jax.data.mounting import MODEL_HEIGHT_M, Mounting
from sglpr_jax.data.poses import as_scan_poses
from sglpr_jax.data.recording import Recording
from sglpr_jax.data.scaled import scaled
from sglpr_jax.data.scan_stream import OnBadScan
from sglpr_jax.fields import check_is
from sglpr_jax.loops.candidates import CandidateSearch
from sglpr_jax.loops.checkpoint import add_scans
from sglpr_jax.loops.comparison import NO_FITS, Fits
from sglpr_jax.loops.config import SPACING_M
from sglpr_jax.loops.keyframes import Keyframe
from sglpr_jax.maps.place_map import PlaceMap, place_names
from sglpr_jax.models.weights import Params
from sglpr_jax.retrieval.index import Index


class MapBuildResult(NamedTuple):
    """Map of a recording, with the scans that were skipped."""

    places: PlaceMap
    scans: int
    """Number of processed scans: all, unless the run was stopped."""
    skipped: tuple[str, ...]
    """Ids of scans that cannot be read."""


def map_recording(
    recording: Recording,
    params: Params,
    poses: ArrayLike,
    *,
    spacing_m: float = SPACING_M,
    scale: Scale = 1,
    on_bad_scan: OnBadScan | None = None,
    kept_in: Path | str | None = None,
    should_stop: Callable[[], bool] = lambda: False,
    on_progress: Callable[[int], None] = lambda done: None,
) -> MapBuildResult:
    """Create the map of a recording with known poses. Places have ids RECORDING/SCAN. Empty scans are skipped.

    Arguments:
      recording: The scans.
      params: Weights of the model that describes them.
      poses: Pose of the LiDAR in the world at each scan.
      spacing_m: Minimum distance of consecutive places, in metres. Scans nearer to the last place are not read.
      scale: Factor for all lengths before scans are described, as in `find_loops`. Poses of the map are in metres.
      on_bad_scan: See `find_loops`. Skipped scans do not become places.
      kept_in: Checkpoint directory of these poses and this spacing, as in `find_loops`.
      should_stop: If it returns True, the run ends and returns the map of the processed scans.
      on_progress: Called with the number of processed scans.

    Raises:
      ValueError: If the poses have another length or shape, or if all scans are empty.
      TypeError: If an argument is not a recording, parameters or an array.
    """
    check_is(recording, Recording, by="open_recording")
    poses = as_scan_poses(poses, recording, of="poses")
    recording = with_odometry(recording, poses)
    finder = CandidateSearch(params)  # describes the scans; each scan that is read becomes one of its frames
    places: list[tuple[int, Keyframe]] = []  # row in the recording and keyframe of each place

    def is_due(row: int) -> bool:
        """Whether a scan is at least `spacing_m` from the last place."""
        return not places or bool(np.linalg.norm(poses[row, :3, 3] - poses[places[-1][0], :3, 3]) >= spacing_m)

    def add(keyframe: Keyframe | None, fits: Fits | None) -> None:
        """Add a frame without comparing it with earlier ones: a map needs no loops."""
        finder.add_keyframe(keyframe, fits=NO_FITS)
        if keyframe is not None and not finder.empty[-1]:
            places.append((int(finder.rows[-1]), keyframe))

    add_scans(
        scaled(recording, scale),
        finder,
        add,
        is_due=is_due,
        kept_in=kept_in,
        on_bad_scan=on_bad_scan,
        should_stop=should_stop,
        on_progress=on_progress,
        poses=poses,
        spacing_m=spacing_m,
    )
    on_progress(finder.scans)
    if not places and finder.scans == len(recording):
        raise ValueError(
            f"{recording.name}: expected at least one scan that is not empty, found {len(recording)} empty ones"
        )
    skipped = tuple(recording.ids[row] for row in finder.rows[finder.missing])
    index = Index.empty(finder.index.width, weights_hash=finder.index.weights_hash, scale=scale)
    return MapBuildResult(_place_map(index, recording, poses, places), finder.scans, skipped)


def _place_map(
    index: Index, recording: Recording, poses: Float[np.ndarray, "n 4 4"], places: Sequence[tuple[int, Keyframe]]
) -> PlaceMap:
    """Return the map of `places`, rows of a recording and their keyframes. `index` is empty and is filled."""
    rows, keyframes = [row for row, _ in places], [keyframe for _, keyframe in places]
    names = place_names(recording)
    descriptors = np.array([keyframe.descriptor for keyframe in keyframes], np.float32).reshape(-1, index.width)
    index.add(descriptors, ids=[names[row] for row in rows], positions=poses[rows, :3, 3])
    mountings = [recording.mounting_of(row) or Mounting(MODEL_HEIGHT_M) for row in rows]
    deviations = [[mounting.height_deviation_m, mounting.tilt_deviation_deg] for mounting in mountings]
    return PlaceMap(
        index,
        np.stack([keyframe.image for keyframe in keyframes]) if keyframes else np.zeros((0, 0, 0), np.uint8),
        poses[rows],
        np.array([[mounting.height_m, *mounting.up] for mounting in mountings], np.float64).reshape(-1, 4),
        np.array(deviations, np.float64).reshape(-1, 2),  # None becomes NaN
    )
