"""Checkpoints of loop searches and maps: a log of described frames, from which a killed run resumes.

All results that take time are stored: descriptors, images, and comparisons with other frames.
"""

import contextlib
import dataclasses
import hashlib
import json
import os
import zlib
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import safetensors.numpy
from jaxtyping import Float

from sglpr_jax.data.fingerprint import fingerprint
from sglpr_jax.data.formats.tensors import tensors_as_bytes
from sglpr_jax.data.mounting import Mounting
from sglpr_jax.data.recording import Recording
from sglpr_jax.data.scan_stream import OnBadScan, scan_stream
from sglpr_jax.files import in_short
from sglpr_jax.frame_log import FrameLog
from sglpr_jax.loops.candidates import CandidateSearch
from sglpr_jax.loops.comparison import Fits
from sglpr_jax.loops.keyframes import Keyframe
from sglpr_jax.odometry.drift_model import MOTION_DRIFT
from sglpr_jax.registration.bev_alignment import BevRegistration
from sglpr_jax.registration.bev_search import CorrelationPeak
from sglpr_jax.schema import Column, check_about, check_columns

FORMAT = "sglpr-jax unfinished loops 9"
LOG, ODOMETRY_LOG = "checkpoint.log", "odometry.log"
OLD = "settings.json"
"""File of checkpoints of earlier versions, which are not read."""
FRAME_FORMAT = "sglpr-jax live 6"
LINK = ("x", "y", "yaw", "correlation", "peak_ratio", "along_m")
"""Stored fields of the registration that shows the motion (`Fits.link`)."""
COLUMNS = {
    "descriptor": Column("float32", ("d",), optional=True),
    "image": Column("uint8", ("h", "h"), optional=True),
    "pose": Column("float64", (4, 4), optional=True),
    "fitted": Column("int64", ("fits",)),
    "fits": Column("float64", ("fits", len(CorrelationPeak._fields))),
    "links": Column("float64", (1, len(LINK)), finite=False),
    "lookalike": Column("float64", (1,), finite=False),
}
"""Arrays of a frame. A scan that cannot be read or is not a keyframe has no descriptor and image. A missing link is
stored as NaN."""


def frame_bytes(
    keyframe: Keyframe | None, fits: Fits, *, pose: Float[np.ndarray, "4 4"] | None = None, **values: Any
) -> bytes:
    """Serialise a frame for `read_frame`: description, comparisons, pose by odometry, and further JSON values."""
    link = [np.nan] * len(LINK) if fits.link is None else [float(getattr(fits.link, name)) for name in LINK]
    arrays = {
        "fitted": np.asarray(fits.frames, np.int64),
        "fits": np.stack(fits.peaks, axis=1).astype(np.float64),
        "links": np.array([link]),
        "lookalike": np.array([fits.lookalike]),
    }
    if keyframe is not None:
        arrays |= {"descriptor": keyframe.descriptor, "image": keyframe.image}
        values["mounting"] = None if keyframe.mounting is None else keyframe.mounting.fields
    if pose is not None:
        arrays["pose"] = np.asarray(pose, np.float64)
    contiguous = {name: np.ascontiguousarray(array) for name, array in arrays.items()}
    text = json.dumps({"format": FRAME_FORMAT, **values})
    return zlib.compress(tensors_as_bytes(contiguous, {"scan": text}), 1)


def read_frame(
    content: bytes, frame: int, annotations: Mapping[str, Any], *, source: Path | None
) -> tuple[Keyframe | None, Fits, Float[np.ndarray, "4 4"] | None, dict[str, Any]]:
    """Return the keyframe, the comparisons, the pose and the JSON values of `frame_bytes`.

    `annotations` has the type of each expected JSON value, as in a dataclass. Raises ValueError, which names the file
    `source` and the number `frame`, if the content is invalid.
    """
    try:
        plain = zlib.decompress(content)
        arrays = safetensors.numpy.load(plain)
        size = int.from_bytes(plain[:8], "little")
        values = json.loads(json.loads(plain[8 : 8 + size])["__metadata__"]["scan"])
        check_about(values, annotations, format=FRAME_FORMAT)
        check_columns(arrays, COLUMNS)
        frames, (link,) = arrays["fitted"], arrays["links"]
        if ((frames < 0) | (frames >= frame)).any():
            raise ValueError(f"expected comparisons with frames before {frame}, found {frames.tolist()}")
        keyframe, mounting = None, values.get("mounting")
        if "image" in arrays:
            mounting = None if mounting is None else Mounting(**{**mounting, "up": tuple(mounting["up"])})  # JSON: list
            keyframe = Keyframe(arrays["descriptor"], arrays["image"], mounting)
    except Exception as error:  # another program may have written it
        raise ValueError(f"{source}: expected frame {frame}, found another content ({in_short(error)})") from error
    x, y, yaw, correlation, peak_ratio, along_m = link
    covariance = np.diag([along_m, along_m, 0.0]) ** 2  # the log keeps only the deviation along the uncertain direction
    registration = None if np.isnan(link).all() else BevRegistration(x, y, yaw, covariance, correlation, peak_ratio)
    fits = Fits(frames, CorrelationPeak(*arrays["fits"].T), registration, float(arrays["lookalike"][0]))
    return keyframe, fits, arrays.get("pose"), {name: values[name] for name in annotations}


