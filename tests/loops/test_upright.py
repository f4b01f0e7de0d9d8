"""A sensor that is tilted or hangs upside down: poses handed out are those of its own frame, as its points are."""

import dataclasses
from pathlib import Path

import numpy as np
import pytest
from drives import error_of
from recordings import of_scans, reading_scans
from scipy.spatial.transform import Rotation

from sglpr_jax.data.mounting import MODEL_HEIGHT_M, Mounting, upright_from_lidar
from sglpr_jax.loops.acceptance import register_loops
from sglpr_jax.loops.closure import UNKNOWN_HEIGHT_M, LoopClosure, planar_loop, to_lidar, to_upright
from sglpr_jax.loops.result import LoopSearchResult, Session
from sglpr_jax.loops.search import find_loops
from sglpr_jax.maps.build import map_recording
from sglpr_jax.maps.place_map import PlaceMap
from sglpr_jax.odometry.path import level_odometry
from sglpr_jax.registration.bev_alignment import BevRegistration
from sglpr_jax.se3 import inverse, transform, transform_covariance, transformed

TILTS = {"forward": (0.0, 25.0, 0.0), "sideways": (20.0, 10.0, 0.0), "upside down": (170.0, 5.0, 0.0)}


def tilted_from_level(degrees) -> np.ndarray:
    found = np.eye(4)
    found[:3, :3] = Rotation.from_euler("xyz", degrees, degrees=True).as_matrix()
    return found


def mounting_of(tilted: np.ndarray, height_m: float = MODEL_HEIGHT_M) -> Mounting:
    return Mounting(height_m, tuple(tilted[:3, 2].tolist()))


def tilted_drive(drive, degrees):
    """The drive as a sensor tilted so sees it, and the poses of that sensor in the world."""
    tilted = tilted_from_level(degrees)

    def points_of(path):
        return transformed(tilted, drive.points(drive.paths.index(path))).astype(np.float32)

    recording = dataclasses.replace(
        drive, read=reading_scans(points_of), label_paths=(), mounting=mounting_of(tilted), on_disk=False
    )
    return recording, drive.poses.world_from_lidar @ inverse(tilted)


@pytest.mark.slow
def test_the_loops_of_a_tilted_recording_are_registered_and_agree_with_odometry_that_begins_with_the_identity(
    street, params
):
    recording, poses = tilted_drive(street, TILTS["sideways"])
    found = find_loops(recording, params, odometry=inverse(poses[0]) @ poses, registered=True)
    assert len(found.loops) > 12 and len(found.rejected) <= 4
    for loop in found.loops:
        metres, degrees = error_of(loop.match_from_query, inverse(poses[loop.match]) @ poses[loop.query])
        assert metres < 0.5 and degrees < 1


@pytest.mark.slow
def test_scans_of_a_tilted_and_of_an_upright_sensor_find_themselves_in_one_map(drive, params, tmp_path):
    recording, poses = tilted_drive(drive, TILTS["upside down"])
    few = {name: getattr(recording, name)[:8] for name in ("ids", "paths", "times", "positions")}
    map_recording(dataclasses.replace(recording, **few), params, poses[:8]).places.save(tmp_path / "map.safetensors")
    places = PlaceMap.load(tmp_path / "map.safetensors")
    assert places.mounting() == recording.mounting
    for scan, world_from_lidar in (
        (recording.scan(5), poses[5]),
        (drive.scan(5), drive.poses.world_from_lidar[5]),
    ):
        metres, degrees = error_of(places.relocate(params, scan)[0].world_from_query, world_from_lidar)
        assert metres < 0.7 and degrees < 3


@pytest.mark.parametrize("degrees", TILTS.values(), ids=TILTS)
def test_poses_go_there_and_back_and_points_with_them(degrees):
    tilted = tilted_from_level(degrees)
    mounting = mounting_of(tilted, height_m=2.5)
    cloud = np.random.default_rng(0).normal(scale=9, size=(50, 3)).astype(np.float32)
    level = transformed(upright_from_lidar(mounting), cloud)
    np.testing.assert_allclose(level, mounting.level(cloud), atol=1e-5)
    pose = transform(3.0, -2.0, 0.7)
    upright = LoopClosure(1, 0, pose, np.diag([1.0, 2.0, 3.0, 0.1, 0.2, 0.3]), 1.0)
    loop = to_lidar(upright, query=mounting, match=mounting)
    back, of_lidar = to_upright(loop, query=mounting, match=mounting), loop.match_from_query
    np.testing.assert_allclose(back.match_from_query, pose, atol=1e-12)
    np.testing.assert_allclose(back.covariance, upright.covariance, atol=1e-12)
    in_match = transformed(of_lidar, cloud)
    np.testing.assert_allclose(mounting.level(in_match.astype(np.float32)), transformed(pose, level), atol=1e-4)
    np.testing.assert_array_equal(upright_from_lidar(None), np.eye(4))


@pytest.mark.slow
def test_scans_of_a_tilted_sensor_are_registered_like_those_of_a_level_one(drive, revisit):
    query, match = revisit
    poses = drive.poses.world_from_lidar
    covariance = np.diag([0.1, 0.1, UNKNOWN_HEIGHT_M, 0.02, 0.02, 0.01]) ** 2
    level = LoopClosure(query, match, inverse(poses[match]) @ poses[query], covariance, 1.0)
    found = []
    for degrees in (0.0, 30.0):
        recording, _ = tilted_drive(drive, (0.0, degrees, 0.0))
        raised = dataclasses.replace(recording.mounting, height_m=2.5)  # a height moves no points
        recording = dataclasses.replace(recording, mounting=raised)
        (loop,), _ = register_loops(
            recording,
            recording,
            [to_lidar(level, query=recording.mounting, match=recording.mounting)],
            knows_height=False,
            should_stop=lambda: False,
        )
        assert not LoopSearchResult((Session(recording, len(recording)),)).is_degenerate(loop)
        found.append(to_upright(loop, query=recording.mounting, match=recording.mounting))
    metres, degrees = error_of(found[1].match_from_query, found[0].match_from_query)
    assert metres < 0.005 and degrees < 0.02 and found[1].overlap == pytest.approx(found[0].overlap, abs=0.02)
    deviations = [np.sqrt(np.diag(loop.covariance)) for loop in found]
    np.testing.assert_allclose(deviations[1], deviations[0], rtol=0.1)


