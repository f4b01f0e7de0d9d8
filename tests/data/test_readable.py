"""Scans that cannot be read are left out before anything is made of the others."""

import dataclasses
from pathlib import Path

import numpy as np
import pytest
from recordings import of_images, of_scans, with_points

from sglpr_jax.data.scan_stream import readable

CLOUDS = {Path(f"{i}.bin"): np.full((5, 3), i + 1, np.float32) for i in range(4)}


def broken(path: Path) -> np.ndarray:
    if path.stem == "1":
        raise ValueError("1.bin: expected points, found none")
    return np.full((5, 3), np.nan, np.float32) if path.stem == "3" else CLOUDS[path]


def test_a_recording_of_good_scans_stays_as_it_is():
    recording, done = of_scans(CLOUDS), []
    assert readable(recording, on_bad_scan=pytest.fail, on_progress=done.append) is recording
    assert done == [1, 2, 3, 4]


def test_what_belongs_to_a_bad_scan_goes_with_it():
    whole = of_scans(CLOUDS, positions=np.arange(12.0).reshape(4, 3), times=np.arange(4.0))
    bad = []
    found = readable(with_points(whole, broken), on_bad_scan=lambda scan, error: bad.append((scan, str(error))))
    assert found.ids == ("0", "2") and found.times.tolist() == [0, 2] and found.positions[:, 0].tolist() == [0, 6]
    np.testing.assert_array_equal(found.points(1), CLOUDS[Path("2.bin")])
    assert [scan for scan, _ in bad] == ["1", "3"]
    assert "1.bin: expected points" in bad[0][1] and "scan 3 of sequence 08: expected finite points" in bad[1][1]


def test_labels_that_do_not_fit_make_a_bad_scan(tmp_path):
    labels = tmp_path / "0.label"
    labels.write_bytes(bytes(4 * 4))
    recording = of_scans(CLOUDS, label_paths=(labels, None, None, None))
    bad = []
    found = readable(recording, on_bad_scan=lambda scan, error: bad.append(scan))
    assert bad == ["0"] and found.label_paths == (None, None, None)


def test_images_are_read_too():
    images = {Path(f"{i}.png"): np.ones((4, 4), np.float32) for i in range(2)}
    assert len(readable(of_images(images), on_bad_scan=pytest.fail)) == 2


def test_nothing_to_read_is_an_error():
    with pytest.raises(ValueError, match="sequence 08: expected at least one readable scan, found none"):
        readable(with_points(of_scans({Path("1.bin"): CLOUDS[Path("1.bin")]}), broken), on_bad_scan=lambda *_: None)


def test_a_recording_without_labels_keeps_none():
    whole = dataclasses.replace(with_points(of_scans(CLOUDS), broken), label_paths=())
    assert readable(whole, on_bad_scan=lambda *_: None).label_paths == ()