def settings(
    recording: Recording, finder: CandidateSearch, **arguments: np.ndarray | int | float | str | None
) -> dict[str, Any]:
    """Settings and `arguments` of a run that determine its frames, as JSON values, with hashes for arrays."""
    hashed = {
        name: hashlib.sha256(value.tobytes()).hexdigest()[:16] if isinstance(value, np.ndarray) else value
        for name, value in arguments.items()
    }
    return {
        "format": FORMAT,
        "recording": [recording.name, fingerprint(recording, contents="some")],
        "weights": finder.index.weights_hash,
        "candidates": dataclasses.asdict(finder.config),
        "drift": [dataclasses.asdict(drift) for drift in (finder.drift, MOTION_DRIFT)],
        "verification": dataclasses.asdict(finder.verification),
        **hashed,
    }


def delete_checkpoint(folder: Path) -> None:
    """Delete the logs in the folder of a checkpoint and below, and the folders that are then empty."""
    for parent, _, names in os.walk(folder, topdown=False):
        for name in names:
            if name.startswith((LOG, ODOMETRY_LOG)):  # also damaged ones, which are kept under longer names
                Path(parent, name).unlink()
        with contextlib.suppress(OSError):  # files of the user are in it
            Path(parent).rmdir()


def add_scans(
    recording: Recording,
    finder: CandidateSearch,
    add: Callable[[Keyframe | None, Fits | None], object],
    *,
    is_due: Callable[[int], bool],
    kept_in: Path | str | None,
    on_bad_scan: OnBadScan | None,
    should_stop: Callable[[], bool],
    on_progress: Callable[[int], None],
    **arguments: np.ndarray | int | float | str | None,
) -> None:
    """Add the frames of a checkpoint. Read, describe and add the other scans, and append them to the checkpoint.

    Arguments:
      recording: The scans.
      finder: Candidate search without frames.
      add: Function that adds the next frame to the finder. It receives the keyframe, or None for a bad scan, and the
        comparisons of a frame of the checkpoint, or None for a new frame.
      is_due: Whether the scan in a row is the next frame, after all earlier frames were added. Others are skipped.
      kept_in: Checkpoint directory, or None.
      on_bad_scan: Called with id and error of a bad scan. Without it, the error is raised, and a bad scan of the
        checkpoint is read again.
      should_stop: If it returns True, no further scan is read.
      on_progress: Called with the number of scans up to the last added frame.
      arguments: Further arguments that determine the frames (`settings`).

    Raises ValueError for a checkpoint of an earlier version, and the errors of `FrameLog` and `scan_stream`.
    """
    path = None if kept_in is None else Path(kept_in) / LOG
    if path is not None and path.with_name(OLD).exists():
        raise ValueError(
            f"{path.parent}: expected a checkpoint of this version, found that of an earlier one; delete it"
        )
    with FrameLog(path, {} if path is None else settings(recording, finder, **arguments), restarts=True) as log:

        def next_row() -> int | None:
            """Row of the next frame, or None at the end. Skips the scans before it."""
            while finder.scans < len(recording) and not is_due(finder.scans):
                finder.skip()
            return finder.scans if finder.scans < len(recording) else None

        def rows_to_read() -> Iterator[int]:
            """Add the frames that the checkpoint has next, and then yield a row."""
            while True:
                before = len(finder)
                while (content := log.record(len(finder))) is not None:
                    keyframe, fits, _, about = read_frame(content, len(finder), {"missing": int}, source=path)
                    is_other = about["missing"] != len(finder.missing)  # other scans before it could be read
                    if is_other or (keyframe is None and on_bad_scan is None):
                        break
                    next_row()  # skips the scans before the frame, which the checkpoint does not have
                    add(keyframe, fits)
                if len(finder) > before:
                    on_progress(finder.scans)
                if (row := next_row()) is None:
                    return
                yield row

        options = {"on_bad_scan": on_bad_scan, "should_stop": should_stop, "on_progress": on_progress}
        options["rows"] = rows_to_read()
        for _, keyframe in scan_stream(recording, lambda row, scan: finder.keyframe(scan), **options):
            missing = len(finder.missing)
            add(keyframe, None)
            if path is not None:
                log.append(len(finder) - 1, frame_bytes(keyframe, finder.fits, missing=missing))
