"""A bag is replayed at its own pace, with the times and poses of its messages."""

import time

import numpy as np
import pytest

from sglpr_jax.live.options import LiveOptions
from sglpr_jax.live.sources_and_sinks import open_source
from tests.bags import CLOUD, POSE, cloud, pose, write_bag

POINTS = np.random.default_rng(0).normal(size=(300, 3)).astype(np.float32)
STAMP = 1_700_000_000.0


@pytest.fixture
def bag(tmp_path):
    """Ten clouds at 20 Hz, with poses."""
    messages = []
    for i in range(10):
        at = STAMP + 0.05 * i
        messages += [("/points", CLOUD, at, cloud("ros2", at, POINTS + i))]
        turned = (0, 0, np.sin(i / 20), np.cos(i / 20))
        messages += [("/odom", POSE, at, pose("ros2", at, (i, 0, 0), turned, POSE))]
    return write_bag(tmp_path / "drive", "ros2", messages)


def test_a_bag_is_replayed_as_fast_as_possible(bag, said):
    options = LiveOptions(rate=0.0, sensor_height=1.5, odometry_topic="/odom")
    frames = list(open_source(f"bag:{bag}", options, said).frames())
    np.testing.assert_allclose([frame.time for frame in frames], STAMP + 0.05 * np.arange(10))
    assert [frame.odometry[0, 3] for frame in frames] == pytest.approx(range(10), abs=1e-6)
    assert frames[3].scan.mounting.height_m == 1.5 and frames[3].scan.name.endswith("scan 000003")
    known = {frames[3].scan.name, frames[6].scan.name}
    rest = open_source(f"bag:{bag}", LiveOptions(rate=0.0), said, is_in_map=known.__contains__)
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


def test_a_topic_that_is_missing_is_named(bag, said):
    with pytest.raises(ValueError, match=r"/other"):
        open_source(f"bag:{bag}", LiveOptions(odometry_topic="/other"), said)
