"""Small trees of files in the layouts of the datasets: points, poses and times are known numbers."""

import json
import struct
from pathlib import Path
from typing import Any

import numpy as np

from sglpr_jax.data.readers import mulran_helipr_boreas_nclt

NS, US = 1561000444390857630, 1326652795280148
POINTS = np.array([[5.0, 1.0, -1.5], [7.0, -2.0, 0.5], [-3.0, 4.0, 2.0]], np.float32)
LEFT = [[0, -1, 0], [1, 0, 0], [0, 0, 1]]
"""A quarter turn to the left."""
QUARTER = [np.sqrt(0.5), 0.0, 0.0, np.sqrt(0.5)]
"""The same: w x y z."""
IDENTITY = np.eye(3)
DRIVE = "2011_09_26/2011_09_26_drive_0001_sync"


def write(path: Path, content: Any) -> None:
    """Write bytes, a text, rows of numbers separated by commas, or JSON."""
    path.parent.mkdir(parents=True, exist_ok=True)
    if isinstance(content, bytes | np.ndarray):
        path.write_bytes(bytes(content))
    elif path.suffix == ".json" and not isinstance(content, str):
        path.write_text(json.dumps(content))
    else:
        rows = content if isinstance(content, str) else "".join(",".join(map(str, row)) + "\n" for row in content)
        path.write_text(rows)


def scan(i: int, columns: int, kind: str = "<f4") -> bytes:
    """Points shifted by `i`, with more columns of zeros."""
    return np.column_stack([POINTS + np.float32(i), np.zeros((3, columns - 3))]).astype(kind).tobytes()


def pose(at: Any, turned: Any = IDENTITY) -> list[float]:
    """12 numbers."""
    return np.column_stack([turned, at]).ravel().tolist()


def lines(rows: Any) -> str:
    return "".join(" ".join(map(str, row)) + "\n" for row in rows)


def mulran(root: Path) -> None:
    """The car stands at (10 i, 20, 3), turned left by a quarter; the third scan has no pose."""
    for i, wait in enumerate((0, 10**8, 10**9)):
        write(root / f"KAIST01/Ouster/{NS + wait}.bin", scan(i, 4))
    rows = [[NS - 10**7 + i * 10**7, *pose([10.0 * i, 20.0, 3.0], LEFT)] for i in range(20)]
    write(root / "KAIST01/global_pose.csv", rows)


HELIPR = {"Avia": "fffBBBI", "Aeva": "fffffiBf", "Ouster": "ffffIHHH", "Velodyne": "ffffHf"}
LINE = {"Avia": 5, "Aeva": 6, "Ouster": 6, "Velodyne": 4}
"""Columns of the lines."""


def helipr_scan(sensor: str, layout: str, shift: int = 0) -> bytes:
    rows = []
    for i, point in enumerate(POINTS + np.float32(shift)):
        rest = [7] * (len(layout) - 3)
        rest[LINE[sensor] - 3] = i
        rows.append(struct.pack(f"<{layout}", *point, *rest))
    return b"".join(rows)


def helipr_tree(root: Path) -> None:
    folder = root / "Roundabout01"
    stamps = [mulran_helipr_boreas_nclt.AEVA_CHANGED + 1 + i * 10**8 for i in range(2)]
    for sensor, layout in HELIPR.items():
        for i, stamp in enumerate(stamps):
            write(folder / f"LiDAR/{sensor}/{stamp}.bin", helipr_scan(sensor, layout, i))
        write(
            folder / f"LiDAR_GT/{sensor}_gt.txt", lines([stamp, i, 2, 3, 0, 0, 0, 1] for i, stamp in enumerate(stamps))
        )


def boreas(root: Path) -> None:
    folder, micro = root / "boreas-2020", NS // 1000
    for i in range(2):
        write(folder / f"lidar/{micro + i * 10**5}.bin", scan(i, 6))
    rows = [["GPSTime", *"abcdefghijkl"], *([micro + i * 10**5, 100.0 + i, 200.0, 70.0, *[0.0] * 9] for i in range(2))]
    write(folder / "applanix/lidar_poses.csv", rows)


