"""bin/map of a point cloud that another tool made, and bin/relocalize in it."""

import json

import numpy as np
import pytest

from sglpr_jax.data.readers import open_recording

START = np.array([300.0, -50.0, 10.0])


def boxes():
    """Ground with boxes of different sizes on both sides of a street."""
    rng = np.random.default_rng(7)
    x, y = np.meshgrid(np.arange(-30, 60, 0.3), np.arange(-25, 25, 0.3))
    parts = [np.stack([x.ravel(), y.ravel(), np.zeros(x.size)], axis=1)]
    for _ in range(24):
        corner = np.array([rng.uniform(-30, 55), rng.choice([-1, 1]) * rng.uniform(6, 20), 0])
        sides = rng.uniform([1, 1, 2], [8, 5, 6])
        parts.append(corner + rng.uniform(0, 1, (3000, 3)).round(rng.integers(0, 2)) * sides)
    return (np.concatenate(parts) + START).astype("<f4")


@pytest.fixture
def town(tmp_path):
    """A cloud, and a trajectory of seven poses, 5 m apart."""
    points, count = boxes(), len(boxes())
    header = f"ply\nformat binary_little_endian 1.0\nelement vertex {count}\n"
    properties = "".join(f"property float {axis}\n" for axis in "xyz")
    (tmp_path / "town.ply").write_bytes(f"{header}{properties}end_header\n".encode() + points.tobytes())
    positions = START + np.stack([np.arange(7) * 5.0, np.zeros(7), np.full(7, 1.73)], axis=1)
    rows = [[i / 2 + 0.1, *position, 0, 0, 0, 1] for i, position in enumerate(positions)]
    np.savetxt(tmp_path / "way.tum", rows, fmt="%.6f")
    return tmp_path / "town.ply", tmp_path / "way.tum"


@pytest.mark.slow
def test_a_scan_is_located_in_the_frame_of_the_cloud(command, town, tmp_path):
    cloud, way = town
    out = tmp_path / "town.safetensors"
    ended = command("map", cloud, "--poses", way, "--out", out)
    assert ended.status == 0, ended.error
    assert ended.out.strip() == f"{out}: 7 places, 7 of them from 7 scans of town"
    assert "point cloud map town.ply" in ended.error and "1.73 m above the ground" in ended.error
    np.save(tmp_path / "scan.npy", open_recording(cloud, poses=way).points(3)[::2])
    answer = tmp_path / "pose.json"
    ended = command("relocalize", tmp_path / "scan.npy", "--map", out, "--out", answer, "--sensor-height", "1.73")
    assert ended.status == 0, ended.error
    best = json.loads(answer.read_text())[0]
    assert best["place"] == "town/000003"
    np.testing.assert_allclose(np.array(best["world_from_query"])[:3, 3], START + np.array([15, 0, 1.73]), atol=0.3)
