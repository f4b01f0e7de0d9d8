"""Rows that are appended are there, whatever the capacity."""

import numpy as np

from sglpr_jax.growing import GrowingArray


def test_rows_are_those_that_were_added_and_the_capacity_doubles():
    array, sizes = GrowingArray(np.empty((0, 2))), set()
    for k in range(600):
        array.append((k, -k))
        sizes.add(array.nbytes // 16)
    array.extend(np.ones((500, 2)))
    assert sizes == {256, 512, 1024} and len(array) == 1100 and array.nbytes == 16 * 2048
    np.testing.assert_array_equal(array.rows[:600, 0], np.arange(600))
    np.testing.assert_array_equal(array.rows[600:], 1)


def test_rows_without_a_flag_are_removed():
    array = GrowingArray(np.arange(10))
    array.keep(array.rows % 3 == 0)
    array.append(7)
    assert array.rows.tolist() == [0, 3, 6, 9, 7]
