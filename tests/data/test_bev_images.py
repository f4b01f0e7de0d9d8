"""Ready-made BEV images: turned into eq. 1's orientation, on the scale of counts, with the poses of their frames."""

import numpy as np
import pytest
from PIL import Image

from sglpr_jax.data.readers import open_recording, recording_names


def test_a_sequence(bev_root):
    assert recording_names(bev_root) == ("06",)
    sequence = open_recording(bev_root, "06")
    assert (sequence.name, sequence.ids, len(sequence)) == ("06", ("000000", "000001", "000002"), 3)
    assert (sequence.times, sequence.pose_source, sequence.resolution_m) == (None, "06/pose.txt", 0.4)
    assert not sequence.has_labels
    np.testing.assert_array_equal(sequence.positions, np.arange(9.0).reshape(3, 3))
    assert sequence.image(2).shape == (7, 5)


def test_sparse_images_take_their_own_rows(bev_root):
    (bev_root / "06/imgs/000001.png").unlink()
    sequence = open_recording(bev_root, "06")
    assert sequence.ids == ("000000", "000002")
    np.testing.assert_array_equal(sequence.positions, [[0, 1, 2], [6, 7, 8]])


def test_labels_lie_beside_some_of_the_images(bev_root):
    (bev_root / "06/labels").mkdir()
    raw = np.arange(35, dtype=np.uint16).reshape(5, 7) // 34 * 252
    Image.fromarray(raw).save(bev_root / "06/labels/000001.png")
    sequence = open_recording(bev_root, "06")
    assert sequence.has_labels
    assert sequence.label_paths == (None, bev_root / "06/labels/000001.png", None)
    assert sequence.labels(0) is None
    np.testing.assert_array_equal(sequence.labels(1), np.rot90(raw, -1))
    Image.fromarray(raw[1:]).save(bev_root / "06/labels/000001.png")
    with pytest.raises(ValueError, match=r"labels/000001\.png: expected 5 rows of 7 pixels, .*, found 4 rows"):
        sequence.labels(1)


def test_images_without_poses_have_no_positions(bev_root):
    (bev_root / "06/pose.txt").unlink()
    (bev_root / "06/imgs/000001.png").rename(bev_root / "06/imgs/000001-b.png")  # no row of a pose
    sequence = open_recording(bev_root, "06")
    assert (sequence.positions, sequence.pose_source, len(sequence)) == (None, None, 3)
    assert sequence.description[-1] == "times: none; poses: none"


def test_the_real_images(shared):
    root = shared / "data/kitti_bev"
    assert recording_names(root) == ("00", "02", "06")
    sequence = open_recording(root, "06")
    assert (len(sequence), sequence.positions.shape) == (1101, (1101, 3))
    image = sequence.image(500)
    assert image.shape == (151, 151)
    assert image.max() == pytest.approx(10.0)
    np.testing.assert_allclose(image / image.max() * 255, np.round(image / image.max() * 255), atol=1e-4)
    inner = np.zeros((151, 151), bool)
    inner[13:138, 13:138] = True  # the renderer's crop at 25 m
    assert not image[~inner].any()


def test_the_real_images_look_along_their_scans(shared):
    """The image of frame 0 of 00 and a rasterised scan of it, both in eq. 1's orientation, show the same walls."""
    images = open_recording(shared / "data/kitti_bev", "00")
    points = np.fromfile(shared / "data/kitti_odometry/sequences/00/velodyne/000000.bin", "<f4").reshape(-1, 4)[:, :3]
    points = points[points[:, 2] > -1.2]
    edges = (np.arange(152) - 75.5) * 0.4
    against_y, along_x = -points[:, 1], points[:, 0]
    occupied = np.histogram2d(against_y, along_x, bins=[edges, edges])[0] > 0
    image = images.image(0) > 0
    covered = {
        (turns, mirrored): (occupied & np.rot90(image[::mirrored], turns)).sum() / image.sum()
        for turns in range(4)
        for mirrored in (1, -1)
    }
    assert max(covered, key=lambda seen: covered[seen]) == (0, 1)
    assert covered[0, 1] > 0.75
