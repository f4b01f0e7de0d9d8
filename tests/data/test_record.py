"""Times of points: every driver's field, unit and reference are found. Clouds that show no place are refused."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import sglpr_jax
from sglpr_jax.data.scan import Scan, TimeField, check_cloud
from sglpr_jax.data.views import view
from sglpr_jax.grid import Grid
from sglpr_jax.models.config import model_preset

POINTS, EPOCH_S = 200, 1_700_000_000.25
WITHIN = np.linspace(0, 0.0997, POINTS)
CLOUD = np.random.default_rng(0).uniform(-15, 15, (POINTS, 3)).astype(np.float32)
DRIVERS = {
    "ouster": (np.rint(WITHIN * 1e9).astype("<u4"), 0.0),
    "velodyne, from the end": ((WITHIN - WITHIN[-1]).astype("<f4"), -WITHIN[-1]),
    "hesai": ((EPOCH_S + WITHIN).astype("<f8"), 0.0),
    "robosense, header at the end": ((EPOCH_S - WITHIN[-1] + WITHIN).astype("<f8"), -WITHIN[-1]),
    "livox, ns since 1970": ((1e9 * (EPOCH_S + WITHIN)).astype("<f8"), 0.0),
    "another clock": ((77.5 + WITHIN).astype("<f8"), 0.0),
}


@pytest.mark.parametrize("driver", DRIVERS)
def test_every_driver(driver):
    values, first_s = DRIVERS[driver]
    found = Scan(points=CLOUD, time_field=TimeField("t", values), time=EPOCH_S).point_times
    np.testing.assert_allclose(found, first_s + WITHIN, atol=2e-6)
    assert found.dtype == np.float32


@settings(deadline=None)
@given(
    span_s=st.floats(0.02, 0.99),
    unit_s=st.sampled_from([1.0, 1e-3, 1e-6, 1e-9]),
    begin_s=st.one_of(st.floats(-0.99, 0.99), st.floats(1.1, 1e3), st.floats(1e3, 2e9)),
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
    points, times = CLOUD.copy(), EPOCH_S + WITHIN
    points[3], points[4], times[3], times[4] = np.nan, 0, 0, 1e30
    found = Scan(points=points, time_field=TimeField("timestamp", times), time=EPOCH_S).point_times
    assert found[3] == found[4] == 0
    np.testing.assert_allclose(np.delete(found, [3, 4]), np.delete(WITHIN, [3, 4]), atol=1e-6)


@pytest.mark.parametrize(
    ("values", "found"),
    [
        (np.zeros(POINTS), "found 0 to 0, which no unit"),
        (np.linspace(0, 1.5, POINTS), "found 0 to 1.5, which no unit"),
        (np.linspace(0, 1e13, POINTS), r"found 0 to 1e\+13, which no unit"),
        (np.full(POINTS, np.nan), "found no finite ones"),
    ],
)
def test_values_that_are_no_times_of_a_scan(values, found):
    scan = Scan(points=CLOUD, time_field=TimeField("time", values), name="scan 7")
    with pytest.raises(ValueError, match=f"scan 7: expected times of points .*the field time, {found}"):
        _ = scan.point_times
    assert Scan(points=CLOUD).point_times is None


BAD = {
    "NaN": (np.full_like(CLOUD, np.nan), "expected finite points, found none among 200"),
    "zeros": (np.zeros_like(CLOUD), r"found all 200 points at \(0, 0, 0\)"),
    "millimetres": (CLOUD * 5000, "expected metres, .*found half of the points beyond .*millimetres"),
    "1e30": (np.full_like(CLOUD, 1e30), "the farthest at 1e[+]30"),
    "random bytes": (
        np.frombuffer(np.random.default_rng(0).bytes(4800), "<f4").reshape(-1, 3),
        "expected (metres|finite points)",
    ),
    "none": (CLOUD[:0], "expected finite points, found none among 0"),
    "rows of a file": (np.column_stack([CLOUD, CLOUD[:, 0]]), r"expected points \(n, 3\) .*shape \(200, 4\)"),
}


@pytest.mark.parametrize("kind", BAD)
def test_unusable_scans_are_refused_wherever_an_image_is_computed(as_installed, kind):
    points, found = BAD[kind]
    roads = (
        lambda: check_cloud(points, name="scan 7"),
        lambda: view(Scan(points=points, name="scan 7"), Grid()),
        lambda: sglpr_jax.scan_image(points, model_preset("tiny")),
    )
    for road in roads:
        with np.errstate(invalid="ignore"), pytest.raises(ValueError, match=found):
            road()
