"""One town on several days: streets and houses stay, what moves has moved, and the files are NCLT's."""

from pathlib import Path

import numpy as np
import pytest
from scipy.spatial import KDTree

from sglpr_jax.data.readers import open_recording
from sglpr_jax.labels import CATEGORIES, to_classes
from sglpr_jax.sim.dataset import simulate
from sglpr_jax.sim.drive import plan_path
from sglpr_jax.sim.recording import plan_sessions
from sglpr_jax.sim.sensor import Sensor

DAYS = ("2012-01-15", "2012-02-04", "2012-03-17")
TINY = Sensor(elevations_deg=(10.0, 2.0, -1.0, -3.0, -6.0, -10.0, -14.0, -18.0), azimuth_steps=120, height_m=1.0)
SCANS = 24
OPTIONS = {"scans": SCANS, "sensor": TINY, "seed": 1, "rate_hz": 0.4}


@pytest.fixture(scope="module")
def days():
    return [session.simulate() for session in plan_sessions(DAYS, **OPTIONS)]


@pytest.fixture(scope="module")
def dataset(tmp_path_factory) -> Path:
    return simulate(tmp_path_factory.mktemp("days") / "data", sessions=DAYS, **OPTIONS).root


def test_every_day_has_its_scans_named_by_the_time(days):
    assert [day.name for day in days] == list(DAYS)
    for date, day in zip(DAYS, days, strict=True):
        assert day.ids == tuple(str(round(time * 1e6)) for time in day.times) and len(set(day.ids)) == SCANS
        assert np.datetime64(int(day.ids[0]), "us") == np.datetime64(f"{date}T12:00:00")
        assert np.all(np.diff(day.times) > 0)


def test_most_places_are_seen_again_partly_in_the_opposite_direction():
    path = plan_path(np.random.default_rng(0), "00", scans=60, rate_hz=1.0, days=3)
    (first, *others), (yaw, *yaws) = (np.array_split(values, 3) for values in (path.xy, path.yaw))
    opposite = []
    for xy, heading in zip(others, yaws, strict=True):
        apart, nearest = KDTree(first).query(xy)
        assert np.mean(apart < 5) > 0.5
        assert np.median(apart) > 0.05  # not the same way again
        opposite.append(np.cos(heading - yaw[nearest])[apart < 5] < -0.7)
    assert 0.1 < np.mean(np.concatenate(opposite)) < 0.9


def test_houses_stay_and_parked_cars_do_not(days):
    """Of the ground that each kind covers on the last day, within 2 m squares, how much it covered on the first."""
    first, last = days[0], days[-1]
    apart, nearest = KDTree(first.positions[:, :2]).query(last.positions[:, :2])
    pairs = [(int(nearest[i]), int(i)) for i in np.argsort(apart)[:5]]

    def squares(day, i: int, category: str) -> set[tuple[int, int]]:
        points = day.points(i)[to_classes(day.labels(i)) == CATEGORIES.index(category)]
        world = points @ day.poses.world_from_lidar[i, :3, :3].T + day.positions[i]
        return set(map(tuple, np.floor(world[:, :2] / 2).astype(int).tolist()))

    def stays(category: str) -> float:
        seen = [(squares(first, i, category), squares(last, j, category)) for i, j in pairs]
        return sum(len(a & b) for a, b in seen) / sum(len(b) for _, b in seen)

    assert stays("building") > 1.5 * stays("car")


def test_the_reader_gives_back_the_days(dataset, days):
    assert not list(dataset.rglob("*.label"))
    for day in days:
        on_disk = open_recording(dataset, day.name)
        assert on_disk.ids == day.ids and on_disk.pose_source == f"groundtruth_{day.name}.csv"
        up = day.poses.world_from_lidar[:, :3, 2]
        np.testing.assert_allclose(on_disk.positions, day.positions - TINY.height_m * up, atol=1e-5)
        for i in (0, SCANS - 1):
            lifted = day.points(i) + np.float32([0, 0, TINY.height_m])
            np.testing.assert_allclose(on_disk.points(i), lifted, atol=0.00251)


def test_the_ground_truth_turns_forward_right_down_to_north_east_down(dataset, days):
    rows = np.loadtxt(dataset / DAYS[1] / f"groundtruth_{DAYS[1]}.csv", delimiter=",")
    roll, pitch, yaw = rows[:, 4:].T
    east_of_north = np.stack([np.cos(pitch) * np.cos(yaw), np.cos(pitch) * np.sin(yaw), -np.sin(pitch)], axis=1)
    forward = days[1].poses.world_from_lidar[:, :3, 0]
    np.testing.assert_allclose(east_of_north * [1, -1, -1], forward, atol=1e-6)
    assert np.abs(roll).max() < 0.2  # upright, not upside down


@pytest.mark.parametrize(
    "dates, changes, words",
    [
        (("2012-01-15", "2012-01-15"), {}, "expected different dates"),
        (("2012-13-15",), {}, "expected dates such as 2012-01-15, found '2012-13-15'"),
        (DAYS, {"scans": 1}, "2 scans or more"),
    ],
)
def test_what_is_no_day_is_refused(dates, changes, words):
    with pytest.raises(ValueError, match=words):
        plan_sessions(dates, **(OPTIONS | changes))
