"""Scenes of nuScenes, their tables written here: scans in order of time, poses through two frames, missing parts."""

import json
from pathlib import Path

import numpy as np
import pytest

from sglpr_jax.data.readers import open_recording, recording_names

MICRO = 1532402927647951
TWICE = f"samples/LIDAR_TOP/n015__LIDAR_TOP__{MICRO}.pcd.bin"
"""A scan that another row lists, too."""
LIDAR_ON_CAR = [0.94, 0.0, 1.84]
LEFT = [np.sqrt(0.5), 0.0, 0.0, np.sqrt(0.5)]
"""A quarter turn to the left: w x y z."""
POINTS = np.array([[1.0, 5.0, -1.5], [-2.0, 7.0, 0.5]], np.float32)
"""x to the right, y forward."""


def write(path: Path, rows: object) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(json.dumps(rows))


def scan(root: Path, file: str, shift: float) -> None:
    path = root / file
    path.parent.mkdir(parents=True, exist_ok=True)
    np.column_stack([POINTS + shift, [9, 9], [3, 17]]).astype("<f4").tofile(path)


@pytest.fixture
def root(tmp_path) -> Path:
    """scene-0061: key frames at 0 and 0.5 s, sweeps at .05 and .1 s, the last not downloaded; scene-0103 has none."""
    files = {0.5: "samples", 0.0: "samples", 0.05: "sweeps", 0.1: "sweeps"}
    data, poses = [], []
    for number, (seconds, folder) in enumerate(files.items()):
        stamp = MICRO + int(seconds * 1e6)
        file = f"{folder}/LIDAR_TOP/n015__LIDAR_TOP__{stamp}.pcd.bin"
        row = {"token": f"d{number}", "sample_token": f"s{number % 2}", "ego_pose_token": f"e{number}"}
        data.append({**row, "calibrated_sensor_token": "c", "timestamp": stamp, "filename": file})
        poses.append({"token": f"e{number}", "rotation": LEFT, "translation": [100 + 10 * seconds, 200.0, 0.0]})
        if seconds != 0.1:
            scan(tmp_path, file, seconds)
    camera = {**data[0], "token": "cam", "filename": "samples/CAM_FRONT/a.jpg"}
    other = {**data[0], "token": "dd", "sample_token": "s9", "filename": "samples/LIDAR_TOP/other.pcd.bin"}
    tables = tmp_path / "v1.0-mini"
    write(tables / "scene.json", [{"token": "t1", "name": "scene-0103"}, {"token": "t0", "name": "scene-0061"}])
    samples = [("s0", "t0"), ("s1", "t0"), ("s9", "t1")]
    write(tables / "sample.json", [{"token": sample, "scene_token": scene} for sample, scene in samples])
    write(tables / "sample_data.json", [*data, camera, other])
    write(tables / "ego_pose.json", poses)
    sensor = {"token": "c", "rotation": LEFT, "translation": LIDAR_ON_CAR, "camera_intrinsic": []}
    write(tables / "calibrated_sensor.json", [{**sensor, "token": "other"}, sensor])
    return tmp_path


def test_a_scene_is_a_recording(root):
    assert recording_names(root) == ("scene-0061", "scene-0103")
    scene = open_recording(root, "scene-0061", sensor_height=1.84)
    assert scene.ids == tuple(f"n015__LIDAR_TOP__{MICRO + wait}" for wait in (0, 50_000, 500_000))
    np.testing.assert_allclose(np.diff(scene.times), [0.05, 0.45], atol=1e-6)
    assert scene.times[0] == pytest.approx(MICRO / 1e6)
    # the car looks to the left: the LiDAR's .94 m to its front are .94 m to the north
    np.testing.assert_allclose(scene.positions, [[100 + 10 * t, 200.94, 1.84] for t in (0, 0.05, 0.5)], atol=1e-9)
    assert scene.pose_source == "v1.0-mini/ego_pose.json"
    assert scene.found[:2] == (
        "format: nuscenes (20 bytes a point), rotated to x forward",
        "2 key frames and 1 sweeps, 1 more are listed but missing",
    )
    record = scene.record(2, lasers=True)
    shifted = POINTS + np.float32(0.5)
    np.testing.assert_array_equal(record.points, shifted[:, [1, 0, 2]] * np.array([1, -1, 1], np.float32))
    np.testing.assert_array_equal(record.lasers, [3, 17])


def test_the_smallest_version_that_has_a_scene_is_read(root):
    for name, scenes in (("v1.0-trainval", ("scene-0061", "scene-0999")), ("v1.0-test", ())):
        write(root / name / "scene.json", [{"token": "else", "name": scene} for scene in scenes])
    assert recording_names(root) == ("scene-0061", "scene-0103", "scene-0999")
    assert len(open_recording(root, "scene-0061", sensor_height=1.84)) == 3
    with pytest.raises(FileNotFoundError, match=r"v1\.0-trainval/sample\.json: expected a table, found none"):
        open_recording(root, "scene-0999")


def change(root: Path, table: str, row: int, **values: object) -> None:
    path = root / "v1.0-mini" / f"{table}.json"
    rows = json.loads(path.read_text())
    rows[row].update(values)
    path.write_text(json.dumps(rows))


@pytest.mark.parametrize(
    ("table", "row", "values", "message"),
    [
        (
            "sample_data",
            0,
            {"timestamp": "noon"},
            r"sample_data\.json: expected 1 numbers as 'timestamp', found others",
        ),
        ("sample_data", 0, {"ego_pose_token": "gone"}, r"ego_pose\.json: expected a row with the token 'gone'"),
        ("ego_pose", 1, {"translation": [1, 2]}, r"ego_pose\.json: expected 3 numbers as 'translation'"),
        ("ego_pose", 1, {"translation": [1, 2, float("nan")]}, "expected finite numbers as 'translation', found"),
        ("calibrated_sensor", 1, {"rotation": [2, 0, 0, 0]}, r"expected a rotation qx qy qz qw of length 1 in row 1"),
        ("ego_pose", 1, {"rotation": [1e300, 0, 0, 0]}, r"ego_pose\.json: expected a rotation .* of length 1 in row 1"),
        ("ego_pose", 1, {"translation": [1, 2, 10**400]}, r"ego_pose\.json: expected 3 numbers as 'translation'"),
        (
            "sample_data",
            0,
            {"filename": TWICE},
            r"sample_data\.json: .*a unique id for each scan, found .* twice",
        ),
    ],
)
def test_malformed_tables_are_named(root, table, row, values, message):
    change(root, table, row, **values)
    with pytest.raises(ValueError, match=message):
        open_recording(root, "scene-0061")


@pytest.mark.parametrize("file", ["../LIDAR_TOP/a.pcd.bin", None])
def test_a_scan_outside_the_dataset_is_refused(root, file):
    table = root / "v1.0-mini" / "sample_data.json"
    rows = json.loads(table.read_text())
    rows[1]["filename"] = file
    write(table, rows)
    with pytest.raises(ValueError, match=r"sample_data\.json: expected paths of files inside .*, found "):
        open_recording(root, "scene-0061")
