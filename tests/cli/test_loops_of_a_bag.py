"""From an mcap and odometry to a correct pose graph that other programs read."""

from pathlib import Path

import numpy as np
import pytest
from bags import CLOUD, ODOMETRY, TRANSFORMS, cloud, pose, transforms, write_bag
from drives import drifted, street  # noqa: F401

from sglpr_jax.data.formats.pose_files import read_tum
from sglpr_jax.maps.place_map import PlaceMap
from sglpr_jax.pose_graph.files import read_g2o
from sglpr_jax.pose_graph.optimize import trajectory_error
from sglpr_jax.se3 import inverse, quaternions

from .conftest import assert_one_line_error

pytestmark = pytest.mark.slow
START_S, STEP_S = 1_700_000_000.0, 0.4
BASE = ("base_link", "lidar", (1.0, 0.0, 0.5), (0, 0, 0, 1))
"""How the LiDAR is mounted, as tf says it."""


@pytest.fixture(scope="module")
def odometry(street) -> np.ndarray:  # noqa: F811
    """Odometry of wheels, too long and turned."""
    return drifted(street.poses.world_from_lidar, percent=0.5, deg_per_100m=0.5)


@pytest.fixture(scope="module")
def mcap(street, odometry, tmp_path_factory) -> Path:  # noqa: F811
    """The scans as PointCloud2 messages, odometry of a base 1 m behind the LiDAR, and tf."""
    messages = [("/tf_static", TRANSFORMS, START_S, transforms("mcap", START_S, [BASE]))]
    base_from_lidar = np.eye(4)
    base_from_lidar[:3, 3] = BASE[2]
    bases = odometry @ inverse(base_from_lidar)
    for i, (base, turned) in enumerate(zip(bases, quaternions(bases), strict=True)):
        time = START_S + STEP_S * i
        messages.append(("/points", CLOUD, time, cloud("mcap", time, street.points(i))))
        messages.append(("/odom", ODOMETRY, time, pose("mcap", time, base[:3, 3], turned)))
    folder = write_bag(tmp_path_factory.mktemp("bag") / "drive", "mcap", messages)
    return next(folder.glob("*.mcap")).rename(folder.parent / "drive.mcap")


def test_from_an_mcap_to_a_graph_and_a_corrected_trajectory(command, street, mcap, odometry, tmp_path):  # noqa: F811
    out, scans = tmp_path / "found", len(street)
    ended = command("loops", mcap, "--odometry", mcap, "--out", out, "--optimize")
    assert ended.status == 0, ended.error
    assert f"drive: {scans} scans" in ended.error and "/points of drive.mcap" in ended.error
    assert "estimated from the ground" in ended.error
    assert "poses: /odom (40 poses of base_link in odom, interpolated, moved to lidar by tf)" in ended.error

    graph = read_g2o(out / "loops.g2o")
    assert sorted(graph.poses) == list(range(scans))
    np.testing.assert_allclose(np.stack([graph.poses[i] for i in range(scans)]), odometry, atol=1e-4)
    steps, loops = graph.edges[: scans - 1], graph.edges[scans - 1 :]
    assert [edge[:2] for edge in steps] == [(i, i + 1) for i in range(scans - 1)]
    poses = street.poses.world_from_lidar
    assert len(loops) >= 5
    for match, query, match_from_query, information in loops:
        error = inverse(inverse(poses[match]) @ poses[query]) @ match_from_query
        assert np.linalg.norm(error[:2, 3]) < 1.0 and (np.linalg.eigvalsh(information) > 0).all()

    corrected, times = read_tum(out / "trajectory-optimized.tum")
    np.testing.assert_allclose(times, START_S + STEP_S * np.arange(scans), atol=1e-5)
    assert trajectory_error(corrected, street.positions) < trajectory_error(odometry, street.positions)
    page = (out / "index.html").read_text()
    assert page.count("data:image/png;base64,") >= 3
    assert "is not known: the recording has no true poses" in page  # those of the bag are the odometry itself


def test_a_map_takes_the_poses_of_its_bag(command, mcap, odometry, tmp_path):
    out = tmp_path / "town.safetensors"
    ended = command("map", mcap, "--poses", mcap, "--spacing-m", "40", "--out", out)
    assert ended.status == 0, ended.error
    places = PlaceMap.load(out)
    assert 2 <= len(places) <= 20
    rows = [int(name.removeprefix("drive/")) for name in places.index.ids]
    np.testing.assert_allclose(places.world_from_place, odometry[rows], atol=1e-4)


def test_another_bag_or_a_bag_without_poses_is_no_odometry(command, street, mcap, tmp_path):  # noqa: F811
    clouds = [("/points", CLOUD, START_S + i, cloud("ros1", START_S + i, street.points(0))) for i in range(2)]
    bag = write_bag(tmp_path / "scans.bag", "ros1", clouds)
    run = ("loops", bag, "--out", tmp_path / "found", "--odometry")
    assert_one_line_error(command(*run, bag), "scans.bag: expected a bag with poses", "found no poses")
    assert_one_line_error(command(*run, mcap), "drive.mcap: expected a file of odometry", "found another bag")
    assert not (tmp_path / "found").exists()
