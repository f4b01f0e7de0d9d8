"""Ready-made BEV images: turned into eq. 1's orientation, on the scale of counts, with the poses of their frames."""

import struct
import zlib

import numpy as np
import pytest
from PIL import Image

from sglpr_jax.data.formats import png
from sglpr_jax.data.readers.bev_images import open_recording, read_image, recording_names


def test_a_sequence(bev_root):
    assert recording_names(bev_root) == ("06",)
    sequence = open_recording(bev_root, "06")
    assert (sequence.name, sequence.ids, len(sequence)) == ("06", ("000000", "000001", "000002"), 3)
    assert (sequence.times, sequence.pose_source, sequence.resolution_m) == (None, "06/pose.txt", 0.4)
    assert not sequence.has_labels
    np.testing.assert_array_equal(sequence.positions, np.arange(9.0).reshape(3, 3))
    assert sequence.image(2).shape == (7, 5)


def test_forward_points_right_and_left_points_up(tmp_path):
    grey = np.zeros((5, 5), np.uint8)
    grey[0, 2] = 255  # the first row lies ahead
    grey[2, 0] = 51  # the first column lies to the left
    Image.fromarray(grey).save(tmp_path / "a.png")
    image = read_image(tmp_path / "a.png")
    assert image.dtype == np.float32
    assert image[2, 4] == 10.0  # eq. 1: x grows with the column
    assert image[0, 2] == pytest.approx(2.0)  # eq. 1: y grows against the row
    assert np.count_nonzero(image) == 2


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


def test_too_few_poses_name_the_frame(bev_root):
    path = bev_root / "06/pose.txt"
    path.write_text("".join(path.read_text().splitlines(keepends=True)[:2]))
    with pytest.raises(ValueError, match=r"pose\.txt: expected at least 3 rows \(frame 2\), found 2"):
        open_recording(bev_root, "06")


def test_images_without_poses_have_no_positions(bev_root):
    (bev_root / "06/pose.txt").unlink()
    (bev_root / "06/imgs/000001.png").rename(bev_root / "06/imgs/000001-b.png")  # no row of a pose
    sequence = open_recording(bev_root, "06")
    assert (sequence.positions, sequence.pose_source, len(sequence)) == (None, None, 3)
    assert sequence.description[-1] == "times: none; poses: none"


def test_missing_images_are_named(bev_root):
    (bev_root / "07/imgs").mkdir(parents=True)
    with pytest.raises(FileNotFoundError, match=r"07/imgs: expected images \(\*\.png\), found none"):
        open_recording(bev_root, "07")


@pytest.mark.parametrize("kept", [0, 20, 50])
def test_a_cut_off_image_is_named(bev_root, kept):
    path = bev_root / "06/imgs/000000.png"
    path.write_bytes(path.read_bytes()[:kept])
    with pytest.raises(ValueError, match=r"000000\.png: expected an 8-bit grey PNG"):
        open_recording(bev_root, "06").image(0)


def png_of(width: int, height: int, data: bytes, *, interlaced: int = 0) -> bytes:
    """A PNG of 8 grey bits with this header and this compressed data."""

    def chunk(kind: bytes, content: bytes) -> bytes:
        return struct.pack(">I", len(content)) + kind + content + struct.pack(">I", zlib.crc32(kind + content))

    header = struct.pack(">IIBBBBB", width, height, 8, 0, 0, 0, interlaced)
    return b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", header) + chunk(b"IDAT", data) + chunk(b"IEND", b"")


@pytest.mark.parametrize(
    ("width", "height", "data", "message"),
    [
        (16384, 16384, b"", "declares 16384 x 16384 pixels, more than 8192 a side"),
        (8192, 8192, b"", "declares 8192 x 8192 pixels, but the data has another size"),
        (64, 64, bytes(64 * 65 - 1), "declares 64 x 64 pixels, but the data has another size"),
        (64, 64, bytes(64 * 65 + 1), "declares 64 x 64 pixels, but the data has another size"),
        (64, 64, bytes(10**8), "declares 64 x 64 pixels, but the data has another size"),
    ],
    ids=["side", "empty", "one less", "one more", "100 MB"],
)
def test_a_png_whose_header_lies_is_refused(tmp_path, monkeypatch, width, height, data, message):
    (tmp_path / "a.png").write_bytes(png_of(width, height, zlib.compress(data)))
    monkeypatch.setattr(png.Image, "open", lambda path: pytest.fail("the image was opened"))
    with pytest.raises(ValueError, match=rf"a\.png: expected an 8-bit grey PNG, found .*{message}"):
        read_image(tmp_path / "a.png")


def test_data_that_inflates_is_not_inflated_beyond_the_declared_size(tmp_path, monkeypatch):
    inflated, real = [], zlib.decompressobj

    class Inflating:
        def __init__(self):
            self._real = real()

        def decompress(self, data, most):
            inflated.append(self._real.decompress(data, most))
            return inflated[-1]

        eof = property(lambda self: self._real.eof)

    monkeypatch.setattr(png.zlib, "decompressobj", Inflating)
    (tmp_path / "a.png").write_bytes(png_of(64, 64, zlib.compress(bytes(10**7))))
    with pytest.raises(ValueError, match=r"a\.png"):
        read_image(tmp_path / "a.png")
    assert [len(data) for data in inflated] == [64 * 65 + 1]


@pytest.mark.parametrize("shape", [(1, 1), (3, 2), (7, 5), (8, 8), (9, 17)])
def test_interlaced_images_are_read_and_must_be_whole(tmp_path, shape):
    grey = np.random.default_rng(0).integers(0, 255, shape).astype(np.uint8)
    passes = ((0, 0, 8, 8), (4, 0, 8, 8), (0, 4, 4, 8), (2, 0, 4, 4), (0, 2, 2, 4), (1, 0, 2, 2), (0, 1, 1, 2))
    parts = [grey[y::dy, x::dx] for x, y, dx, dy in passes]
    data = b"".join(b"\0" + row.tobytes() for part in parts if part.size for row in part)
    path = tmp_path / "a.png"
    path.write_bytes(png_of(shape[1], shape[0], zlib.compress(data), interlaced=1))
    np.testing.assert_array_equal(png.read_grey_png(path, bits=8), np.rot90(grey, -1))
    path.write_bytes(png_of(shape[1], shape[0], zlib.compress(data[:-1]), interlaced=1))
    with pytest.raises(ValueError, match=r"a\.png: .*but the data has another size"):
        read_image(path)


def test_a_colour_image_is_refused(tmp_path):
    Image.fromarray(np.zeros((4, 4, 3), np.uint8)).save(tmp_path / "a.png")
    with pytest.raises(ValueError, match=r"a\.png: expected an 8-bit grey PNG \(mode L\), found mode RGB"):
        read_image(tmp_path / "a.png")
    with pytest.raises(FileNotFoundError, match=r"b\.png: expected an image, found none"):
        read_image(tmp_path / "b.png")


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
