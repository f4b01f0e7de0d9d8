"""KITTI's layout: frames go by their number, the pose file is chosen by name, and every gap gives one clear error."""

import numpy as np
import pytest

from sglpr_jax.data.mounting import MODEL_HEIGHT_M, Mounting
from sglpr_jax.data.readers import open_recording, recording_names


def test_sparse_scans_take_their_own_rows(kitti_root):
    sequence = open_recording(kitti_root, "08")
    assert (sequence.name, sequence.ids, len(sequence)) == ("08", ("000000", "000002", "000003"), 3)
    np.testing.assert_array_equal(sequence.positions, [[0, -1, -2], [20, -1, -2], [30, -1, -2]])
    np.testing.assert_array_equal(sequence.times, [0, 0.2, 0.3])
    np.testing.assert_array_equal(sequence.points(1)[:2], [[100, 101, 102], [104, 105, 106]])


def test_labels_where_there_are_any(kitti_root):
    sequence = open_recording(kitti_root, "08")
    assert sequence.has_labels
    np.testing.assert_array_equal(sequence.labels(0), [48, 49, 50, 51, 52])
    assert sequence.labels(1) is None
    for path in (kitti_root / "sequences/08/labels").iterdir():
        path.unlink()
    assert not open_recording(kitti_root, "08").has_labels


@pytest.mark.parametrize(
    "poses, source, height",
    [
        ("auto", "sequences/08/poses.txt", -2),
        ("semantickitti", "sequences/08/poses.txt", -2),
        ("kitti", "poses/08.txt", -52),
    ],
)
def test_the_pose_file_is_chosen_and_named(kitti_root, poses, source, height):
    sequence = open_recording(kitti_root, "08", pose_source=poses)
    assert sequence.pose_source == source
    assert sequence.positions[0, 2] == height


def test_a_sequence_without_poses_opens_and_those_that_were_asked_for_are_named(kitti_root):
    (kitti_root / "sequences/08/poses.txt").unlink()
    (kitti_root / "poses/08.txt").unlink()
    sequence = open_recording(kitti_root, "08")
    assert sequence.positions is None and sequence.pose_source is None
    np.testing.assert_array_equal(sequence.times, [0, 0.2, 0.3])
    assert len(sequence.points(1)) == 5
    with pytest.raises(FileNotFoundError, match=r"expected poses in poses/08\.txt, found none"):
        open_recording(kitti_root, "08", pose_source="kitti")


@pytest.mark.parametrize("file, what", [("poses.txt", "poses"), ("times.txt", "times")])
def test_too_few_rows_name_the_frame(kitti_root, file, what):
    path = kitti_root / "sequences/08" / file
    path.write_text("".join(path.read_text().splitlines(keepends=True)[:3]))
    with pytest.raises(ValueError, match=rf"{what}\.txt: expected at least 4 rows \(frame 3\), found 3"):
        open_recording(kitti_root, "08")


def test_simulated_drives_know_how_high_their_sensor_stood(kitti_root):
    settings = kitti_root / "simulation.json"
    settings.write_text('{"sensor": {"height_m": 0.8}}')
    sequence = open_recording(kitti_root, "08")
    assert sequence.mounting == Mounting(0.8) and sequence.found[-1] == "sensor: 0.80 m above the ground, as simulated"
    lowered = sequence.record(0).points - [0, 0, MODEL_HEIGHT_M - 0.8]
    np.testing.assert_allclose(sequence.record(0).upright_points, lowered, rtol=1e-6)
    settings.write_text(f'{{"sensor": {{"height_m": {MODEL_HEIGHT_M}}}}}')
    assert open_recording(kitti_root, "08").mounting is None
    for damaged in ("[]", '{"sensor": 1}', '{"sensor": {"height_m": "high"}}'):
        settings.write_text(damaged)
        with pytest.raises(ValueError, match=r"simulation\.json: expected the settings of a simulated dataset"):
            open_recording(kitti_root, "08")
    settings.write_text('{"sensor": {"height_m": NaN}}')
    with pytest.raises(ValueError, match=r"simulation\.json: .*(height|NaN)"):
        open_recording(kitti_root, "08")


def test_the_real_layout(shared):
    root = shared / "data/kitti_odometry"
    assert recording_names(root) == ("00", "08")
    sequence = open_recording(root, "00")
    assert (len(sequence), sequence.ids[-1], sequence.pose_source) == (11, "004501", "sequences/00/poses.txt")
    labelled = [i for i in range(len(sequence)) if sequence.labels(i) is not None]
    assert [sequence.ids[i] for i in labelled] == ["000000", "000001", "000002", "000052", "000088", "000850", "004501"]
    for i in range(len(sequence)):
        points = sequence.points(i)
        assert len(points) > 100_000
        assert np.abs(points).max() < 120
    loop = [sequence.ids.index(name) for name in ("000052", "004501")]
    assert np.linalg.norm(np.diff(sequence.positions[loop], axis=0)) == pytest.approx(3.00, abs=0.01)
