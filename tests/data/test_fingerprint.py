"""A fingerprint changes if scans, mounting, positions or read options change."""

import dataclasses
import os
import shutil
from pathlib import Path

import numpy as np
from recordings import of_scans

from sglpr_jax.data.corruption import corrupted, corruption_named
from sglpr_jax.data.fingerprint import fingerprint
from sglpr_jax.data.mounting import Mounting
from sglpr_jax.data.readers import open_recording


def test_another_format_mounting_or_position_is_another_recording(tmp_path):
    rng = np.random.default_rng(0)
    for i in range(3):
        (rng.uniform(-20, 20, (480, 4)) * [1, 1, 0.1, 1]).astype("<f4").tofile(tmp_path / f"{i}.bin")
    one, other = (open_recording(tmp_path, format=format, sensor_height=1.73) for format in ("kitti", "float32x8"))
    moved = dataclasses.replace(one, positions=np.zeros((3, 3)))
    found = {fingerprint(one), fingerprint(other), fingerprint(moved)}
    found.add(fingerprint(dataclasses.replace(one, mounting=Mounting(1.0))))
    assert len(found) == 4
    assert fingerprint(one) == fingerprint(open_recording(tmp_path, format="kitti", sensor_height=1.73))


def test_a_corrupted_recording_is_another_one(tmp_path):
    recording = of_scans({tmp_path / "0.bin": np.ones((5, 3), np.float32)})
    noises = [
        corrupted(recording, corruption_named(name), seed=seed) for name, seed in (("noise-0.1", 0), ("noise-0.1", 1))
    ]
    assert len({fingerprint(recording), *map(fingerprint, noises)}) == 3


def rewrite(path: Path, content: bytes) -> None:
    """Edit a file in place, a second later."""
    later = path.stat().st_mtime_ns + 10**9
    path.write_bytes(content)
    os.utime(path, ns=(later, later))


def test_files_edited_in_place_and_other_labels_and_times_are_another_recording(tmp_path):
    scans, labels = [tuple(tmp_path / f"{i}.{end}" for i in range(3)) for end in ("bin", "label")]
    for path in (*scans, *labels):
        path.write_bytes(bytes(32))
    bare = of_scans(dict.fromkeys(scans, np.zeros((2, 3), np.float32)))
    recording = dataclasses.replace(bare, label_paths=(labels[0], None, labels[2]))
    found = [fingerprint(bare), fingerprint(recording)]
    for path in (scans[1], labels[2]):
        rewrite(path, bytes(31) + b"1")
        found.append(fingerprint(recording))
    for times in (np.arange(3.0), np.arange(3.0) + 1):
        found.append(fingerprint(dataclasses.replace(recording, times=times)))
    assert len(set(found)) == len(found)
    rewrite(labels[1], b"of no scan")
    assert fingerprint(recording) == found[3]


def test_a_copy_of_the_same_age_is_the_same_recording_and_scans_need_no_files(tmp_path):
    for name in ("one", "other"):
        (tmp_path / name).mkdir()
    (tmp_path / "one" / "0.bin").write_bytes(bytes(32))
    shutil.copy2(tmp_path / "one" / "0.bin", tmp_path / "other" / "0.bin")
    cloud = np.zeros((2, 3), np.float32)
    one, other, none = (fingerprint(of_scans({tmp_path / name / "0.bin": cloud})) for name in ("one", "other", "none"))
    assert one == other != none == fingerprint(of_scans({tmp_path / "none" / "0.bin": cloud}))
