"""One drive with times in every unit and by every road: the same loops, or one line that says what to state.

The drive goes around a circle: 200 frames of 40 s, then 80 frames of 16 s on the same street. The comparison of images
is replaced: it matches the nearest frame within 15 m that the detector does not consider recent.
"""

from pathlib import Path

import numpy as np
import pytest
from bags import typestore, write_bag
from recordings import of_scans

import sglpr_jax
from sglpr_jax.data import open_recording
from sglpr_jax.data.record import Record
from sglpr_jax.data.recording import Recording
from sglpr_jax.data.times import PER_SECOND
from sglpr_jax.data.warning import DataWarning
from sglpr_jax.loops.candidates import Compared
from sglpr_jax.loops.comparison import Candidate
from sglpr_jax.loops.config import CandidateConfig
from sglpr_jax.loops.detector import LoopDetector
from sglpr_jax.loops.explanation import why_few_queries
from sglpr_jax.loops.loop_files import write_tum
from sglpr_jax.loops.odometry import at_scans, read_odometry
from sglpr_jax.loops.probability import Curve, Evidence, LoopModel
from sglpr_jax.loops.seen import Seen
from sglpr_jax.loops.transforms import inverse, transform, yaw_of
from sglpr_jax.loops.verification import Alignment

LAP, FRAMES = 200, 280
SECONDS = np.arange(FRAMES) / 5
RADIUS_M = LAP * 2.0 / (2 * np.pi)
TURN = 2 * np.pi * np.arange(FRAMES) / LAP
POSES = np.stack([transform(RADIUS_M * np.cos(a), RADIUS_M * np.sin(a), a + np.pi / 2) for a in TURN])
STAMPS = {unit: SECONDS * PER_SECOND[unit] for unit in ("s", "ms", "us", "ns")} | {"rows": np.arange(float(FRAMES))}
SAME = {(query, max(query - LAP, 0)) for query in range(LAP - 7, FRAMES)}
SEARCHED: dict[bytes, set[tuple[int, int]]] = {}
OTHER_UNIT = "expected times in seconds, found steps of .*, which fit (milli|micro|nano)seconds; state the unit"


@pytest.fixture(scope="module")
def params():
    return sglpr_jax.load("circular")


def detector_of(params, **options) -> LoopDetector:
    """A detector whose images match wherever a frame within 15 m is not recent."""
    detector = LoopDetector(params, model=LoopModel({"distance": Curve((0.0,), (0.0,))}, 6.0, "by hand"), **options)
    finder = detector.finder
    seen = Seen(np.zeros(finder.index.width, np.float32), np.ones((152, 152), np.uint8), None)

    def compared(seen, time, pose, clock, *, continues):
        query = len(finder)
        rows = finder.stored.frames[~finder._excluded(time, pose, continues=continues)]
        finder.motion.add(clock, pose=POSES[query])
        apart = np.linalg.norm(POSES[rows, :2, 3] - POSES[query, :2, 3], axis=1)
        if not len(rows) or apart.min() > 15:
            return Compared([], None)
        match = int(rows[apart.argmin()])
        true = inverse(POSES[match]) @ POSES[query]
        alignment = Alignment(*true[:2, 3], yaw_of(true), np.diag([0.1, 0.1, 0.01]), 0.8, 0.3)
        return Compared([Candidate(query, match, alignment, Evidence.of(1.0, 0.5, 0.8, 0.3, 0.3, 1e3))], None)

    finder.seen, finder._compared = lambda record: seen, compared
    finder.is_empty = lambda image: False
    return detector


def found_in(detector: LoopDetector, times) -> set[tuple[int, int]]:
    """The loops of a drive whose frames are added with these times."""
    for i in range(FRAMES):
        detector.add(Record(points=np.zeros((1, 3), np.float32)), time=None if times is None else times[i])
    return {(loop.query, loop.match) for loop in detector.loops}


def loops_of(params, recording: Recording) -> set[tuple[int, int]]:
    """The loops of a recording. Equal times are searched once."""
    if recording.times is None:
        return found_in(detector_of(params), None)
    times = np.round(recording.times - recording.times[0], 6)
    if times.tobytes() not in SEARCHED:
        SEARCHED[times.tobytes()] = found_in(detector_of(params, time_unit="s"), times)
    return SEARCHED[times.tobytes()]


def clouds(times=None) -> Recording:
    return of_scans({Path(f"{i:03d}.bin"): np.zeros((1, 3), np.float32) for i in range(FRAMES)}, times=times)


def by_odometry(folder: Path, stamps, unit="auto") -> Recording:
    write_tum(folder / "odometry.tum", POSES, stamps)
    poses = read_odometry(folder / "odometry.tum", time_unit=unit)
    return at_scans(clouds(), poses, folder / "odometry.tum", format="auto", time_unit=unit)[0]


def scans_in(folder: Path) -> Path:
    scans = folder / "scans"
    scans.mkdir()
    for i in range(FRAMES):
        np.zeros((3, 4), "<f4").tofile(scans / f"{i:03d}.bin")
    return scans


