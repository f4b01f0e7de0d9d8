"""Odometry that most loops contradict is told, drift is not."""

from collections.abc import Mapping
from pathlib import Path
from types import MappingProxyType

import numpy as np
import pytest
from recordings import of_scans

import sglpr_jax
from sglpr_jax.data.formats.pose_files import CAMERA_FROM_LIDAR
from sglpr_jax.data.levelling import check_level
from sglpr_jax.data.mounting import Mounting
from sglpr_jax.data.warning import DataWarning
from sglpr_jax.loops import search
from sglpr_jax.loops.acceptance import check_odometry
from sglpr_jax.loops.candidates import Compared
from sglpr_jax.loops.closure import Loop, Rejected
from sglpr_jax.loops.comparison import NO_FITS
from sglpr_jax.loops.config import DetectorConfig
from sglpr_jax.loops.detector import LoopDetector
from sglpr_jax.loops.keyframes import Seen
from sglpr_jax.loops.probability import AdditiveModel, Curve, LoopModel
from sglpr_jax.se3 import inverse, transform

N = 40
ALWAYS = LoopModel(AdditiveModel({"deviation": Curve((0.0,), (0.0,))}, 10.0), "everything")
CONFIG = DetectorConfig()


@pytest.fixture(scope="module")
def params():
    return sglpr_jax.load("circular")


@pytest.fixture(scope="module")
def there_and_back() -> np.ndarray:
    """Poses along a bend, 2 m apart, and back, now nearer to the first lane, now farther from it."""
    there = np.stack([transform(20 * np.sin(a), 20 - 20 * np.cos(a), a) for a in np.arange(N) / 10])
    aside = np.stack([transform(0.0, 3 + 2 * np.sin(i), np.pi) for i in np.arange(N)])
    return np.concatenate([there, (there @ aside)[::-1]])


def searched(
    params, compare_only, poses: np.ndarray, odometry: np.ndarray, *, wrong: Mapping[int, int] = MappingProxyType({})
) -> LoopDetector:
    """The detector after a drive of which each frame of the way back has its true loop.

    `wrong` has frames before that, each with a match that looks as if it was the same place.
    """
    detector = LoopDetector(params, model=ALWAYS, config=CONFIG)
    seen = Seen(np.zeros(detector.finder.index.width, np.float32), np.ones((152, 152), np.uint8), None)
    true = {query: (2 * N - 1 - query, inverse(poses[2 * N - 1 - query]) @ poses[query]) for query in range(N, 2 * N)}
    compare_only(true | {query: (match, np.eye(4)) for query, match in wrong.items()})
    for pose in odometry:
        detector.add_seen(seen, odometry=pose, compared=Compared(NO_FITS, None))
    return detector


@pytest.fixture
def found(params, there_and_back, compare_only, monkeypatch):
    """What `find_loops` makes of the drive with this odometry; nothing is described, the detector has seen it all."""
    recording = of_scans({Path(f"{i}.bin"): np.zeros((1, 3), np.float32) for i in range(2 * N)})

    def found(odometry):
        detector = searched(params, compare_only, there_and_back, odometry)
        monkeypatch.setattr(search, "LoopDetector", lambda *_, **__: detector)
        return search.find_loops(recording, params, odometry=odometry, config=CONFIG, registered=False)

    return found


@pytest.mark.slow
@pytest.mark.parametrize("share", [1.0, 1.01])
def test_odometry_in_the_lidars_axes_agrees_with_the_loops_drifting_as_it_may(found, there_and_back, share):
    odometry = there_and_back.copy()
    odometry[:, :3, 3] *= share  # a warning is an error
    assert len(found(odometry).loops) >= N - 1


@pytest.mark.slow
def test_odometry_in_other_axes_is_told(found, there_and_back):
    forward_is_y = there_and_back @ transform(0.0, 0.0, np.pi / 2)
    words = r"08: the odometry contradicts the loops of \d\d of \d\d frames, .* use these axes: x forward"
    with pytest.warns(DataWarning, match=words):
        assert len(found(forward_is_y).loops) < N / 2


def test_odometry_in_the_cameras_axes_is_told_by_its_way_too(there_and_back):
    check_level(there_and_back, None, name="08")
    camera = CAMERA_FROM_LIDAR @ there_and_back @ CAMERA_FROM_LIDAR.T
    check_level(camera[:5], None, name="08")
    words = r"08: expected poses of a LiDAR that moves along the ground .*, found \d+ of \d+ m of path up or down"
    with pytest.warns(DataWarning, match=words):
        check_level(camera, None, name="08")
    forward = Mounting(1.0, (1.0, 0.0, 0.0))
    with pytest.warns(DataWarning, match=words):
        check_level(there_and_back, forward, name="08")


def test_a_few_loops_tell_nothing():
    few = [Rejected(Loop(query, 0, np.eye(4), np.eye(6), 1.0), "contradicts the odometry") for query in range(1, 5)]
    for rejected in (few, []):  # a warning is an error
        check_odometry("08", [], rejected, np.tile(np.eye(4), (5, 1, 1)), CONFIG)


@pytest.mark.slow
def test_loops_that_contradict_the_odometry_are_rejected_and_do_not_keep_the_true_ones_out(
    params, there_and_back, compare_only, monkeypatch
):
    """A few frames before the first revisit look like ten frames further on, again and again."""
    alike = range(N - 8, N)
    detector = searched(params, compare_only, there_and_back, there_and_back, wrong={i: i - 30 for i in alike})
    true = {loop.query for loop in detector.loops}
    wrong = {one.loop.query for one in detector.rejected}
    assert len(wrong) >= 7 and wrong <= set(alike) and not true & wrong and len(true) >= N - 1
    recording = of_scans({Path(f"{i}.bin"): np.zeros((1, 3), np.float32) for i in range(2 * N)})
    monkeypatch.setattr(search, "LoopDetector", lambda *_, **__: detector)
    whole = search.find_loops(recording, params, odometry=there_and_back, config=CONFIG, registered=False)
    assert {one.loop.query for one in whole.rejected} == wrong and len(whole.loops) >= N - 1
    assert {one.reason for one in whole.rejected} == {"contradicts the odometry"}
    assert str(whole).endswith(f"{len(wrong)} rejected (contradicts the odometry: {len(wrong)})")
