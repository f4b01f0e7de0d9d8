"""Times of points: every driver's field, unit and reference are found, and nonsense is one clear error."""

import numpy as np
import pytest
from bags import CLOUD, FILES, cloud, write_bag
from hypothesis import given, settings
from hypothesis import strategies as st

from sglpr_jax.data.formats.scan_files import read_scan_record as pcd_records
from sglpr_jax.data.readers import open_recording
from sglpr_jax.data.record import TimeField
from sglpr_jax.data.recording import Record, scan_record

POINTS, EPOCH_S = 200, 1_700_000_000.25
WITHIN = np.linspace(0, 0.0997, POINTS)
DRIVERS = {
    "ouster": ("t", np.rint(WITHIN * 1e9).astype("<u4"), 0.0),
    "velodyne, from the end": ("time", (WITHIN - WITHIN[-1]).astype("<f4"), -WITHIN[-1]),
    "velodyne, from the begin": ("time", WITHIN.astype("<f4"), 0.0),
    "hesai": ("timestamp", (EPOCH_S + WITHIN).astype("<f8"), 0.0),
    "robosense, header at the end": ("timestamp", (EPOCH_S - WITHIN[-1] + WITHIN).astype("<f8"), -WITHIN[-1]),
    "livox, ns since 1970": ("timestamp", (1e9 * (EPOCH_S + WITHIN)).astype("<f8"), 0.0),
    "another clock": ("ts", (77.5 + WITHIN).astype("<f8"), 0.0),
}


def points_of(n: int = POINTS) -> np.ndarray:
    return np.random.default_rng(0).normal(scale=9, size=(n, 3)).astype(np.float32)


@pytest.mark.parametrize("driver", DRIVERS)
def test_every_driver(tmp_path, driver):
    kind = "ros1"
    name, values, first_s = DRIVERS[driver]
    message = cloud(kind, EPOCH_S, points_of(), **{name: values})
    path = write_bag(tmp_path / FILES[kind], kind, [("/points", CLOUD, EPOCH_S, message)])
    record = open_recording(path, sensor_height=1.0).record(0)
    np.testing.assert_allclose(record.point_times, first_s + WITHIN, atol=2e-6)
    assert record.point_times.dtype == np.float32 and record.points.shape == (POINTS, 3)


@settings(deadline=None)
@given(
    span_s=st.floats(0.02, 0.99),
    unit_s=st.sampled_from([1.0, 1e-3, 1e-6, 1e-9]),
    begin_s=st.one_of(st.floats(-1.0, 1.0), st.floats(1e3, 2e9)),
    header_late_s=st.floats(-0.9, 0.9),
    order=st.integers(0, 9),
)
def test_unit_and_reference_are_found_from_the_values(span_s, unit_s, begin_s, header_late_s, order):
    within = np.random.default_rng(order).permutation(np.linspace(0, span_s, 50))
    field = TimeField("t", (begin_s + within) / unit_s)
    found = field.seconds(valid=np.ones(50, bool), scan_time=begin_s + header_late_s)
    relative = abs(begin_s) <= 1
    np.testing.assert_allclose(found, within + (begin_s if relative else -header_late_s), atol=2e-6)
    alone = field.seconds(valid=np.ones(50, bool), scan_time=None)
    np.testing.assert_allclose(alone, within + (begin_s if relative else 0), atol=2e-6)


def test_points_that_were_not_measured_have_any_time():
    """Drivers write 0 or left-over memory for rays without an echo."""
    points, times = points_of(), EPOCH_S + WITHIN
    points[3], points[4], times[3], times[4] = np.nan, 0, 0, 1e30
    found = Record(points=points, time_field=TimeField("timestamp", times), time=EPOCH_S).point_times
    assert found[3] == found[4] == 0
    np.testing.assert_allclose(np.delete(found, [3, 4]), np.delete(WITHIN, [3, 4]), atol=1e-6)


@pytest.mark.parametrize(
    ("values", "found"),
    [
        (np.zeros(POINTS), "found 0 to 0, which no unit"),
        (np.full(POINTS, EPOCH_S), "found 1700000000 to 1700000000, which no unit"),
        (np.linspace(0, 1.5, POINTS), "found 0 to 1.5, which no unit"),
        (np.linspace(0, 1e13, POINTS), r"found 0 to 1e\+13, which no unit"),
        (np.full(POINTS, np.nan), "found no finite ones"),
    ],
)
def test_values_that_are_no_times_of_a_scan(values, found):
    record = Record(points=points_of(), time_field=TimeField("time", values), name="scan 7")
    with pytest.raises(ValueError, match=f"scan 7: expected times of points .*the field time, {found}"):
        _ = record.point_times


def test_records_without_times_have_none():
    assert Record(points=points_of()).point_times is None


@pytest.mark.parametrize("encoding", ["binary", "ascii"])
def test_pcd(tmp_path, encoding):
    points, path = points_of(), tmp_path / "a.pcd"
    columns = [*points.T, EPOCH_S + WITHIN]
    rows = np.rec.fromarrays(columns, dtype=[("x", "<f4"), ("y", "<f4"), ("z", "<f4"), ("timestamp", "<f8")])
    body = rows.tobytes()
    if encoding == "ascii":
        body = "\n".join(" ".join(f"{value:.17g}" for value in row) for row in rows.tolist()).encode()
    head = "VERSION .7\nFIELDS x y z timestamp\nSIZE 4 4 4 8\nTYPE F F F F\nCOUNT 1 1 1 1\n"
    path.write_bytes(f"{head}WIDTH {POINTS}\nHEIGHT 1\nPOINTS {POINTS}\nDATA {encoding}\n".encode() + body)
    found = pcd_records(path)
    np.testing.assert_array_equal(found.points, points)
    np.testing.assert_allclose(found.time_field.values, EPOCH_S + WITHIN, rtol=1e-15)
    np.testing.assert_allclose(scan_record(path).point_times, WITHIN, atol=1e-6)
