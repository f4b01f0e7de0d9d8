"""What each point of a headerless scan is, found from the files: all layouts, and files that do not tell."""

import numpy as np
import pytest

from sglpr_jax.data.formats.bin_records import detect_format_unless_kitti, detect_point_format
from sglpr_jax.data.formats.scan_files import read_scan
from sglpr_jax.data.readers import open_recording as open_any
from sglpr_jax.files import DataWarning

BEAMS = np.radians(np.linspace(-15, 15, 16))
FIRING = np.arange(16).reshape(2, 8).T.reshape(-1)
"""Low and high beams in turn, as a VLP-16 fires."""


def open_recording(folder, **options):
    return open_any(folder, sensor_height=1.7, **options)


def scan(seed: int, *, steps: int = 180) -> np.ndarray:
    """A turn of 16 beams in a street: the ground 1.8 m below, houses on both sides; beam by beam in firing order."""
    rng = np.random.default_rng(seed)
    azimuth = np.repeat(np.linspace(0, 2 * np.pi, steps, endpoint=False), 16)
    elevation = np.tile(BEAMS[FIRING], steps)
    wall = (7 + 3 * rng.random()) / np.maximum(np.abs(np.sin(azimuth)), 0.1)
    ground = 1.8 / np.maximum(-np.tan(elevation), 1e-3)
    reach = np.minimum(wall, ground) + rng.normal(scale=0.02, size=len(azimuth))
    return np.stack([reach * np.cos(azimuth), reach * np.sin(azimuth), reach * np.tan(elevation)], axis=1)


