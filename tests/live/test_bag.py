"""A bag is replayed at its own pace, with the times and poses of its messages."""

import time
from pathlib import Path

import numpy as np
import pytest

from sglpr_jax.live.options import LiveOptions
from sglpr_jax.live.sources_and_sinks import open_source
from tests.bags import CLOUD, POSE, cloud, pose, write_bag

POINTS = np.random.default_rng(0).normal(size=(300, 3)).astype(np.float32)
STAMP = 1_700_000_000.0


def written(path: Path, *, poses: int = 10) -> Path:
    """A bag of ten clouds at 20 Hz, of which the first have poses."""
    messages = []
    for i in range(10):
        at = STAMP + 0.05 * i
        messages += [("/points", CLOUD, at, cloud("ros2", at, POINTS + i))]
        turned = (0, 0, np.sin(i / 20), np.cos(i / 20))
        messages += [("/odom", POSE, at, pose("ros2", at, (i, 0, 0), turned, POSE))] * (i < poses)
    return write_bag(path, "ros2", messages)


@pytest.fixture
def bag(tmp_path):
    return written(tmp_path / "drive")


def test_a_bag_is_replayed_as_fast_as_possible(bag, said):
    options = LiveOptions(rate=0.0, sensor_height=1.5, odometry_topic="/odom")
    frames = list(open_source(f"bag:{bag}", options, said).frames())
    np.testing.assert_allclose([frame.time for frame in frames], STAMP + 0.05 * np.arange(10))
    assert [frame.odometry[0, 3] for frame in frames] == pytest.approx(range(10), abs=1e-6)
    assert frames[3].scan.mounting.height_m == 1.5 and frames[3].scan.name.endswith("scan 000003")
    known = {frames[3].scan.name, frames[6].scan.name}
    rest = open_source(f"bag:{bag}", LiveOptions(rate=0.0), said, map_names=known)
    assert [frame.time for frame in rest.frames()] == [frame.time for frame in frames[7:]]


def test_a_bag_is_replayed_at_its_own_pace_and_drops_what_is_late(bag, said):
    source = open_source(f"bag:{bag}", LiveOptions(), said)
    begin, found = time.monotonic(), []
    for frame in source.frames():
        if frame is not None:
            found.append(frame)
            time.sleep(0.11)
    assert time.monotonic() - begin > 0.45 and source.dropped > 0
    assert len(found) + source.dropped == 10 and found[-1].time == pytest.approx(STAMP + 0.45)
    assert found[0].odometry is None


def test_scans_without_a_pose_come_if_no_odometry_is_wanted(tmp_path, said):
    source = open_source(f"bag:{written(tmp_path / 'drive', poses=6)}", LiveOptions(rate=0.0, sensor_height=1.5), said)
    assert len(list(source.frames())) == 10


def test_a_topic_that_is_missing_is_named(bag, said):
    with pytest.raises(ValueError, match=r"/other"):
        open_source(f"bag:{bag}", LiveOptions(odometry_topic="/other"), said)
