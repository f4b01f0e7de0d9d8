import hypothesis
import hypothesis.extra.numpy as hnp
import hypothesis.strategies as st
import numpy as np
import pytest

from sglpr_jax.retrieval.distances import cosine, distance_function, l2, smallest


@pytest.fixture
def rows() -> np.ndarray:
    return np.random.default_rng(0).normal(size=(9, 5)).astype(np.float32)


def test_l2_is_the_euclidean_distance_even_where_it_is_tiny(rows):
    near = rows + np.float32(1e-4)
    expected = np.linalg.norm(rows[:, None].astype(np.float64) - near[None], axis=-1)
    np.testing.assert_allclose(l2(rows, near), expected, rtol=1e-4)


def test_cosine_is_the_cosine_distance(rows):
    zero = np.zeros((1, 5), np.float32)
    expected = [[1 - a @ b / np.linalg.norm(a) / np.linalg.norm(b) for b in rows] for a in 2 * rows]
    np.testing.assert_allclose(cosine(2 * rows, rows), expected, atol=1e-6)
    assert (cosine(zero, rows) == 1).all() and (cosine(rows, zero) == 1).all()


@hypothesis.given(
    hnp.arrays(np.float32, (6, 9), elements=st.sampled_from([0.0, 1.0, 2.0, 3.0, np.inf])), st.integers(1, 9)
)
def test_the_smallest_are_those_of_a_stable_sort(values, k):
    np.testing.assert_array_equal(smallest(values, k), np.argsort(values, axis=1, kind="stable")[:, :k])


def test_an_unknown_distance_is_named_with_the_nearest_one():
    with pytest.raises(ValueError, match=r"l2, cosine, .*, found 'scan_context'; did you mean scan-context\?"):
        distance_function("scan_context")
