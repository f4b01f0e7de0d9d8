"""Label images: raw ids that lie on their image, pixel for pixel, and files that are refused by name."""

import numpy as np
import pytest
from PIL import Image

from sglpr_jax.categories import RAW_NAMES
from sglpr_jax.data.formats.png import label_image_pixels, read_label_image
from sglpr_jax.data.readers.bev_images import read_image


@pytest.fixture
def path(tmp_path):
    return tmp_path / "000007.png"


def write(path, pixels: np.ndarray) -> None:
    Image.fromarray(pixels).save(path)


def test_a_map_lies_on_its_image(path, tmp_path):
    grey = np.random.default_rng(0).integers(0, 255, (5, 7)).astype(np.uint8)
    raw = np.where(grey > 120, 259, 40).astype(np.uint16)
    write(tmp_path / "image.png", grey)
    write(path, raw)
    image = read_image(tmp_path / "image.png")
    found = read_label_image(path, shape=(7, 5))
    assert found.dtype == np.int32
    np.testing.assert_array_equal(found, np.where(image > 120.5 * 10 / 255, 259, 40))


def test_what_is_written_is_read_back(path):
    raw = np.random.default_rng(0).choice(list(RAW_NAMES), (7, 5)).astype(np.int32)
    write(path, label_image_pixels(raw))
    np.testing.assert_array_equal(read_label_image(path, shape=raw.shape), raw)


def test_class_ids_of_8_bits_are_refused(path):
    write(path, np.full((5, 7), 9, np.uint8))
    with pytest.raises(ValueError, match=r"000007\.png: expected a 16-bit grey PNG \(mode I;16\), found mode L"):
        read_label_image(path, shape=(7, 5))


def test_a_map_of_another_size_is_refused(path):
    write(path, np.zeros((7, 5), np.uint16))
    with pytest.raises(
        ValueError, match=r"000007\.png: expected 5 rows of 7 pixels, the size of the image, found 7 rows of 5"
    ):
        read_label_image(path, shape=(7, 5))


def test_ids_that_do_not_exist_are_named(path):
    write(path, np.full((5, 7), 19, np.uint16))
    with pytest.raises(ValueError, match=r"000007\.png: expected raw SemanticKITTI ids, found \[19\]"):
        read_label_image(path, shape=(7, 5))


@pytest.mark.parametrize("kept", [0, 20, 50])
def test_a_cut_off_map_is_named(path, kept):
    write(path, np.arange(35, dtype=np.uint16).reshape(5, 7))
    path.write_bytes(path.read_bytes()[:kept])
    with pytest.raises(ValueError, match=r"000007\.png: expected a 16-bit grey PNG"):
        read_label_image(path, shape=(7, 5))


def test_a_missing_map_is_named(path):
    with pytest.raises(FileNotFoundError, match=r"000007\.png: expected an image, found none"):
        read_label_image(path, shape=(7, 5))
