"""Times of a drive from the headers of a bag, from its recorder, and from Python."""

from pathlib import Path

import numpy as np
import pytest
from bags import typestore, write_bag

import sglpr_jax
from sglpr_jax.data.readers import open_recording
from sglpr_jax.data.times import PER_SECOND
from sglpr_jax.data.warning import DataWarning
from sglpr_jax.se3 import transform

FRAMES = 40
SECONDS = np.arange(FRAMES) / 5
STAMPS = {unit: SECONDS * PER_SECOND[unit] for unit in ("s", "ms", "us")} | {"rows": np.arange(float(FRAMES))}


def written_bag(folder: Path, headers, recorded) -> Path:
    """A bag of small clouds with these times in the headers and of the recorder."""
    store = typestore("ros1").types
    field, name = store["sensor_msgs/msg/PointField"], "sensor_msgs/msg/PointCloud2"
    head, time = store["std_msgs/msg/Header"], store["builtin_interfaces/msg/Time"]
    layout = {
        "height": 1,
        "width": 1,
        "fields": [field(name=axis, offset=4 * i, datatype=7, count=1) for i, axis in enumerate("xyz")],
        "is_bigendian": False,
        "point_step": 12,
        "row_step": 12,
        "data": np.zeros(12, np.uint8),
        "is_dense": True,
    }
    messages = [
        (
            "/points",
            name,
            late,
            store[name](head(seq=0, stamp=time(int(own), round(own % 1 * 1e9)), frame_id="lidar"), **layout),
        )
        for own, late in zip(headers.tolist(), recorded.tolist(), strict=True)
    ]
    return write_bag(folder / "drive.bag", "ros1", messages)


@pytest.mark.parametrize("headers", ["s", "ms", "us", "rows", "none"])
def test_a_bag_has_the_seconds_of_its_headers_or_of_its_recorder(tmp_path, headers):
    own = np.zeros(FRAMES) if headers == "none" else STAMPS[headers] + 1
    recording = open_recording(written_bag(tmp_path, own, 1.7e9 + SECONDS), sensor_height=1.7)
    np.testing.assert_allclose(recording.times, SECONDS + (1 if headers == "s" else 1.7e9))


def test_a_bag_without_seconds_has_no_times(tmp_path):
    path = written_bag(tmp_path, np.zeros(FRAMES), STAMPS["rows"] + 1)
    with pytest.warns(
        DataWarning, match=r"drive\.bag, /points: expected times in seconds .* found row numbers .*not used"
    ):
        assert open_recording(path, sensor_height=1.7).times is None


DATES = np.datetime64("2026-01-02T03:04:05", "ns") + (SECONDS * 1e9).astype("timedelta64[ns]")


@pytest.mark.parametrize(
    "times", [*STAMPS.values(), DATES, np.zeros(FRAMES), None], ids=[*STAMPS, "dates", "0", "none"]
)
def test_times_from_python_in_any_unit_give_the_same_loops(compare_only, times):
    """A circle of 60 m that is driven around twice."""
    angles = 2 * np.pi * np.arange(FRAMES) / (FRAMES // 2)
    poses = [transform(30 * np.cos(a) / np.pi, 30 * np.sin(a) / np.pi, a) for a in angles]
    pairs = {query: query - FRAMES // 2 for query in range(FRAMES // 2, FRAMES)}
    compare_only({query: (match, np.eye(4)) for query, match in pairs.items()})
    detector = sglpr_jax.LoopDetector(sglpr_jax.load("circular"))
    for i, pose in enumerate(poses):
        detector.add(np.eye(152), time=None if times is None else times[i], odometry=pose)
    assert {loop.query: loop.match for loop in detector.loops} == pairs
