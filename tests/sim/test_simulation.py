"""A simulated dataset in one call says what it writes, and completes what is there."""

import dataclasses
from pathlib import Path

import numpy as np
import pytest

from sglpr_jax.data.readers import open_recording, recording_names
from sglpr_jax.data.submap import submaps
from sglpr_jax.sim.carriers import CARRIERS
from sglpr_jax.sim.repeating import simulate_repeating
from sglpr_jax.sim.sensor import SENSORS
from sglpr_jax.sim.simulation import default_dataset, default_sessions, simulate

THIN = {"scans": 3, "azimuth_steps": 40, "sensor": "vlp16"}


@pytest.mark.slow
def test_towns_are_written_with_what_they_are_told_beforehand(tmp_path):
    told, done = [], []
    found = simulate(tmp_path / "town", routes=["08"], **THIN, on_start=lambda dataset: told.append(dataset.missing))
    assert str(found) == f"{tmp_path / 'town'}: recordings 08" and told == [("08",)]
    assert found.missing == () and found.missing_bytes == 0
    assert len(open_recording(found.root, "08")) == 3
    simulate(tmp_path / "town", routes=["08"], **THIN, on_start=lambda dataset: told.append(dataset.missing))
    assert told[1] == ()
    both = simulate(tmp_path / "town", routes=["08", "00"], **THIN, on_progress=done.append)
    assert recording_names(both.root) == ("00", "08") and done[-1] == 6 and done == sorted(done)


def test_submaps_of_a_scenery_where_places_repeat(tmp_path):
    options = {"scans": 4, "azimuth_steps": 40, "sensor": "vlp16", "scenery": "tunnel", "submap_m": 1000.0}
    found = simulate(tmp_path, routes=["08"], **options)
    sensor = dataclasses.replace(SENSORS["vlp16"], azimuth_steps=40)
    drive = simulate_repeating("tunnel", scans=4, sensor=sensor, revisit="opposite")
    expected = submaps(drive, drive.poses.world_from_lidar, length_m=1000.0)
    written = open_recording(found.root, "08", sensor_height="auto")
    for i in range(4):
        np.testing.assert_array_equal(written.points(i), expected.points(i))
        np.testing.assert_array_equal(written.record(i).labels, expected.record(i).labels)
    assert len(written.points(3)) > len(drive.points(3))
    assert written.positions == pytest.approx(drive.positions, abs=1e-5)
    with pytest.raises(ValueError, match=r"submap_m 1000.0 \(found 10.0\)|submap_m 10.0 \(found 1000.0\)"):
        simulate(tmp_path, routes=["08"], **{**options, "submap_m": 10.0})


def test_a_carrier_of_the_sensor_is_part_of_the_dataset(tmp_path):
    options = {"scans": 3, "azimuth_steps": 40, "sensor": "vlp16", "scenery": "tunnel", "routes": ["01"]}
    found = simulate(tmp_path, **options, carrier="cart")
    drive = open_recording(found.root, "01", sensor_height=0.6)
    expected = simulate_repeating("tunnel", scans=3, sensor=SENSORS["vlp16"], carrier=CARRIERS["cart"])
    assert drive.positions == pytest.approx(expected.positions, abs=1e-5)
    with pytest.raises(ValueError, match="another simulated dataset; expected carrier"):
        simulate(tmp_path, **options)


@pytest.mark.slow
def test_days_of_one_town(tmp_path):
    found = simulate(tmp_path, sessions=["2012-01-15", "2012-02-04"], **THIN)
    assert recording_names(tmp_path) == found.names == ("2012-01-15", "2012-02-04")


def test_what_does_not_go_together_is_refused(tmp_path):
    for more in ({"along": [Path("a.txt")]}, {"images": True}, {"routes": ["00", "08"]}):
        with pytest.raises(ValueError, match="at most one route"):
            simulate(tmp_path, sessions=["2012-01-15"], **more)
    with pytest.raises(ValueError, match=r"expected a sensor among hdl64e, .* found 'vlp17'"):
        simulate(tmp_path, sensor="vlp17")
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(
    ("changes", "error"),
    [
        ({"routes": ["99"]}, "found \\['99'\\]"),
        ({"routes": ["99"], "sessions": ["2012-01-15"]}, "found '99'"),
        ({"seed": -1}, "seed: expected"),
        ({"rate_hz": 0.0}, "rate_hz: expected"),
        ({"scans": 1}, "2 scans or more"),
        ({"submap_m": -1.0}, "submap_m: expected"),
        ({"sessions": ["2012-01-15"], "submap_m": 5.0}, "expected no submaps"),
        ({"scenery": "forest", "routes": ["00", "05"]}, "different revisits"),
        ({"scenery": "wood"}, "found 'wood'"),
        ({"carrier": "horse"}, "expected a carrier among vehicle, .* found 'horse'"),
        ({"sessions": ["2012-01-15"], "carrier": "cart"}, "expected the carrier vehicle"),
    ],
)
def test_nothing_is_told_of_a_dataset_that_cannot_be(tmp_path, changes, error):
    told = []
    with pytest.raises(ValueError, match=error):
        simulate(tmp_path / "town", **(THIN | changes), on_start=told.append)
    assert not told and not (tmp_path / "town").exists()


def test_the_datasets_that_stand_in_for_real_ones_have_their_folders():
    (towns, options), (days, more) = default_dataset(Path("cache")), default_sessions(Path("cache"))
    assert towns.parent == days.parent == Path("cache") and towns != days
    assert options["scans"] == more["scans"] == 300 and len(more["sessions"]) == 3
