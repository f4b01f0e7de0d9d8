"""Methods are compared on the same frames, positions and times, or not at all."""

import dataclasses

import numpy as np
import pytest

from sglpr_jax.evaluation.inputs.agreement import check_agreement
from sglpr_jax.evaluation.protocols.source import ScoredPairs, TopK
from sglpr_jax.evaluation.scoring import evaluate_methods


@pytest.fixture
def file(make_file):
    return make_file(np.arange(9.0).reshape(3, 3), np.eye(3), times=np.arange(3.0))


def test_the_same_frames_agree_whatever_describes_them(file):
    check_agreement(file, dataclasses.replace(file, descriptors=np.ones((3, 7), np.float32), weights_hash="other"))
    check_agreement(file, dataclasses.replace(file, positions=file.positions + 1e-4))
    check_agreement(file, TopK("town", file.positions, file.times, None, np.arange(1), np.zeros((1, 1), int)))
    check_agreement(file, ScoredPairs(np.array([[7, 8]]), np.ones(1), np.ones(1, bool)))


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"ids": ("000000", "000001", "000005")}, "3 with '000002', found 3 with '000005'"),
        (
            {"positions": np.zeros((3, 3))},
            r"positions of the first file, \[6.0, 7.0, 8.0\] in row 2, found \[0.0, 0.0, 0.0\]",
        ),
        ({"times": None}, "expected times in both files or in neither, found times in the first and none in this one"),
        ({"times": np.array([0.0, 1.0, 2.5])}, "times of the first file, 2.0 in row 2, found 2.5"),
    ],
)
def test_other_frames_positions_or_times_are_refused(file, change, message):
    other = dataclasses.replace(file, **change)
    with pytest.raises(ValueError, match=message):
        check_agreement(file, other)
    with pytest.raises(ValueError, match=f"theirs: .*{message}"):
        evaluate_methods({"ours": file, "theirs": other}, ["top1-f1max"])


def test_a_scan_that_one_method_skipped_is_named(make_file, file):
    fewer = dataclasses.replace(
        file, ids=file.ids[1:], positions=file.positions[1:], times=file.times[1:], descriptors=file.descriptors[1:]
    )
    with pytest.raises(ValueError, match="3 with '000000', found 2 with '000001'"):
        check_agreement(file, fewer)
    shorter = TopK("town", file.positions[:2], None, None, np.arange(1), np.zeros((1, 1), int))
    with pytest.raises(ValueError, match="expected 3 positions, as in the first file, found 2"):
        check_agreement(file, shorter)