def test_an_unknown_height_of_a_tilted_sensor_is_not_degenerate():
    sensor = mounting_of(tilted_from_level((0.0, 15.0, 0.0)))
    recording = of_scans({Path(f"{i}.bin"): np.zeros((1, 3), np.float32) for i in range(2)}, mounting=sensor)
    covariances = [np.diag([along_m, 0.1, 10.0, 0.02, 0.02, 0.01]) ** 2 for along_m in (0.1, 2.0)]
    loops = [to_lidar(LoopClosure(1, 0, np.eye(4), each, 1.0), query=sensor, match=sensor) for each in covariances]
    result = LoopSearchResult((Session(recording, 2),), tuple(loops))
    assert list(map(result.is_degenerate, loops)) == [False, True] and str(result).startswith("2 loops (1 degenerate)")


def test_odometry_of_a_tilted_sensor_is_laid_level_whatever_its_world():
    level = np.stack([transform(2.0 * k, 0.1 * k**2, 0.2 * k) for k in range(20)])
    tilted = tilted_from_level(TILTS["forward"])
    mounting = mounting_of(tilted)
    of_lidar = level @ inverse(tilted)
    for odometry in (of_lidar, inverse(of_lidar[0]) @ of_lidar):
        found = level_odometry(odometry, np.tile(upright_from_lidar(mounting), (20, 1, 1)))
        steps, expected = inverse(found[:-1]) @ found[1:], inverse(level[:-1]) @ level[1:]
        np.testing.assert_allclose(np.linalg.norm(steps[:, :3, 3], axis=1), np.linalg.norm(expected[:, :3, 3], axis=1))
        np.testing.assert_allclose(steps[:, 2, 3], 0, atol=1e-12)
        np.testing.assert_allclose(found[:, :3, 2], np.tile([0, 0, 1.0], (20, 1)), atol=1e-12)


def test_the_covariance_of_a_motion_in_another_frame_is_that_of_drawn_motions():
    rng = np.random.default_rng(0)
    mounting = mounting_of(tilted_from_level(TILTS["sideways"]), height_m=3.0)
    lidar = inverse(upright_from_lidar(mounting))
    root = rng.normal(size=(6, 6)) * 1e-3
    drawn = rng.normal(size=(20_000, 6)) @ root.T
    motions = np.tile(np.eye(4), (len(drawn), 1, 1))
    motions[:, :3, :3], motions[:, :3, 3] = Rotation.from_rotvec(drawn[:, 3:]).as_matrix(), drawn[:, :3]
    moved = lidar @ motions @ inverse(lidar)
    in_lidar = np.concatenate([moved[:, :3, 3], Rotation.from_matrix(moved[:, :3, :3]).as_rotvec()], axis=1)
    expected = transform_covariance(root @ root.T, lidar)
    np.testing.assert_allclose(np.cov(in_lidar.T), expected, atol=0.05 * expected.diagonal().max())


@pytest.mark.slow
def test_the_covariance_of_estimated_mountings_is_that_of_drawn_ones():
    rng = np.random.default_rng(0)
    tilts = [tilted_from_level(degrees) for degrees in ((9.0, -6.0, 0.0), (-4.0, 12.0, 0.0))]
    query, match = (
        dataclasses.replace(mounting_of(tilted), height_deviation_m=0.04, tilt_deviation_deg=1.0) for tilted in tilts
    )
    upright, none = transform(3.0, -2.0, 2.0), np.zeros((3, 3), np.float32)
    alignment = BevRegistration(3.0, -2.0, 2.0, none, 1.0, 0.0)
    level = planar_loop(1, 0, alignment, probability=1.0, sensors=(query, match))
    loop = to_lidar(level, query=query, match=match)

    def drawn(mounting):
        off = rng.normal(size=3) * [np.radians(1.0), np.radians(1.0), 0.04]
        error = np.eye(4)
        error[:3, :3], error[2, 3] = Rotation.from_rotvec([off[0], off[1], 0]).as_matrix(), off[2]
        return error @ upright_from_lidar(mounting)

    poses = np.array([inverse(drawn(match)) @ upright @ drawn(query) for _ in range(4000)])
    apart = inverse(loop.match_from_query) @ poses
    errors = np.concatenate([apart[:, :3, 3], Rotation.from_matrix(apart[:, :3, :3]).as_rotvec()], axis=1)
    whitened = errors @ np.linalg.cholesky(np.linalg.inv(loop.covariance + 1e-5 * np.eye(6)))
    squares = (whitened**2).sum(axis=1)
    # x, y and yaw have no error here. The slope of the ground is part of the covariance, and not of the errors.
    assert 0.5 < np.median(squares) / 2.37 < 1.1 and 0.5 < np.quantile(squares, 0.95) / 7.81 < 1.1
    fixed = planar_loop(1, 0, alignment, probability=1.0)
    np.testing.assert_allclose(np.sqrt(fixed.covariance[2, 2]), np.hypot(0.03, 0.018 * np.hypot(3, 2)), rtol=1e-12)
