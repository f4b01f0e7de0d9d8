"""Single scans: every format becomes metres, x forward, y left, z up; a file of another size is refused."""

from pathlib import Path

import numpy as np
import pytest

from sglpr_jax.data.formats.scan_files import named_format, read_labels, read_scan, read_scan_records, scan_id


def test_kitti_keeps_its_axes(tmp_path):
    path = tmp_path / "000000.bin"
    np.array([[1, 2, 3, 0.5], [4, 5, np.nan, 0.5]], dtype="<f4").tofile(path)
    points = read_scan(path)
    np.testing.assert_array_equal(points, np.float32([[1, 2, 3], [4, 5, np.nan]]))
    assert points.flags.f_contiguous


def test_nuscenes_turns_right_and_forward_into_forward_and_left(tmp_path):
    path = tmp_path / "sweep.pcd.bin"
    np.array([[1, 2, 3, 0.5, 31]], dtype="<f4").tofile(path)
    np.testing.assert_array_equal(read_scan(path), [[2, -1, 3]])
    np.testing.assert_array_equal(read_scan_records(path)[1], [31])


def test_nclt_is_decoded_in_double_precision_and_turned_not_mirrored(tmp_path):
    path = tmp_path / "velodyne_sync" / "1326652795280148.bin"
    path.parent.mkdir()
    raw = np.array([[20001, 20002, 20003], [0, 65535, 7]], dtype="<u2")
    records = np.zeros(2, dtype=[("xyz", "<u2", 3), ("rest", "u1", 2)])
    records["xyz"], records["rest"] = raw, [[200, 5], [100, 31]]
    records.tofile(path)
    metres = raw.astype(np.float64) * 0.005 - 100
    expected = np.stack([metres[:, 0], -metres[:, 1], -metres[:, 2]], axis=1).astype(np.float32)
    np.testing.assert_array_equal(read_scan(path), expected)
    np.testing.assert_array_equal(read_scan_records(path)[1], [5, 31])


@pytest.mark.parametrize(
    "name, format, stem",
    [
        ("velodyne/000052.bin", None, "000052"),
        ("sweeps/a__LIDAR_TOP__1.pcd.bin", "nuscenes", "a__LIDAR_TOP__1"),
        ("velodyne_sync/1326652795280148.bin", "nclt", "1326652795280148"),
        ("clouds/16_beams.pcd", "pcd", "16_beams"),
        ("clouds/16_BEAMS.PCD", "pcd", "16_BEAMS"),
        ("clouds/1.25.bin", None, "1.25"),
    ],
)
def test_format_and_id_come_from_the_name(name, format, stem):
    assert named_format(Path(name)) == format
    assert scan_id(Path(name)) == stem


@pytest.mark.parametrize(
    "format, size, expected",
    [("kitti", 0, 16), ("kitti", 40, 16), ("nuscenes", 36, 20), ("nclt", 12, 8)],
)
def test_an_empty_or_cut_off_scan_names_file_sizes_and_formats(tmp_path, format, size, expected):
    path = tmp_path / "000000.bin"
    path.write_bytes(bytes(size))
    with pytest.raises(
        ValueError, match=rf"000000\.bin: expected {expected} bytes .*{format}.*found {size} bytes"
    ) as error:
        read_scan(path, format=format)
    assert all(other in str(error.value) for other in ("kitti", "nuscenes", "nclt", "pcd"))


def test_labels_lose_their_instance(tmp_path):
    path = tmp_path / "000000.label"
    np.array([10 + (3 << 16), 252], dtype="<u4").tofile(path)
    labels = read_labels(path, points=2)
    np.testing.assert_array_equal(labels, [10, 252])
    assert labels.dtype == np.int32


@pytest.mark.parametrize("size", [0, 4, 7, 12])
def test_labels_must_be_one_per_point(tmp_path, size):
    path = tmp_path / "000000.label"
    path.write_bytes(bytes(size))
    with pytest.raises(ValueError, match=rf"000000\.label: expected 2 labels of 4 bytes.*found {size} bytes"):
        read_labels(path, points=2)


def test_real_samples(shared):
    samples = shared / "data/samples"
    nclt = read_scan(samples / "nclt/velodyne_sync/1326652795280148.bin")
    nuscenes = read_scan(samples / "nuscenes_32_beams.pcd.bin")
    assert nclt.shape == (23546, 3)
    assert nuscenes.shape == (34688, 3)
    for points in (nclt, nuscenes):
        assert np.isfinite(points).all()
        assert np.abs(points).max() < 110
    # Up is up: buildings and trees reach higher above the sensor than the ground lies below it.
    assert nclt[:, 2].max() > 10 > 4 > -nclt[:, 2].min()
    # Forward is forward: the roof that carries the sensor is longer than it is wide.
    roof = nuscenes[np.linalg.norm(nuscenes, axis=1) < 1.5]
    assert np.ptp(roof[:, 0]) > 1.5 * np.ptp(roof[:, 1])
