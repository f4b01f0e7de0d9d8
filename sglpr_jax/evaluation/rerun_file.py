"""The loops of a recording as a file for the rerun viewer (extra `view`): trajectories, scans, loops, image pairs."""

import importlib
import importlib.util
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float, Float32

from sglpr_jax.evaluation.loops_page import overlay_of, wrong_loops
from sglpr_jax.files import replacing
from sglpr_jax.loops.probability import Evidence
from sglpr_jax.loops.result import LoopSearchResult, Session
from sglpr_jax.pose_graph.optimize import OptimizedTrajectory
from sglpr_jax.se3 import transformed, travelled

KEYFRAME_M = 5.0
"""Distance between two scans in the file, in metres."""
VOXEL_M = 0.5
"""Edge of a voxel, in metres. One point in each is kept."""
TIMELINE = "frame"
BEFORE, AFTER = (150, 150, 150), (40, 120, 220)
RIGHT, WRONG = (60, 180, 75), (230, 30, 30)
SCAN = (110, 110, 110)
"""Colours of the trajectories, the loops and the scans, red, green, blue."""


def check_installed() -> None:
    """Raises ImportError with the command that installs rerun, if it is missing."""
    if importlib.util.find_spec("rerun") is None:
        raise ImportError("--rerun needs rerun-sdk: pip install 'sglpr-jax[view]'")


def write_rerun(result: LoopSearchResult, path: Path | str, *, optimized: OptimizedTrajectory | None = None) -> None:
    """Write the loops of a recording as an .rrd file for the rerun viewer.

    The time line counts frames. With poses (odometry or, without it, known poses) the file has the trajectory, the
    corrected one, the scan at every 5 m, and a line for each loop. Without poses it has the images of the loops laid
    over each other, and the probabilities. Loops that are wrong by known poses are red. Raises ImportError if rerun is
    not installed, WriteError if the file cannot be written.
    """
    check_installed()
    rerun: Any = importlib.import_module("rerun")
    poses = _poses(result, optimized)
    with replacing(Path(path)) as temporary:
        stream = rerun.RecordingStream("sglpr-jax", recording_id=f"loops {result.sessions[0].recording.name}")
        stream.save(temporary, default_blueprint=_layout(with_map=poses is not None))
        if poses is not None:
            _log_map(rerun, stream, result.sessions[0], poses, is_corrected=optimized is not None)
        _log_loops(rerun, stream, result, poses)
        _log_evidence(rerun, stream, result)
        stream.disconnect()


def _poses(result: LoopSearchResult, optimized: OptimizedTrajectory | None) -> Float[np.ndarray, "n 4 4"] | None:
    """Pose of each searched frame in the map: corrected, by odometry, or a known position without a rotation."""
    session = result.sessions[0]
    if optimized is not None:
        return optimized.poses
    if session.odometry is not None:
        return session.odometry[: session.frames]
    positions = session.recording.positions
    if positions is None:
        return None
    poses = np.tile(np.eye(4), (session.frames, 1, 1))
    poses[:, :3, 3] = positions[: session.frames] - positions[0]
    return poses


def _layout(*, with_map: bool) -> Any:
    views = importlib.import_module("rerun.blueprint")
    images = views.Spatial2DView(origin="pair", name="Query (cyan) on match (red)")
    lines = views.TimeSeriesView(origin="evidence", name="Evidence")
    beside = views.Vertical(images, lines, views.TextLogView(origin="evidence/loop", name="Loops"))
    space = [views.Spatial3DView(origin="map", name="Map")] if with_map else []
    return views.Blueprint(views.Horizontal(*space, beside))


def _log_map(
    rerun: Any, stream: Any, session: Session, poses: Float[np.ndarray, "n 4 4"], *, is_corrected: bool
) -> None:
    """Log the trajectories, the sensor, and the scans of keyframes."""
    stream.log("map", rerun.ViewCoordinates.RIGHT_HAND_Z_UP, static=True)
    lines = {"given": (poses, BEFORE)}
    if is_corrected and session.odometry is not None:
        lines = {"given": (session.odometry[: session.frames], BEFORE), "corrected": (poses, AFTER)}
    for name, (path, colour) in lines.items():
        stream.log(f"map/trajectory/{name}", rerun.LineStrips3D([path[:, :3, 3]], colors=[colour]), static=True)
    # The first frame of every `KEYFRAME_M` of the path. Known positions have no rotation, so scans need odometry.
    keyframes = np.unique(np.floor(travelled(poses) / KEYFRAME_M), return_index=True)[1].tolist()
    with_scans = session.odometry is not None and not session.recording.has_images
    for frame, pose in enumerate(poses):
        stream.set_time(TIMELINE, sequence=frame)
        stream.log("map/sensor", rerun.Points3D([pose[:3, 3]], radii=[1.0], colors=[AFTER]))
        if with_scans and frame in keyframes and session.recording.ids[frame] not in session.skipped:
            points = session.recording.scan(frame, labels=False).points
            if points is not None and len(points):
                in_map = transformed(pose, _thinned(points).astype(np.float64)).astype(np.float32)
                stream.log(f"map/scans/{frame}", rerun.Points3D(in_map, colors=[SCAN], radii=[0.05]))


def _thinned(points: Float32[np.ndarray, "n 3"]) -> Float32[np.ndarray, "m 3"]:
    """One point in each voxel."""
    finite = points[np.isfinite(points).all(axis=1)]
    _, first = np.unique(np.floor(finite / VOXEL_M).astype(np.int64), axis=0, return_index=True)
    return finite[first]


def _log_loops(rerun: Any, stream: Any, result: LoopSearchResult, poses: Float[np.ndarray, "n 4 4"] | None) -> None:
    """Log a line in the map, the pair of images and a text for each loop, at the frame of the query."""
    recording = result.sessions[0].recording
    wrong = {(loop.query, loop.match) for loop in wrong_loops(result)}
    for loop in result.loops:
        colour = WRONG if (loop.query, loop.match) in wrong else RIGHT
        overlap = "" if loop.overlap is None else f", overlap {loop.overlap:.2f}"
        label = f"probability {loop.probability:.4f}{overlap}"
        stream.set_time(TIMELINE, sequence=loop.query)
        if poses is not None:
            ends = poses[[loop.match, loop.query], :3, 3]
            line = rerun.LineStrips3D([ends], colors=[colour], labels=[label], show_labels=False)
            stream.log(f"map/loops/{loop.query}", line)
        image = (255 * np.clip(overlay_of(recording, recording, loop), 0, 1)).astype(np.uint8)
        stream.log("pair", rerun.Image(image).compress(jpeg_quality=90))
        stream.log("evidence/loop", rerun.TextLog(f"query {loop.query}, match {loop.match}: {label}"))


def _log_evidence(rerun: Any, stream: Any, result: LoopSearchResult) -> None:
    """Log correlation of the candidate of each frame, and its probability without the evidence of neighbours."""
    candidates = result.sessions[0].candidates
    if result.model is None or not candidates:
        return
    probabilities = result.model.probability(Evidence.stack([candidate.evidence for candidate in candidates]))
    for candidate, probability in zip(candidates, probabilities.tolist(), strict=True):
        stream.set_time(TIMELINE, sequence=candidate.query)
        stream.log("evidence/probability", rerun.Scalars(probability))
        stream.log("evidence/correlation", rerun.Scalars(float(candidate.alignment.correlation)))
