"""Stored arrays and JSON values are checked by their schema, and the message names what does not fit."""

import numpy as np
import pytest

from sglpr_jax.schema import Column, check_about, check_columns

COLUMNS = {"rows": Column("float32", ("n", "width")), "times": Column("float64", ("n",), optional=True)}
ROWS = np.ones((3, 2), np.float32)


def test_arrays_that_fit_pass_and_others_are_ignored():
    check_columns({"rows": ROWS}, COLUMNS, n=3)
    check_columns({"rows": ROWS, "times": np.arange(3.0), "more": np.array(["x"])}, COLUMNS)
    check_columns({"rows": ROWS[:0], "times": np.zeros(0)}, COLUMNS)
    check_columns({"x": np.array([np.nan])}, {"x": Column("float64", ("n",), finite=False)})


@pytest.mark.parametrize(
    ("arrays", "message"),
    [
        ({}, "expected arrays rows, times, found no rows"),
        ({"rows": ROWS.astype(float)}, r"expected rows as float32 \(3, 2\), found float64 \(3, 2\)"),
        ({"rows": ROWS[:2]}, r"expected rows as float32 \(3, 2\), found float32 \(2, 2\)"),
        ({"rows": ROWS, "times": np.zeros(2)}, r"expected times as float64 \(3\), found float64 \(2,\)"),
        ({"rows": ROWS * np.array([[1], [np.nan], [np.inf]], np.float32)}, "NaN or infinity in 2 rows, first in row 1"),
    ],
)
def test_an_array_that_does_not_fit_is_named(arrays, message):
    with pytest.raises(ValueError, match=message):
        check_columns(arrays, COLUMNS, n=3)


@pytest.mark.parametrize(
    ("about", "message"),
    [
        (None, "expected format 'mine 1', found None"),
        ({"format": "mine 2"}, "expected format 'mine 1', found 'mine 2'"),
        ({"format": "mine 1"}, "expected `width`, found no `width`"),
        ({"format": "mine 1", "width": "4"}, "`width`: expected a value of type int, found '4'"),
    ],
)
def test_a_value_that_does_not_fit_is_named(about, message):
    check_about({"format": "mine 1", "width": 4, "more": []}, {"width": int}, format="mine 1")
    with pytest.raises(ValueError, match=message):
        check_about(about, {"width": int}, format="mine 1")
