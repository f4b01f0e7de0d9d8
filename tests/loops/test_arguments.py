"""What is handed in from Python is taken where it is clear, and refused in one sentence where it is not."""

import datetime
import inspect
from pathlib import Path

import numpy as np
import pytest
from recordings import of_scans

from sglpr_jax.data.formats.pose_files import CAMERA_FROM_LIDAR
from sglpr_jax.data.mounting import Mounting
from sglpr_jax.data.poses import as_pose, as_poses
from sglpr_jax.data.scan import Scan, as_scan
from sglpr_jax.data.times import as_seconds
from sglpr_jax.files import DataWarning
from sglpr_jax.loops.candidates import CandidateSearch
from sglpr_jax.loops.detector import LoopDetector
from sglpr_jax.loops.keyframes import Keyframe
from sglpr_jax.loops.search import find_loops
from sglpr_jax.maps.build import map_recording
from sglpr_jax.maps.place_map import PlaceMap
from sglpr_jax.models.weights import weights_hash
from sglpr_jax.retrieval.index import Index
from sglpr_jax.se3 import transform

POSES = [np.eye(4).tolist(), transform(1.0, 0.0, 0.5)]
FLAT = np.zeros((2, 4, 4))
EMPTY = Keyframe(np.ones(256, np.float32), np.zeros((152, 152), np.uint8), None)


def test_lists_are_taken_for_arrays():
    np.testing.assert_array_equal(as_poses(POSES, of="odometry"), np.array(POSES))
    np.testing.assert_array_equal(as_pose(POSES[0]), np.eye(4))
    scan = Scan()
    assert as_scan(scan) is scan
    points = as_scan([[1, 2, 3], [4, 5, 6]])
    assert points.points.dtype == np.float32 and points.points.shape == (2, 3) and points.mounting is None
    assert as_scan(np.ones((9, 9), int)).image.shape == (9, 9)
    assert as_seconds(np.int64(3)) == 3.0 and as_seconds(None) is None and as_pose(None) is None


@pytest.mark.parametrize(
    ("call", "kind", "message"),
    [
        (lambda: as_poses(Path("a.tum"), of="poses"), TypeError, "path a.tum; read it with sglpr_jax.read_odometry"),
        (lambda: as_poses([np.eye(4), np.eye(3)], of="poses"), TypeError, r"poses \(n, 4, 4\), found a list"),
        (lambda: as_poses(np.zeros((5, 3)), of="odometry"), ValueError, r"odometry .*, found .* shape \(5, 3\)"),
        (lambda: as_poses(FLAT, of="odometry"), ValueError, r"with rotations, found \[\[0\.0.* in row 0"),
        (lambda: as_pose(np.eye(3)), ValueError, r"odometry \(4, 4\), found an array of shape \(3, 3\)"),
        (lambda: as_scan("000000.bin"), TypeError, "found the path 000000.bin; read it with sglpr_jax.read_scan"),
        (lambda: as_scan([[1, 2, 3], [4]]), TypeError, r"points \(n, 3\) or an image \(h, w\), found a list"),
        (lambda: as_scan(np.zeros((3, 3, 3))), ValueError, r"found an array of shape \(3, 3, 3\)"),
        (lambda: as_seconds("now"), TypeError, "expected a time in seconds, found 'now'"),
        (lambda: as_seconds(np.nan), ValueError, "expected a time in seconds, found nan"),
    ],
)
def test_what_is_something_else_is_named(call, kind, message):
    with pytest.raises(kind, match=message):
        call()


def test_the_functions_ask_so(params):
    recording = of_scans({Path(f"{i}.bin"): np.zeros((1, 3), np.float32) for i in range(2)})
    with pytest.raises(TypeError, match=r"expected odometry \(n, 4, 4\), found the path a\.tum"):
        find_loops(recording, params, odometry="a.tum")
    with pytest.raises(ValueError, match="08: expected poses of 2 scans, found poses of 1"):
        map_recording(recording, params, POSES[:1])
    with pytest.raises(TypeError, match=r"found the path 0\.bin; read it with sglpr_jax\.read_scan"):
        LoopDetector(params).add("0.bin")
    with pytest.raises(ValueError, match=r"expected a density image, floats from 0 to 10, found floats from 0 to 255"):
        LoopDetector(params).add(255.0 * np.eye(151))


@pytest.mark.parametrize("function", [find_loops, map_recording])
def test_what_is_no_recording_is_named(function, params):
    """The tests check all types beforehand; `unwrap` gives what users call."""
    given = {"poses": POSES} if function is map_recording else {}
    with pytest.raises(TypeError, match=r"expected a Recording, found 'KITTI'; sglpr_jax\.open_recording returns one"):
        inspect.unwrap(function)("KITTI", params, **given)


def test_points_are_looked_for_in_a_map_as_those_of_its_sensor(params, monkeypatch):
    index = Index.empty(params.config.head.descriptor_size, weights_hash=weights_hash(params))
    index.add(np.ones(index.width), positions=np.zeros(3))
    places = PlaceMap(
        index, np.zeros((1, 152, 152), np.uint8), np.eye(4)[None], np.array([[2.5, 0, 0, 1.0]]), np.full((1, 2), np.nan)
    )
    asked = []
    monkeypatch.setattr(CandidateSearch, "keyframe", lambda self, scan: asked.append(scan) or EMPTY)
    assert places.relocate(params, [[5, 3, 1]]) == [] and places.relocate(params, np.zeros((9, 9))) == []
    assert asked[0].mounting == Mounting(2.5) and asked[1].image is not None


def test_loops_and_maps_warn_of_poses_in_the_cameras_axes(params):
    way = np.stack([transform(2.0 * x, 0.0, 0.0) for x in range(20)])
    recording = of_scans({Path(f"{i}.bin"): np.zeros((1, 3), np.float32) for i in range(20)})
    camera = CAMERA_FROM_LIDAR @ way @ CAMERA_FROM_LIDAR.T
    for given, function in (({"odometry": camera}, find_loops), ({"poses": camera}, map_recording)):
        with pytest.warns(DataWarning, match="found 38 of 38 m of path up or down; are they in camera axes"):
            function(recording, params, **given, should_stop=lambda: True)


def test_dates_are_seconds_and_numbers_stay_as_they_are():
    day, later = np.datetime64("2026-01-02", "D"), np.timedelta64(1_500_000_000, "ns")
    for one in ("s", "ms", "us", "ns"):
        assert as_seconds(day.astype(f"datetime64[{one}]")) == 1767312000
    assert as_seconds(day.astype("datetime64[ns]") + later) == 1767312001.5
    assert as_seconds(later) == 1.5 == as_seconds(datetime.timedelta(seconds=1.5))
    noon = datetime.datetime(2026, 1, 2, 12, tzinfo=datetime.timezone(datetime.timedelta(hours=12)))
    assert as_seconds(noon) == 1767312000
    assert as_seconds(1500) == 1500
