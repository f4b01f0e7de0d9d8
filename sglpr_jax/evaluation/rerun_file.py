"""Writes the loops of a recording, with trajectories and scans, to a file for the rerun viewer (extra `view`)."""

import importlib
import importlib.util
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float, Float32

from sglpr_jax.data.scan import Scan
from sglpr_jax.data.scan_stream import scan_stream
from sglpr_jax.evaluation.loops_page import overlaid_scans, wrong_loops
from sglpr_jax.extras import install_command
from sglpr_jax.files import replacing
from sglpr_jax.loops.probability import Evidence
from sglpr_jax.loops.result import LoopSearchResult, Session
from sglpr_jax.pose_graph.optimize import OptimizedTrajectory
from sglpr_jax.se3 import poses_of, transformed, travelled
from sglpr_jax.voxels import one_per_voxel

KEYFRAME_M = 5.0
"""Travelled distance between two scans in the file, in metres."""
VOXEL_M = 0.5
"""Edge of a voxel, in metres. Of each scan, one point in each voxel is written."""
TIMELINE = "frame"
GREY, BLUE = (150, 150, 150), (40, 120, 220)
GREEN, RED = (60, 180, 75), (230, 30, 30)
DARK_GREY = (110, 110, 110)
"""Colours of the trajectories before and after correction, of right and wrong loops, and of the scans."""


def check_installed() -> None:
    """Raise ImportError, with the command that installs rerun, if it is missing."""
    if importlib.util.find_spec("rerun") is None:
        raise ImportError(f"--rerun needs rerun-sdk: {install_command('view')}")


def write_rerun(result: LoopSearchResult, path: Path | str, *, optimized: OptimizedTrajectory | None = None) -> None:
    """Write the loops of a recording as an .rrd file for the rerun viewer.

    The time line counts frames. The file has the overlaid images of the loops, and the probability of each candidate.
    With odometry or known positions it also has a map: the trajectory, the `optimized` trajectory, and a line for each
    loop, red if the loop is wrong by known positions. With odometry the map has a scan every 5 m. Raises ImportError if
    rerun is not installed, WriteError if the file cannot be written.
    """
    check_installed()
    rerun: Any = importlib.import_module("rerun")
    poses = _map_poses(result, optimized)
    with replacing(Path(path)) as temporary:
        stream = rerun.RecordingStream("sglpr-jax", recording_id=f"loops {result.sessions[0].recording.name}")
        stream.save(temporary, default_blueprint=_viewer_layout(with_map=poses is not None))
        if poses is not None:
            _log_map(rerun, stream, result.sessions[0], poses, is_corrected=optimized is not None)
        _log_loops(rerun, stream, result, poses)
        _log_candidates(rerun, stream, result)
        stream.disconnect()


def _map_poses(result: LoopSearchResult, optimized: OptimizedTrajectory | None) -> Float[np.ndarray, "n 4 4"] | None:
    """Return the poses of the searched frames (corrected, odometry, or positions without rotation), or None."""
    session = result.sessions[0]
    if optimized is not None:
        return optimized.poses
    if session.odometry is not None:
        return session.odometry[: session.frames]
    positions = session.recording.positions
    if positions is None:
        return None
    return poses_of(positions[: session.frames] - positions[0])


def _viewer_layout(*, with_map: bool) -> Any:
    """Return a blueprint of the viewer: on the left the map, if there is one; on the right images, plots and texts."""
    views = importlib.import_module("rerun.blueprint")
    images = views.Spatial2DView(origin="pair", name="Query (magenta) on match (green)")
    plots = views.TimeSeriesView(origin="evidence", name="Evidence")
    texts = views.TextLogView(origin="evidence/loop", name="Loops")
    maps = [views.Spatial3DView(origin="map", name="Map")] if with_map else []
    return views.Blueprint(views.Horizontal(*maps, views.Vertical(images, plots, texts)))


