"""Input files of any method: their content, the protocols that fit, and errors of invalid files."""

import dataclasses

import numpy as np
import pytest

from sglpr_jax.data.formats.pose_files import Trajectory
from sglpr_jax.evaluation.inputs import check_agreement, read_input, read_methods
from sglpr_jax.evaluation.protocols import check_names, chosen_protocols, protocols_taking
from sglpr_jax.evaluation.protocols.protocol import ScoredPairs, TopK, kind_of
from sglpr_jax.evaluation.protocols.top1 import TOP1_F1MAX
from sglpr_jax.evaluation.scoring import evaluate_methods


@pytest.fixture
def poses(two_laps) -> Trajectory:
    return Trajectory(two_laps, np.arange(800) * 0.5, "laps.csv (csv)")


@pytest.fixture
def read(tmp_path, poses):
    """Return a function that writes a file (text, bytes or array) and reads it with `read_input`."""

    def read(name, content, *, trajectory=poses, **options):
        path = tmp_path / name
        if isinstance(content, np.ndarray):
            np.save(path, content)
        else:
            path.write_bytes(content if isinstance(content, bytes) else content.encode())
        return read_input(path, trajectory, sequence="town", **options)

    return read


def test_a_matrix_has_the_score_of_a_descriptor_file(read, make_file, two_laps):
    rows = np.abs(two_laps).astype(np.uint8)
    found = read("mine.npy", rows)
    assert (found.sequence, found.distance, found.pose_source) == ("town", "l2", "laps.csv (csv)")
    assert found.config == {"method": "mine"} and found.ids[:2] == ("000000", "000001")
    times = np.arange(800) * 0.5
    assert TOP1_F1MAX(found).score == TOP1_F1MAX(make_file(two_laps, rows, times=times)).score
    assert read("mine.npy", rows, distance="cosine").distance == "cosine"


def test_poses_are_interpolated_at_the_times_of_a_descriptor_file(tmp_path, make_file, two_laps):
    times = np.arange(800) * 0.1
    make_file(two_laps, two_laps, times=times).save(tmp_path / "own.npz")
    stamps = np.arange(0.25, 60, 0.5)
    poses = Trajectory(stamps[:, None] * [10.0, 0, 0], stamps, "a.tum (TUM)")
    found = read_input(tmp_path / "own.npz", poses, sequence="x")
    assert found.ids[0] == "000002" and len(found) == 597
    np.testing.assert_allclose(found.positions[:, 0], np.maximum(times[2:599], 0.25).clip(max=59.75) * 10)
    np.testing.assert_array_equal(found.times, times[2:599])
    said = "a.tum (TUM), interpolated at the times of the scans; 203 of 800 scans left out, which have no pose"
    assert found.pose_source == said
    late = dataclasses.replace(poses, times=stamps + 1e6)
    message = r"own\.npz: a\.tum \(TUM\): expected 800 poses, one for each frame of own\.npz, at its time"
    with pytest.raises(ValueError, match=message):
        read_input(tmp_path / "own.npz", late, sequence="x")


def test_poses_of_all_scans_fit_a_file_with_skipped_scans(tmp_path, make_file, two_laps, poses):
    whole = dataclasses.replace(make_file(two_laps, two_laps), positions=None)
    kept = ~np.isin(np.arange(800), (3, 700))
    whole.only(kept).save(tmp_path / "own.npz")
    found = read_input(tmp_path / "own.npz", poses, sequence="x")
    np.testing.assert_array_equal(found.positions, two_laps[kept])
    np.testing.assert_array_equal(found.times, poses.times[kept])
    assert found.pose_source == "laps.csv (csv)" and "000003" not in found.ids
    few = dataclasses.replace(poses, positions=two_laps[:790], times=None)
    with pytest.raises(ValueError, match=r"own\.npz: .*expected 798 poses, one for each frame of own\.npz, found 790"):
        read_input(tmp_path / "own.npz", few, sequence="x")


def test_other_methods_get_positions_and_times_of_the_descriptor_file(tmp_path, make_file, two_laps):
    make_file(two_laps, two_laps, times=np.arange(800) * 0.1).save(tmp_path / "own.npz")
    np.save(tmp_path / "mine.npy", two_laps)
    (tmp_path / "list.txt").write_text("400: 0\n")
    found = read_methods([tmp_path / name for name in ("own.npz", "mine.npy", "list.txt")])
    for name in ("mine", "list"):
        check_agreement(found["own"], found[name])
        np.testing.assert_array_equal(found[name].times, found["own"].times)
        assert found[name].pose_source == "made up"


def test_methods_with_poses_without_times_get_the_times_of_a_descriptor_file(tmp_path, make_file, two_laps, poses):
    names = ("mine.npy", "pairs.txt", "own.npz")
    make_file(two_laps, two_laps, times=np.arange(800) * 0.1).save(tmp_path / "own.npz")
    np.save(tmp_path / "mine.npy", two_laps)
    (tmp_path / "pairs.txt").write_text("400 0 0.5\n")
    found = read_methods([tmp_path / name for name in names], poses=dataclasses.replace(poses, times=None))
    np.testing.assert_array_equal(found["mine"].times, np.arange(800) * 0.1)
    check_agreement(found["mine"], found["own"])


