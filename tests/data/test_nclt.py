"""Sessions of NCLT: poses by the nearest stamp, frames turned and not mirrored, one clear error for every flaw."""

from pathlib import Path

import numpy as np
import pytest

from sglpr_jax.bev import rasterize
from sglpr_jax.data.formats.scan_files import read_scan
from sglpr_jax.data.mounting import MODEL_HEIGHT_M
from sglpr_jax.data.readers import open_recording, recording_names
from sglpr_jax.grid import Grid

DATE = "2012-01-15"
FIRST = 1326652795280148
NAN_ROWS = f"{FIRST - 30_000_000},NaN,NaN,NaN,NaN,NaN,NaN\n{FIRST - 20_000_000}, nan, nan, nan, nan, nan, nan\n"
ROWS = (
    f"{FIRST - 40_000},1,2,3,0,0,0\n{FIRST + 10_000},4,5,6,0.1,0.2,0.3\n{FIRST + 90_000},7.5,-8,9,0,0,0\n"
    f"{FIRST + 160_000},NaN,1,1,0,0,0\n"
)


def write_scan(root: Path, utime: int, points: int = 3) -> Path:
    path = root / DATE / "velodyne_sync" / f"{utime}.bin"
    path.parent.mkdir(parents=True, exist_ok=True)
    np.full((points, 4), 20_000, dtype="<u2").tofile(path)
    return path


@pytest.fixture
def root(tmp_path) -> Path:
    """Three scans: a pose is near to the first two, the third comes 10 s after the last pose."""
    for utime in (FIRST, FIRST + 100_000, FIRST + 10_000_000):
        write_scan(tmp_path, utime)
    (tmp_path / DATE / f"groundtruth_{DATE}.csv").write_text(NAN_ROWS + ROWS)
    return tmp_path


def test_each_scan_has_the_nearest_pose_and_those_without_are_left_out(root):
    assert recording_names(root) == (DATE,)
    session = open_recording(root, DATE)
    assert not session.has_images
    assert session.ids == (str(FIRST), str(FIRST + 100_000)) and session.name == DATE
    np.testing.assert_array_equal(session.positions, [[4, -5, -6], [7.5, 8, -9]])  # north, west, up
    np.testing.assert_allclose(session.times, [FIRST / 1e6, FIRST / 1e6 + 0.1], rtol=1e-12)
    assert session.pose_source == f"groundtruth_{DATE}.csv (1 of 3 scans left out: no pose within 0.5 s)"
    assert not session.has_labels and session.points(1).shape == (3, 3)


def test_points_are_brought_to_the_height_that_models_know(root):
    scan = open_recording(root, DATE).record(0)
    np.testing.assert_allclose(scan.upright_points, scan.points - [0, 0, MODEL_HEIGHT_M], rtol=1e-6)


@pytest.mark.parametrize("place", [".", DATE, "ground_truth"])
def test_the_ground_truth_is_found_in_any_of_three_places(root, place):
    (root / place).mkdir(exist_ok=True)
    (root / DATE / f"groundtruth_{DATE}.csv").rename(root / place / f"groundtruth_{DATE}.csv")
    assert len(open_recording(root, DATE)) == 2


def test_what_stands_on_the_left_is_on_the_left_of_the_image(root):
    """An object 10 m ahead and 5 m to the left, above the ground: in NCLT's frame y = -5 and z = -1."""
    body = np.array([[10.0, -5.0, -1.0]])
    records = np.zeros(1, dtype=[("xyz", "<u2", 3), ("rest", "u1", 2)])
    records["xyz"] = np.round((body + 100) / 0.005)
    records.tofile(root / DATE / "velodyne_sync" / f"{FIRST}.bin")
    points = open_recording(root, DATE).points(0)
    np.testing.assert_allclose(points, [[10, 5, 1]], atol=1e-5)
    image = np.asarray(rasterize(points, grid=Grid(resolution_m=1.0, height=40, width=40)))
    assert np.argwhere(image).tolist() == [[20 - 6, 20 + 10]]  # image[v, u]: forward to the right, left up


@pytest.mark.parametrize(
    "text, words",
    [
        ("", "expected rows of utime, x, y, z, roll, pitch, yaw, found an empty file"),
        (f"{FIRST},1,2,3,0,0,0\n{FIRST + 1},1,2\n", "expected rows of utime.*found malformed ones"),
        (f"{FIRST},1,2,3,0,0,0\n{FIRST - 1},1,2,3,0,0,0\n", f"expected a time >= {FIRST}, found {FIRST - 1}"),
        (
            "1326600000000000,1,2,3,0,0,0\n",
            r"expected poses within 0.5 s of the scans in .*velodyne_sync, found .* 52795.* s away",
        ),
    ],
)
def test_a_broken_ground_truth_is_named(root, text, words):
    (root / DATE / f"groundtruth_{DATE}.csv").write_text(text)
    with pytest.raises(ValueError, match=f"groundtruth_{DATE}.csv: {words}"):
        open_recording(root, DATE)


def test_a_scan_cut_short_or_of_another_name_is_refused(root):
    path = root / DATE / "velodyne_sync" / f"{FIRST}.bin"
    path.write_bytes(path.read_bytes()[:-3])
    with pytest.raises(ValueError, match=rf"{FIRST}.bin: expected 8 bytes for each point \(nclt\), found 21"):
        open_recording(root, DATE).points(0)
    path.rename(path.with_name("first.bin"))
    with pytest.raises(ValueError, match=r"expected scans named by their time, .* found first.bin"):
        open_recording(root, DATE)


def test_the_real_scan_is_what_numpy_makes_of_its_bytes(shared, tmp_path):
    source = shared / f"data/samples/nclt/velodyne_sync/{FIRST}.bin"
    copy = tmp_path / DATE / "velodyne_sync" / source.name
    copy.parent.mkdir(parents=True)
    copy.write_bytes(source.read_bytes())
    (tmp_path / f"groundtruth_{DATE}.csv").write_text(ROWS)
    raw = np.frombuffer(source.read_bytes(), dtype="<u2").reshape(-1, 4)[:, :3].astype(np.float64)
    x, y, z = (raw * 0.005 - 100).T
    points = open_recording(tmp_path, DATE).points(0)
    np.testing.assert_array_equal(points, np.stack([x, -y, -z], axis=1).astype(np.float32))


def test_the_real_sensor_is_upside_down_above_the_bodys_origin(shared):
    """Its lasers, told apart by their numbers, have the data sheet's elevations negated, seen from 1.03 m."""
    path = shared / f"data/samples/nclt/velodyne_sync/{FIRST}.bin"
    laser = np.frombuffer(path.read_bytes(), dtype="u1").reshape(-1, 8)[:, 7].astype(int)
    sheet = np.where(laser % 2 == 0, -30.67, -9.33) + laser // 2 * (4 / 3)
    x, y, z = read_scan(path).T
    elevation = np.degrees(np.arctan2(z - 1.03, np.hypot(x, y)))
    assert np.median(np.abs(elevation + sheet)) < 0.05 < 1 < np.median(np.abs(elevation - sheet))
