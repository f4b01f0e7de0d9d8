"""Our protocols applied to the published outputs of other methods give the published scores."""

import numpy as np
import pytest
from recordings import kitti_trajectory

from sglpr_jax.evaluation.protocols.pairs import frame_pairs, is_revisit
from sglpr_jax.evaluation.protocols.protocol import TopK
from sglpr_jax.evaluation.protocols.recall import SSC_RECALL
from sglpr_jax.evaluation.protocols.top1 import CONTOUR_CONTEXT_F1MAX, TOP1_F1MAX


@pytest.mark.parametrize(
    ("sequence", "rows", "recall"),
    [
        ("00", 804, 0.9925),
        ("02", 315, 0.9333),
        ("05", 503, 0.9960),
        ("06", 270, 1.0),
        ("07", 122, 0.9672),
        ("08", 345, 0.9826),
    ],
)
def test_ssc_lists_give_the_published_recall(shared, sequence, rows, recall):
    positions, times, source = kitti_trajectory(shared / "data/kitti_odometry", sequence, pose_source="semantickitti")
    listed = np.loadtxt(shared / f"data/protocol/ssc_top25_{sequence}.txt", dtype=np.int64)
    result = SSC_RECALL(TopK(sequence, positions, times, source, listed[:, 0], listed[:, 1:]))
    assert round(result.score, 4) == recall
    assert result.counts["queries"] == rows
    assert result.recalls[1] <= result.recalls[25] <= 1


def test_contour_context_outcome_gives_the_published_f1max(shared):
    lines = (shared / "data/protocol/contour_context_outcome_08.txt").read_text().splitlines()
    fields = [line.split() for line in lines]
    pairs = [field[1].split("-") for field in fields]  # "2000-x": no answer
    poses = np.loadtxt(shared / "data/protocol/contour_context_poses_08.txt")[:, 1:].reshape(-1, 3, 4)
    outcome = TopK(
        sequence="08",
        positions=poses[:, :, 3],
        times=None,
        pose_source="contour_context_poses_08.txt",
        queries=np.array([int(query) for query, _ in pairs]),
        nearest=np.array([[-1 if answer == "x" else int(answer)] for _, answer in pairs]),
        scores=np.array([[float(field[2])] for field in fields]),
    )
    result = CONTOUR_CONTEXT_F1MAX(outcome)
    best = result.curve.best
    assert len(outcome) == 4071
    assert result.counts["revisits"] == 347
    assert round(result.score, 4) == 0.9556
    assert round(result.curve.precision[best], 4) == 0.9758
    assert round(result.curve.recall[best], 4) == 0.9362
    assert result.curve.thresholds[best] == 0.649282
    assert round(result.recalls[1], 4) == 0.9481


@pytest.mark.parametrize(("sequence", "revisits"), [("05", 425), ("06", 268), ("07", 28)])
def test_numbers_of_revisits_equal_those_of_logg3d_net(shared, make_file, sequence, revisits):
    positions, times, _ = kitti_trajectory(shared / "data/kitti_odometry", sequence, pose_source="semantickitti")
    result = TOP1_F1MAX(make_file(positions, positions, times=times, sequence=sequence))
    assert result.counts["revisits"] == revisits


def test_positive_pairs_equal_those_of_rinet_on_kitti_poses(shared):
    rows = np.loadtxt(shared / "data/protocol/neg_100_07.txt", dtype=np.int64)
    published = {tuple(pair) for pair in rows[rows[:, 2] == 1, :2].tolist()}
    found = {}
    for poses in ("kitti", "semantickitti"):
        positions, _, _ = kitti_trajectory(shared / "data/kitti_odometry", "07", pose_source=poses)
        found[poses] = set(zip(*np.divmod(frame_pairs(positions[:, :2], is_revisit), len(positions)), strict=True))
    assert found["kitti"] == published
    assert len(published) == 1833
    assert found["semantickitti"] != published