def test_descriptor_files_without_positions_or_times_get_those_of_the_first_file_or_the_dataset(
    tmp_path, make_file, two_laps, poses
):
    bare, own, untimed = (tmp_path / f"{name}.npz" for name in ("bare", "own", "untimed"))
    dataclasses.replace(make_file(two_laps, two_laps), positions=None).save(bare)
    make_file(two_laps + 1, two_laps, times=poses.times).save(own)
    make_file(two_laps + 1, two_laps).save(untimed)
    (found,) = read_methods([bare], dataset=poses).values()
    np.testing.assert_array_equal(found.positions, two_laps)
    assert found.times is poses.times and found.pose_source == "laps.csv (csv)"
    found = read_methods([own, bare, untimed], dataset=poses)
    for name in ("bare", "untimed"):
        check_agreement(found["own"], found[name])
        np.testing.assert_array_equal(found[name].positions, two_laps + 1)
        np.testing.assert_array_equal(found[name].times, poses.times)


def test_top_k_lists_and_scored_pairs(read):
    found = read("list.txt", "# query: answers\n400: 0=.9 7=-.5\n\n401:\n402: 2=0.25\n")
    assert isinstance(found, TopK)
    np.testing.assert_array_equal(found.queries, [400, 401, 402])
    np.testing.assert_array_equal(found.nearest, [[0, 7], [-1, -1], [2, -1]])
    np.testing.assert_array_equal(found.scores, [[0.9, -0.5], [0, 0], [0.25, 0]])
    bare = read("list.txt", "400: 0 7\n401: 1\n")
    np.testing.assert_array_equal(bare.nearest, [[0, 7], [1, -1]])
    assert bare.scores is None and read("list.txt", "400:\n").scores is None
    pairs = read("pairs.txt", "000400 000000 0.5 1\n100 0 -1e-3 0\n")
    assert isinstance(pairs, ScoredPairs)
    np.testing.assert_array_equal(pairs.pairs, [[400, 0], [100, 0]])
    np.testing.assert_array_equal(pairs.scores, [0.5, -1e-3])
    np.testing.assert_array_equal(pairs.labels, [True, False])
    assert read("pairs.txt", "400 0 0.5\n").labels is None
    assert read("pairs.txt", "9999 0 0.5 1\n", trajectory=None).positions is None


@pytest.mark.parametrize(
    ("name", "content", "error"),
    [
        ("pickle.npy", np.full((800, 2), None), "found no valid .npy file .*allow_pickle=False"),
        ("pairs.txt", "5 0 .5\n5 800 .5\n", r"line 2: expected frames from 0 to 799 \(laps.csv .csv.\), found 800"),
        ("list.txt", "5: 0=.5 3\n", "expected a score for every retrieved frame or for none, found 1 without"),
    ],
)
def test_bad_input_raises_an_error_with_the_file_name(read, monkeypatch, name, content, error):
    monkeypatch.setattr("pickle.load", lambda *_, **__: pytest.fail("a pickle was read"))
    with pytest.raises(ValueError, match=rf"{name}.*{error}"):
        read(name, content)


def test_pairs_have_the_published_numbers_of_their_sequence(read):
    pairs = read("pairs.txt", "400 0 0.5 1\n100 0 0.1 0\n")
    assert evaluate_methods({"mine": dataclasses.replace(pairs, sequence="08")}, published=True).published
    with pytest.raises(ValueError, match=r"expected a sequence with published numbers, .*, found town"):
        evaluate_methods({"mine": pairs}, published=True)


def test_default_protocols_fit_the_input(read):
    inputs = read("a.npy", np.ones((800, 2))), read("p.txt", "5 0 .5\n"), read("b.txt", "5: 0\n")
    matrix, pairs, bare = map(kind_of, inputs)
    assert chosen_protocols(matrix, ()) == ["top1-f1max", "pairs-f1max", "bevplace-recall-at-1"]
    assert chosen_protocols(matrix, ["all"]) == list(protocols_taking(matrix))
    assert chosen_protocols(bare, ()) == ["bevplace-recall-at-1"]
    assert chosen_protocols(pairs, ()) == chosen_protocols(pairs, ["all"]) == ["listed-pairs-f1max"]
    assert chosen_protocols(matrix, ["ssc-recall", "ssc-recall"]) == ["ssc-recall"]
    with pytest.raises(ValueError, match=r"for a top-k list without scores, which are .*; found top1-f1max"):
        chosen_protocols(bare, ["top1-f1max"])
    check_names(["all", "ssc-recall", "listed-pairs-f1max"])
    with pytest.raises(ValueError, match="expected a protocol, found 'top1'; did you mean 'top1-f1max'"):
        check_names(["top1"])


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"ids": ("a", "b", "d")}, "3 with 'c', found 3 with 'd'"),
        ({"times": np.array([0.0, 1.0, 2.5])}, "times of the first file, 2.0 in row 2, found 2.5"),
    ],
)
def test_other_frames_positions_or_times_are_refused(make_file, change, message):
    few = make_file(np.arange(9.0).reshape(3, 3), np.eye(3), times=np.arange(3.0))
    few = dataclasses.replace(few, ids=("a", "b", "c"))
    other = dataclasses.replace(few, **change)
    with pytest.raises(ValueError, match=f"theirs: .*{message}"):
        evaluate_methods({"ours": few, "theirs": other}, ["top1-f1max"])


def test_row_numbers_as_ids_fit_any_ids_of_as_many_frames(make_file):
    rows = make_file(np.arange(9.0).reshape(3, 3), np.eye(3))
    named = dataclasses.replace(rows, ids=("1328", "1329", "1330"))
    check_agreement(named, rows)
    check_agreement(rows, named)
    with pytest.raises(ValueError, match="the first file, 3 with '1328', found 2 with '000000'"):
        check_agreement(named, rows.only(np.array([True, True, False])))
    with pytest.raises(ValueError, match="the first file, 2 with '000000', found 2 with '000001'"):
        check_agreement(*(rows.only(np.array(kept)) for kept in ([True, True, False], [False, True, True])))