def raw(root: Path) -> None:
    """Drive with scans 0 and 2 of three."""
    drive = root / "2011_09_26/2011_09_26_drive_0001_sync"
    for i in (0, 2):
        write(drive / f"velodyne_points/data/{i:010d}.bin", scan(i, 4))
        write(drive / f"oxts/data/{i:010d}.txt", lines([[49.0 + i * 1e-5, 8.4 + i * 1e-5, 112.0 + i, *[0.0] * 27]]))
    write(
        drive / "velodyne_points/timestamps.txt", "".join(f"2011-09-26 13:02:{25 + i / 10:012.9f}\n" for i in range(3))
    )


def nclt(root: Path) -> None:
    """A pose is near to the first two scans, the third comes 10 s after the last pose."""
    records = np.zeros(3, [("xyz", "<u2", 3), ("rest", "u1", 2)])
    records["xyz"] = np.round((POINTS * [1, -1, -1] + 100) / 0.005)
    for wait in (0, 100_000, 10_000_000):
        write(root / f"2012-01-15/velodyne_sync/{US + wait}.bin", records.tobytes())
    nan = [[US - 30_000_000, *["NaN"] * 6], [US + 160_000, "nan", 1, 1, 0, 0, 0]]
    known = [[US - 40_000, 1, 2, 3, 0, 0, 0], [US + 10_000, 4, 5, 6, 0.1, 0.2, 0.3], [US + 90_000, 7.5, -8, 9, 0, 0, 0]]
    write(root / "groundtruth_2012-01-15.csv", [nan[0], *known, nan[1]])


def nuscenes(root: Path) -> None:
    """scene-0061: key frames at 0 and 0.5 s, sweeps at .05 and .1 s, the last not downloaded; scene-0103 has none."""
    data, poses = [], []
    for i, (seconds, folder) in enumerate({0.5: "samples", 0.0: "samples", 0.05: "sweeps", 0.1: "sweeps"}.items()):
        stamp = US + int(seconds * 1e6)
        file = f"{folder}/LIDAR_TOP/n015__{stamp}.pcd.bin"
        row = {"token": f"d{i}", "sample_token": f"s{i % 2}", "ego_pose_token": f"e{i}", "calibrated_sensor_token": "c"}
        data.append({**row, "timestamp": stamp, "filename": file})
        poses.append({"token": f"e{i}", "rotation": QUARTER, "translation": [100 + 10 * seconds, 200.0, 0.0]})
        if seconds != 0.1:
            write(root / file, scan(i - 1, 5))
    camera = {**data[0], "token": "cam", "filename": "samples/CAM_FRONT/a.jpg"}
    sensor = {"token": "c", "rotation": QUARTER, "translation": [0.94, 0.0, 1.84]}
    samples = [("s0", "t0"), ("s1", "t0"), ("s9", "t1")]
    tables = {
        "scene": [{"token": "t1", "name": "scene-0103"}, {"token": "t0", "name": "scene-0061"}],
        "sample": [{"token": sample, "scene_token": scene} for sample, scene in samples],
        "sample_data": [*data, camera, {**data[0], "token": "dd", "sample_token": "s9"}],
        "ego_pose": poses,
        "calibrated_sensor": [{**sensor, "token": "other"}, sensor],
    }
    for name, rows in tables.items():
        write(root / f"v1.0-mini/{name}.json", rows)


def pandaset(root: Path) -> None:
    """The same points around the LiDAR in each scan, written in the world's frame; scan 1 is not converted."""
    at, headings = [[0.0, 0.0, 0.0], [5.0, 1.0, 0.5], [9.0, 3.0, 0.7]], np.radians([0.0, 30.0, -75.0])
    heading = [dict(w=np.cos(angle / 2), x=0, y=0, z=np.sin(angle / 2)) for angle in headings]
    poses = [{"position": dict(zip("xyz", p, strict=True)), "heading": h} for p, h in zip(at, heading, strict=True)]
    write(root / "001/lidar/poses.json", poses)
    write(root / "001/lidar/timestamps.json", [1557539924.5 + i / 10 for i in range(3)])
    for i, angle in enumerate(headings):
        cos, sin = np.cos(angle), np.sin(angle)
        world = POINTS @ np.array([[cos, -sin, 0], [sin, cos, 0], [0, 0, 1]]).T + at[i]
        write(root / f"001/lidar/{i:02d}.pkl.gz", b"a pickle")
        if i != 1:
            np.save(root / f"001/lidar/{i:02d}.npy", np.column_stack([world, [7, 8, 9]]).astype(np.float32))
