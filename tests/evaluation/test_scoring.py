"""`evaluate` scores a descriptor file, a path or arrays. The result has the worst false positives."""

import dataclasses

import jax.numpy as jnp
import numpy as np
import pytest

from sglpr_jax.evaluation.protocols.protocol import ScoredPairs
from sglpr_jax.evaluation.protocols.result import Decision
from sglpr_jax.evaluation.protocols.top1 import TOP1_F1MAX
from sglpr_jax.evaluation.scoring import Evaluation, evaluate


@pytest.fixture(scope="module")
def file(noisy_laps):
    return dataclasses.replace(noisy_laps, times=np.arange(800) * 0.5)


def scores(*args, **options):
    return [result.score for result in evaluate(*args, **options).results]


def test_a_file_a_path_and_arrays_have_equal_scores(file, tmp_path):
    file.save(tmp_path / "town.npz")
    np.save(tmp_path / "town.npy", file.descriptors)
    where = {"positions": file.positions, "times": file.times}
    whole = scores(file)
    assert scores(tmp_path / "town.npz") == whole
    assert scores(str(tmp_path / "town.npy"), **where) == whole
    as_lists = {name: values.tolist() for name, values in where.items()}
    assert scores(jnp.asarray(file.descriptors), **as_lists) == whole
    with pytest.raises(ValueError, match=r"descriptors \(n, d\), found an array of shape \(3,\)"):
        evaluate(np.zeros(3), **where)


def test_options_replace_the_fields_of_a_file(file, tmp_path):
    def found(*args, **options):
        return evaluate(*args, ["top1-f1max"], **options)

    bare = dataclasses.replace(file, positions=None, times=None, pose_source=None)
    whole = found(file).results[0].score
    assert found(bare, positions=file.positions, times=file.times).results[0].score == whole
    other = dataclasses.replace(file, times=file.times * 1000, distance="cosine")
    assert found(file, times=other.times, distance="cosine").results[0].score == found(other).results[0].score != whole
    file.save(tmp_path / "town.npz")
    for source in (file, tmp_path / "town.npz"):
        moved = found(source, positions=file.positions[::-1] * 9)
        np.testing.assert_array_equal(moved.positions, file.positions[::-1] * 9)
        assert moved.results[0].pose_source == "positions given as an array"
        assert "last 30 s excluded" in moved.results[0].rule


def test_positions_and_times_of_all_scans_fit_a_file_with_skipped_scans(file, tmp_path):
    kept = ~np.isin(np.arange(800), (3, 700))
    file.only(kept).save(tmp_path / "town.npz")
    where = {"positions": file.positions, "times": file.times}
    assert scores(tmp_path / "town.npz", **where) == scores(tmp_path / "town.npz")


def test_options_that_do_not_fit_the_input_are_refused(file):
    pairs = ScoredPairs(np.array([[0, 1], [0, 2]]), np.array([0.5, 0.1]), np.array([True, False]))
    for source, options, message in (
        (pairs, {"times": file.times}, "^expected no times beside scored pairs"),
        (file, {"distance": "cosin"}, "did you mean cosine"),
        (file.descriptors, {}, "expected positions of 800 frames"),
        (file, {"positions": file.positions[:9]}, r"found float64 \(9, 3\)"),
    ):
        with pytest.raises(ValueError, match=message):
            evaluate(source, **options)


def test_false_positives_are_sorted_by_distance_without_neighbours(mistaken):
    result = TOP1_F1MAX(mistaken)
    assert np.sum(result.decisions == Decision.FALSE_POSITIVE) == 3
    first, second = Evaluation("", "", {"": [result]}, mistaken.positions).worst_false_positives
    assert (first.query, first.answer, first.distance) == (500, 10, 0)
    assert (second.query, second.answer) == (600, 20)
    assert second.distance == pytest.approx(0.001, rel=1e-3)
    assert second.metres == pytest.approx(np.linalg.norm(mistaken.positions[600] - mistaken.positions[20]))
