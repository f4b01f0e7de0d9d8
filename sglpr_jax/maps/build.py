"""Creation of the map of a recording with known poses. It can skip unreadable scans, stop and resume."""

from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

from numpy.typing import ArrayLike

from sglpr_jax.data.choices import Scale
from sglpr_jax.data.recording import Recording
from sglpr_jax.data.scan_stream import OnBadScan
from sglpr_jax.loops.arguments import check_is
from sglpr_jax.loops.config import SPACING_M
from sglpr_jax.maps.mapped_scans import map_scans
from sglpr_jax.maps.place_map import PlaceMap
from sglpr_jax.models.params import Params


class Mapped(NamedTuple):
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
) -> Mapped:
    """Create the map of a recording with known poses.

    The id of a place is `RECORDING/SCAN`. Scans that are almost empty are skipped.

    Arguments:
      recording: The scans.
      params: Weights of the model that describes them.
      poses: Pose of the LiDAR in the world at each scan.
      spacing_m: Minimum distance of consecutive places, in metres. Scans nearer to the last place are not read.
      scale: Factor for all lengths before scans are described, 1, 2 or 4, for places that are small in an image, such
        as rooms. Poses of the map are in metres.
      on_bad_scan: Called with id and error of a scan that cannot be read. The scan is skipped. Without it the error is
        raised.
      kept_in: Checkpoint directory. With the same recording, poses, weights and spacing, the run resumes from it. The
        directory is not removed.
      should_stop: If it returns True, the run ends and returns the map of the processed scans.
      on_progress: Called with the number of processed scans.

    Raises:
      ValueError: If the poses have another length or shape, or if all scans are empty.
      TypeError: If an argument is not a recording, parameters or an array.
    """
    check_is(recording, Recording, by="open_recording")
    mapped = map_scans(
        recording,
        params,
        poses,
        spacing_m=spacing_m,
        scale=scale,
        on_bad_scan=on_bad_scan,
        kept_in=kept_in,
        should_stop=should_stop,
        on_progress=on_progress,
    )
    return Mapped(PlaceMap(*mapped.places), mapped.scans, mapped.skipped)