def columns(points: np.ndarray, more: str) -> np.ndarray:
    """The points with further columns: i intensity, r ring, t time, 0 padding, n a part of a normal."""
    rng, n = np.random.default_rng(9), len(points)
    made = {
        "i": np.floor(rng.random(n) * 256),
        "r": np.tile(np.arange(16.0), n // 16 + 1)[:n],
        "t": np.linspace(0, 0.1, n),
        "0": np.zeros(n),
        "n": rng.normal(size=n) / 3,
    }
    return np.column_stack([points, *(made[name] for name in more)])


SHUFFLED = np.random.default_rng(0).permutation(scan(0))
LAYOUTS = {
    "float32x3": "",
    "kitti": "i",
    "float32x5": "ir",
    "float32x6": "irt",
    "float32x7": "innn",
    "float32x8": "0i0000"[:5],
    "float64x3": "",
    "float64x4": "i",
    "float64x5": "it",
    "float64x6": "irt",
}


@pytest.mark.parametrize("order", ["fired", "shuffled with gaps"])
@pytest.mark.parametrize("layout", LAYOUTS)
def test_every_layout_is_found(tmp_path, layout, order):
    written = []
    for i in range(3):
        points = scan(i)[: 2880 - 160 * i]  # a multiple of 16 points: every size can be divided by 16
        if order != "fired":
            points = points[np.random.default_rng(i).permutation(len(points))]
            points[np.random.default_rng(i).random(len(points)) < 0.3] = np.nan
        records = columns(points, LAYOUTS[layout]).astype("<f8" if layout.startswith("float64") else "<f4")
        records.tofile(tmp_path / f"{i}.bin")
        assert records.nbytes % 16 == 0
        written.append(points.astype(np.float32))
    recording = open_recording(tmp_path)
    assert recording.found[0].startswith(f"format: {layout} (") and "found from 3 of 3 scans" in recording.found[0]
    np.testing.assert_array_equal(recording.points(1), written[1])
    np.testing.assert_array_equal(read_scan(tmp_path / "1.bin"), written[1])


def test_a_broken_file_among_others_does_not_hide_it(tmp_path):
    for i in range(5):
        columns(scan(i), "irt").astype("<f4").tofile(tmp_path / f"{i}.bin")
    (tmp_path / "4.bin").write_bytes(np.random.default_rng(0).bytes(48000))
    (tmp_path / "0.bin").write_bytes(b"")
    assert detect_point_format(sorted(tmp_path.iterdir()))[0] == "float32x6"
    assert detect_format_unless_kitti(sorted(tmp_path.iterdir())) == "float32x6"


@pytest.mark.parametrize(
    ("points", "why"),
    [
        (scan(0) * 1000, "of the points not finite or beyond 300 m"),
        (np.zeros((2880, 3)), "all points NaN or 0"),
        (np.full((2880, 3), 4.0), "all points with the same x or y"),
        (columns(SHUFFLED, "i").T.reshape(-1, 4)[:, :3], "kitti (16 bytes a point): x, y and z distributed alike"),
    ],
    ids=["millimetres", "zeros", "one point", "column after column"],
)
def test_what_fits_nothing_is_refused_with_what_was_tried(tmp_path, points, why):
    for i in range(3):
        columns(points, "0").astype("<f4").tofile(tmp_path / f"{i}.bin")
    with pytest.raises(
        ValueError, match=r"expected scans that fit exactly one format, found 0; pass --format"
    ) as error:
        open_recording(tmp_path)
    assert why in str(error.value) and "kitti (16 bytes a point)" in str(error.value) and "\n" not in str(error.value)


def test_what_fits_twice_is_refused_and_may_be_said(tmp_path):
    noise = np.random.default_rng(0).normal(size=(4002, 4)) * [10, 30, 10, 30]  # columns 0 and 2, 1 and 3 alike
    noise = noise.astype("<f4")
    noise.tofile(tmp_path / "0.bin")
    with pytest.raises(ValueError, match=r"found 2; pass --format kitti or float32x6, .*float32x8[^;]*: fits"):
        open_recording(tmp_path)
    np.testing.assert_array_equal(open_recording(tmp_path, format="float32x4").points(0), noise[:, :3])
    assert open_recording(tmp_path, format="float32x6").points(0).shape == (2668, 3)


def test_a_wrong_format_that_was_said_is_told(tmp_path):
    for i in range(2):
        columns(scan(i), "irt").astype("<f4").tofile(tmp_path / f"{i}.bin")
    with pytest.warns(DataWarning, match=r"expected scans of kitti \(16 bytes a point\), found every .th point"):
        open_recording(tmp_path, format="kitti")


def test_own_scans_in_the_layout_of_kitti(kitti_root):
    """Read as what they are; a fixture of a few points, and scans that are KITTI's, as KITTI's."""
    assert open_recording(kitti_root).found[0] == "format: kitti (16 bytes a point)"
    for layout, said in (
        ("float32x6", "float32x6 (24 bytes a point), not KITTI's"),
        ("kitti", "kitti (16 bytes a point)"),
    ):
        for i, path in enumerate(sorted((kitti_root / "sequences/08/velodyne").iterdir())):
            columns(scan(i), LAYOUTS[layout]).astype("<f4").tofile(path)
        recording = open_recording(kitti_root)
        assert recording.found[0] == f"format: {said}"
        np.testing.assert_array_equal(recording.points(1), scan(1).astype(np.float32))
    assert open_recording(kitti_root, format="float64x3").found[0] == "format: float64x3, as given"


def test_a_small_square_room_is_a_scan(tmp_path):
    rng = np.random.default_rng(0)
    directions = rng.normal(size=(208, 3)) * [1, 1, 0.5]
    room = directions * (np.array([1.5, 1.5, 1.3]) / np.abs(directions)).min(axis=1, keepdims=True)
    columns(room, "i").astype("<f4").tofile(tmp_path / "0.bin")
    assert read_scan(tmp_path / "0.bin").shape == (208, 3)


def test_one_scan_with_few_points_is_kittis(tmp_path):
    columns(scan(0)[:150], "i").astype("<f4").tofile(tmp_path / "0.bin")
    assert read_scan(tmp_path / "0.bin").shape == (150, 3)


@pytest.mark.parametrize("name", ["not finite", "bytes of ones", "random bytes", "four columns", "other byte order"])
def test_a_scan_that_is_not_what_its_name_says_is_told(tmp_path, name):
    whole = columns(scan(0)[:2000], "ii").astype("<f4")
    contents = {
        "not finite": np.full_like(whole, np.nan).tobytes(),
        "bytes of ones": b"\xff" * whole.nbytes,
        "random bytes": np.random.default_rng(0).bytes(whole.nbytes),
        "four columns": np.ascontiguousarray(whole[:, :4]).tobytes(),
        "other byte order": whole.astype(">f4").tobytes(),
    }
    path = tmp_path / "a.pcd.bin"
    path.write_bytes(whole.tobytes())
    assert read_scan(path).shape == (len(whole), 3)
    path.write_bytes(contents[name])
    with pytest.warns(DataWarning, match=r"a\.pcd\.bin: expected scans of nuscenes \(20 bytes a point\), found"):
        read_scan(path)


@pytest.mark.slow
def test_real_scans(shared, tmp_path):
    """Real scans of four sensors in every layout."""
    samples = shared / "data/samples"
    clouds = [
        np.nan_to_num(read_scan(samples / "16_beams.pcd")),
        read_scan(samples / "nuscenes_32_beams.pcd.bin"),
        read_scan(samples / "nclt/velodyne_sync/1326652795280148.bin"),
        read_scan(next(iter(sorted((shared / "data/kitti_odometry/sequences/00/velodyne").glob("*.bin"))))),
    ]
    for cloud in clouds:
        for layout, more in LAYOUTS.items():
            records = columns(cloud[: len(cloud) // 16 * 16], more)
            records.astype("<f8" if layout.startswith("float64") else "<f4").tofile(tmp_path / "0.bin")
            assert detect_point_format([tmp_path / "0.bin"])[0] == layout