def _log_map(
    rerun: Any, stream: Any, session: Session, poses: Float[np.ndarray, "n 4 4"], *, is_corrected: bool
) -> None:
    """Log the trajectories, the position of the sensor at each frame, and a readable scan every `KEYFRAME_M`."""
    stream.log("map", rerun.ViewCoordinates.RIGHT_HAND_Z_UP, static=True)
    trajectories = {"given": (poses, GREY)}
    if is_corrected and session.odometry is not None:
        trajectories = {"given": (session.odometry[: session.frames], GREY), "corrected": (poses, BLUE)}
    for name, (path, colour) in trajectories.items():
        stream.log(f"map/trajectory/{name}", rerun.LineStrips3D([path[:, :3, 3]], colors=[colour]), static=True)
    for frame, pose in enumerate(poses):
        stream.set_time(TIMELINE, sequence=frame)
        stream.log("map/sensor", rerun.Points3D([pose[:3, 3]], radii=[1.0], colors=[BLUE]))
    if session.odometry is None or session.recording.has_images:
        return  # Known positions have no rotation and images no points, so neither can place scans in the map.
    _, rows = np.unique(np.floor(travelled(poses) / KEYFRAME_M), return_index=True)  # first frame of each 5 m
    options = {"rows": rows.tolist(), "on_bad_scan": lambda scan, error: None}
    for frame, points in scan_stream(session.recording, _thinned_points, **options):
        if points is not None:
            map_points = transformed(poses[frame], points.astype(np.float64)).astype(np.float32)
            stream.set_time(TIMELINE, sequence=frame)
            stream.log(f"map/scans/{frame}", rerun.Points3D(map_points, colors=[DARK_GREY], radii=[0.05]))


def _thinned_points(frame: int, scan: Scan) -> Float32[np.ndarray, "m 3"]:
    """Return the first finite point of a scan in each voxel."""
    finite = scan.cloud[np.isfinite(scan.cloud).all(axis=1)]
    return one_per_voxel(finite, VOXEL_M)


def _log_loops(rerun: Any, stream: Any, result: LoopSearchResult, poses: Float[np.ndarray, "n 4 4"] | None) -> None:
    """Log each loop at the frame of its query: a line in the map (with `poses`), the overlaid images and a text."""
    recording = result.sessions[0].recording
    wrong = {(loop.query, loop.match) for loop in wrong_loops(result)}
    for loop in result.loops:
        colour = RED if (loop.query, loop.match) in wrong else GREEN
        overlap = "" if loop.overlap is None else f", overlap {loop.overlap:.2f}"
        label = f"probability {loop.probability:.4f}{overlap}"
        stream.set_time(TIMELINE, sequence=loop.query)
        if poses is not None:
            ends = poses[[loop.match, loop.query], :3, 3]
            line = rerun.LineStrips3D([ends], colors=[colour], labels=[label], show_labels=False)
            stream.log(f"map/loops/{loop.query}", line)
        image = (255 * np.clip(overlaid_scans(recording, recording, loop), 0, 1)).astype(np.uint8)
        stream.log("pair", rerun.Image(image).compress(jpeg_quality=90))
        stream.log("evidence/loop", rerun.TextLog(f"query {loop.query}, match {loop.match}: {label}"))


def _log_candidates(rerun: Any, stream: Any, result: LoopSearchResult) -> None:
    """Log image correlation and probability (without the evidence of neighbouring frames) of each compared pair."""
    candidates = result.sessions[0].candidates
    if result.model is None or not candidates:
        return
    probabilities = result.model.probability(Evidence.stack([candidate.evidence for candidate in candidates]))
    for candidate, probability in zip(candidates, probabilities.tolist(), strict=True):
        stream.set_time(TIMELINE, sequence=candidate.query)
        stream.log("evidence/probability", rerun.Scalars(probability))
        stream.log("evidence/correlation", rerun.Scalars(float(candidate.alignment.correlation)))
