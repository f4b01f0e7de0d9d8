"""Sequences of PandaSet: pickles are refused with the way out, converted scans come back into the LiDAR's frame."""

import json
import pickle
from pathlib import Path

import numpy as np
import pytest

from sglpr_jax.data.packed import packed
from sglpr_jax.data.readers import open_recording, recording_names
from sglpr_jax.retrieval.reuse import fingerprint

POINTS = np.array([[4.0, 10.0, -1.0], [-3.0, 20.0, 2.0]])
"""x to the right, y forward."""
POSITIONS = np.array([[0.0, 0.0, 0.0], [5.0, 1.0, 0.5], [9.0, 3.0, 0.7]])
HEADINGS = np.radians([0.0, 30.0, -75.0])


def turn(angle: float) -> np.ndarray:
    return np.array([[np.cos(angle), -np.sin(angle), 0], [np.sin(angle), np.cos(angle), 0], [0, 0, 1]])


def write_poses(folder: Path) -> None:
    poses = [
        {"position": dict(zip("xyz", at, strict=True)), "heading": dict(w=np.cos(a / 2), x=0, y=0, z=np.sin(a / 2))}
        for at, a in zip(POSITIONS.tolist(), HEADINGS.tolist(), strict=True)
    ]
    (folder / "poses.json").write_text(json.dumps(poses))
    (folder / "timestamps.json").write_text(json.dumps([1557539924.5 + i / 10 for i in range(3)]))


@pytest.fixture
def root(tmp_path) -> Path:
    """001, converted: the same points around the LiDAR in each scan, written in the world's frame."""
    folder = tmp_path / "001" / "lidar"
    folder.mkdir(parents=True)
    write_poses(folder)
    for i in range(3):
        world = POINTS @ turn(HEADINGS[i]).T + POSITIONS[i]
        np.save(folder / f"{i:02d}.npy", np.column_stack([world, [7, 8]]).astype(np.float32))
        (folder / f"{i:02d}.pkl.gz").write_bytes(b"a pickle")
    return tmp_path


def test_converted_scans_are_turned_back_into_the_lidars_frame(root):
    assert recording_names(root) == recording_names(root / "001") == ("001",)
    for place in (root, root / "001"):
        recording = open_recording(place, sensor_height=1.8)
        assert recording.ids == ("00", "01", "02") and recording.pose_source == "lidar/poses.json"
        np.testing.assert_array_equal(recording.positions, POSITIONS)
        np.testing.assert_allclose(np.diff(recording.times), 0.1, atol=1e-6)
        for i in range(3):
            np.testing.assert_allclose(recording.points(i), [[10, -4, -1], [20, 3, 2]], atol=1e-5)


def test_packs_and_fingerprints_follow_the_poses(root, tmp_path):
    """A heading alone is corrected: points change, while files of scans and positions stay."""
    before = open_recording(root, sensor_height=1.8)
    packed(before, tmp_path / "cache")
    poses = root / "001" / "lidar" / "poses.json"
    rows = json.loads(poses.read_text())
    rows[1]["heading"] = dict(w=1.0, x=0, y=0, z=0)
    poses.write_text(json.dumps(rows))
    after = open_recording(root, sensor_height=1.8)
    assert np.abs(after.points(1) - before.points(1)).max() > 1
    np.testing.assert_array_equal(packed(after, tmp_path / "cache").points(1), after.points(1))
    assert fingerprint(after) != fingerprint(before)


def test_scans_that_are_not_converted_are_said(root):
    (root / "001" / "lidar" / "01.npy").unlink()
    recording = open_recording(root, sensor_height=1.8)
    assert recording.ids == ("00", "02") and recording.found[0].endswith("x forward, 1 pickles not converted")
    np.testing.assert_array_equal(recording.positions, POSITIONS[[0, 2]])


class Bomb:
    """What runs when it is unpickled."""

    def __reduce__(self):
        return (Path.touch, (Path("exploded"),))


def test_no_pickle_is_opened(root, monkeypatch, tmp_path):
    monkeypatch.chdir(tmp_path)
    for path in (root / "001" / "lidar").glob("*.npy"):
        path.unlink()
    (root / "001" / "lidar" / "00.pkl.gz").write_bytes(pickle.dumps(Bomb()))
    assert recording_names(root) == ("001",)
    with pytest.raises(
        ValueError, match=r"expected scans as \.npy, found 3 pickles .* docs/reference/files\.md says how"
    ):
        open_recording(root)
    np.save(root / "001" / "lidar" / "00.npy", np.array([Bomb()]), allow_pickle=True)
    with pytest.raises(ValueError, match=r"00\.npy: expected a numpy array, found none"):
        open_recording(root, sensor_height=1.8).points(0)
    assert not Path("exploded").exists()


@pytest.mark.parametrize(
    ("file", "content", "message"),
    [
        ("poses.json", [{"position": {"x": 1}}], "expected a list of poses, each with position"),
        ("poses.json", 3, "expected a list of poses"),
        ("poses.json", [], r"expected at least 3 rows \(frame 2\), found 0"),
        ("timestamps.json", [0.0], r"expected at least 3 rows \(frame 2\), found 1"),
        ("timestamps.json", [3.0, 2.0, 1.0], r"row 2: expected a time >= 3.0, found 2.0"),
        ("timestamps.json", {"a": 1}, "expected a list of seconds, found"),
        ("timestamps.json", ["noon"], "expected a list of seconds, found"),
    ],
)
def test_malformed_files_are_named(root, file, content, message):
    (root / "001" / "lidar" / file).write_text(json.dumps(content))
    with pytest.raises(ValueError, match=rf"{file}.*{message}"):
        open_recording(root, sensor_height=1.8)