def by_poses_beside_scans(folder: Path, stamps, unit="auto") -> Recording:
    scans = scans_in(folder)
    write_tum(scans / "poses.tum", POSES, stamps)
    return open_recording(scans, sensor_height=1.7, time_unit=unit)


def by_times_file(folder: Path, stamps, unit="auto") -> Recording:
    scans = scans_in(folder)
    np.savetxt(scans / "times.txt", stamps, fmt="%.9f")
    return open_recording(scans, sensor_height=1.7, time_unit=unit)


ROADS = (by_odometry, by_poses_beside_scans, by_times_file)


@pytest.mark.slow
@pytest.mark.parametrize("road", ROADS)
def test_seconds_in_a_file_give_the_loops(params, tmp_path, road):
    assert loops_of(params, road(tmp_path, STAMPS["s"])) == SAME


@pytest.mark.parametrize("unit", ["ms", "us", "ns"])
@pytest.mark.parametrize("road", ROADS)
def test_other_units_in_a_file_are_one_line_and_the_same_loops_if_stated(params, tmp_path, road, unit):
    (tmp_path / "again").mkdir()
    with pytest.raises(ValueError, match=rf"\.(tum|txt): {OTHER_UNIT} with --time-unit"):
        road(tmp_path, STAMPS[unit])
    assert loops_of(params, road(tmp_path / "again", STAMPS[unit], unit)) == SAME


@pytest.mark.slow
@pytest.mark.parametrize("road", ROADS)
def test_row_numbers_in_a_file_are_no_times(params, tmp_path, road, recwarn):
    recording = road(tmp_path, STAMPS["rows"]) if road is not by_times_file else None
    if recording is None:
        with pytest.warns(DataWarning, match=r"times\.txt: expected times, found row numbers"):
            recording = road(tmp_path, STAMPS["rows"])
    assert recording.times is None and loops_of(params, recording) == set()
    said = "280 frames without times: pairs less than 290 frames apart are not considered; give --times."
    assert why_few_queries(recording, CandidateConfig()) == said


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
def test_a_bag_has_the_seconds_of_its_headers_or_of_its_recorder(params, tmp_path, headers):
    own = np.zeros(FRAMES) if headers == "none" else STAMPS[headers] + 1
    recording = open_recording(written_bag(tmp_path, own, 1.7e9 + SECONDS), sensor_height=1.7)
    assert recording.times[0] == (1 if headers == "s" else 1.7e9)
    assert loops_of(params, recording) == SAME


def test_a_bag_without_seconds_has_no_times(tmp_path):
    path = written_bag(tmp_path, np.zeros(FRAMES), STAMPS["rows"] + 1)
    with pytest.warns(
        DataWarning, match=r"drive\.bag, /points: expected times in seconds .* found row numbers .*not used"
    ):
        assert open_recording(path, sensor_height=1.7).times is None


FROM_PYTHON = {
    "seconds": 1.7e9 + SECONDS,
    "datetime64": np.datetime64("2026-01-02T03:04:05", "ns") + (SECONDS * 1e9).astype("timedelta64[ns]"),
}


@pytest.mark.slow
@pytest.mark.parametrize("times", FROM_PYTHON.values(), ids=FROM_PYTHON)
def test_seconds_and_dates_from_python_give_the_loops(params, times):
    assert found_in(detector_of(params), times) == SAME


@pytest.mark.slow
@pytest.mark.parametrize("unit", ["ms", "us", "ns"])
def test_other_units_from_python_are_one_line_as_soon_as_steps_show_them(params, unit):
    detector = detector_of(params)
    with pytest.raises(ValueError, match=rf"frame 5: {OTHER_UNIT} with LoopDetector\(\.\.\., time_unit=\.\.\.\)"):
        found_in(detector, STAMPS[unit])
    assert len(detector) == 5 and not detector.loops
    with pytest.raises(ValueError, match=r"frame 0: expected times in seconds, found .*, after the year 5000"):
        found_in(detector_of(params), (1.7e9 + SECONDS) * PER_SECOND[unit])
    assert found_in(detector_of(params, time_unit=unit), STAMPS[unit]) == SAME


def test_a_unit_that_changes_from_python_is_one_line_as_soon_as_steps_show_it(params):
    times = 5 + np.array(SECONDS)
    times[7:] *= 1e9
    with pytest.raises(ValueError, match=r"frame 9: expected times in the unit of those before, found .* after 6\.2"):
        found_in(detector_of(params), times)


def test_row_numbers_from_python_are_one_line_and_no_times_are_frames(params):
    with pytest.raises(ValueError, match=r"frame 5: expected times in seconds, found row numbers \(0, 1, 2, \.\.\.\)"):
        found_in(detector_of(params), STAMPS["rows"])
    assert found_in(detector_of(params), None) == set()


def test_a_recording_made_in_python_is_warned_of(params):
    for times in (STAMPS["ms"], STAMPS["rows"]):
        with pytest.warns(DataWarning, match=r"08: expected times in seconds, found (steps of 200|row numbers)"):
            sglpr_jax.find_loops(clouds(times), params, should_stop=lambda: True)
