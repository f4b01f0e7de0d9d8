"""Images and label images: their orientation, and files that are refused by name."""

import numpy as np
import pytest
from PIL import Image

from sglpr_jax.categories import RAW_NAMES
from sglpr_jax.data.formats.png import label_image_pixels, read_grey_png, read_label_image
from sglpr_jax.data.readers.bev_images import read_image


@pytest.fixture
def write(tmp_path):
    """Write pixels, or the bytes of a file, to 7.png."""

    def write(content):
        path = tmp_path / "7.png"
        path.write_bytes(content) if isinstance(content, bytes) else Image.fromarray(content).save(path)
        return path

    return write


def test_forward_points_right_and_left_points_up(write):
    grey = np.zeros((5, 5), np.uint8)
    grey[0, 2] = 255  # the first row lies ahead
    grey[2, 0] = 51  # the first column lies to the left
    image = read_image(write(grey))
    assert image.dtype == np.float32
    assert image[2, 4] == 10.0  # eq. 1: x grows with the column
    assert image[0, 2] == pytest.approx(2.0)  # eq. 1: y grows against the row
    assert np.count_nonzero(image) == 2


def test_labels_that_are_written_are_read_back(write):
    raw = np.random.default_rng(0).choice(list(RAW_NAMES), (7, 5)).astype(np.int32)
    found = read_label_image(write(label_image_pixels(raw)), shape=raw.shape)
    np.testing.assert_array_equal(found, raw)
    assert found.dtype == np.int32


@pytest.mark.parametrize(
    ("pixels", "message"),
    [
        (np.full((5, 7), 9, np.uint8), r"expected a 16-bit grey PNG \(mode I;16\), found mode L"),
        (np.zeros((7, 5), np.uint16), "expected 5 rows of 7 pixels, the size of the image, found 7 rows of 5"),
        (np.full((5, 7), 19, np.uint16), r"expected raw SemanticKITTI ids, found \[19\]"),
    ],
    ids=["8 bits", "size", "ids"],
)
def test_wrong_labels_are_named(write, pixels, message):
    with pytest.raises(ValueError, match=rf"7\.png: {message}"):
        read_label_image(write(pixels), shape=(7, 5))


def test_damaged_and_missing_images_are_named(write, tmp_path):
    whole = write(np.arange(35, dtype=np.uint8).reshape(5, 7)).read_bytes()
    broken = [whole[:0], whole[:20], whole[:50], whole[:45] + bytes([whole[45] ^ 1]) + whole[46:]]
    for content in broken:
        with pytest.raises(ValueError, match=r"7\.png: expected an 8-bit grey PNG, found another or a damaged file"):
            read_grey_png(write(content), bits=8)
    with pytest.raises(ValueError, match=r"7\.png: expected an 8-bit grey PNG \(mode L\), found mode RGB"):
        read_grey_png(write(np.zeros((4, 4, 3), np.uint8)), bits=8)
    with pytest.raises(FileNotFoundError, match=r"b\.png: expected an image, found none"):
        read_grey_png(tmp_path / "b.png", bits=8)
