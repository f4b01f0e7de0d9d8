"""Raw SemanticKITTI ids become the classes of the dataset's own map."""

import re

import numpy as np
import pytest

from sglpr_jax.labels import CATEGORIES, COLORS, to_classes


def test_some_known_ids():
    raw = np.array([[0, 10, 252], [40, 60, 81]])
    np.testing.assert_array_equal(to_classes(raw), [[0, 1, 1], [9, 9, 19]])
    assert to_classes(raw).dtype == np.int32


def test_every_class_has_a_name_and_a_colour_of_its_own():
    assert len(set(CATEGORIES)) == 20
    assert len(np.unique(COLORS, axis=0)) == 20


@pytest.mark.parametrize("unknown", [-1, 2, 26, 260, 65535])
def test_an_unknown_id_is_named(unknown):
    with pytest.raises(ValueError, match=rf"found \[{unknown}\]"):
        to_classes(np.array([10, unknown]))


def test_the_map_names_and_colours_are_those_of_semantic_kitti(shared):
    sections = _sections((shared / "data/kitti_odometry/semantic-kitti.yaml").read_text())
    learning_map = {int(raw): int(value) for raw, value in sections["learning_map"].items()}
    assert len(learning_map) == 34
    raw = np.array(list(learning_map))
    np.testing.assert_array_equal(to_classes(raw), list(learning_map.values()))
    for class_id, raw_id in sections["learning_map_inv"].items():
        assert CATEGORIES[int(class_id)] == sections["labels"][raw_id].strip('"')
        blue_green_red = [int(channel) for channel in re.findall(r"\d+", sections["color_map"][raw_id])]
        assert COLORS[int(class_id)].tolist() == blue_green_red[::-1]


def test_real_labels_have_classes(shared):
    path = shared / "data/kitti_odometry/sequences/00/labels/000000.label"
    classes = to_classes((np.fromfile(path, "<u4") & 0xFFFF).astype(np.int32))
    assert {CATEGORIES.index(name) for name in ("car", "road", "building")} <= set(classes.tolist())


def _sections(text: str) -> dict[str, dict[str, str]]:
    """Parse as much YAML as the file needs: sections of `key: value` lines, with comments."""
    sections: dict[str, dict[str, str]] = {}
    current: dict[str, str] = {}
    for line in text.splitlines():
        if section := re.match(r"(\w+):", line):
            current = sections.setdefault(section[1], {})
        elif entry := re.match(r"\s+(\d+)\s*:\s*([^#]+)", line):
            current[entry[1]] = entry[2].strip()
    return sections
