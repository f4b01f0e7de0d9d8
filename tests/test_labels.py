"""Raw SemanticKITTI ids become the classes of each setting of figure 9."""

import numpy as np
import pytest
import yaml

from sglpr_jax.categories import RAW_NAMES
from sglpr_jax.labels import CATEGORIES, taxonomy, to_classes, to_raw

SETTINGS = (6, 15, 20, 25, 34)


@pytest.mark.parametrize("categories", SETTINGS)
def test_every_raw_id_has_a_class_with_a_name_and_a_colour_of_its_own(categories):
    found = taxonomy(categories)
    k = len(found.names)
    assert k - categories == (1 if categories in (6, 25) else 0)  # where the unlabelled class comes on top
    assert found.names[0] == "unlabeled" and len(set(found.names)) == k
    assert found.colors.shape == (k, 3) and len(np.unique(found.colors, axis=0)) == k
    classes = to_classes(np.array(list(RAW_NAMES)), categories=categories)
    assert classes[0] == 0 and set(classes.tolist()) == set(range(k))


@pytest.mark.parametrize("categories", SETTINGS)
def test_the_raw_id_of_a_class_becomes_that_class(categories):
    classes = np.arange(len(taxonomy(categories).names)).reshape(1, -1)
    raw = to_raw(classes, categories=categories)
    assert raw[0, 0] == 0 and raw.shape == classes.shape
    np.testing.assert_array_equal(to_classes(raw, categories=categories), classes)


def test_moving_objects_have_the_classes_of_the_paper():
    moving, movable = np.arange(252, 260), np.array([10, 11, 13, 15, 16, 18, 20, 30, 31, 32])
    twins = np.array([10, 31, 30, 32, 16, 13, 18, 20])
    np.testing.assert_array_equal(to_classes(moving), to_classes(twins))
    assert {taxonomy(25).names[c] for c in to_classes(moving, categories=25)} == {"moving"}
    assert "moving" not in {taxonomy(25).names[c] for c in to_classes(movable, categories=25)}
    assert not to_classes(np.append(moving, movable), categories=15).any()


@pytest.mark.parametrize("unknown", [-1, 2, 26, 260, 65535])
def test_an_unknown_id_is_named(unknown):
    with pytest.raises(ValueError, match=rf"found \[{unknown}\]"):
        to_classes(np.array([10, unknown]))


def test_an_unknown_setting_lists_those_there_are():
    with pytest.raises(ValueError, match="expected one of 6, 15, 20, 25, 34, found 19"):
        taxonomy(19)


def test_the_map_names_and_colours_are_those_of_semantic_kitti(shared):
    sections = yaml.safe_load((shared / "data/kitti_odometry/semantic-kitti.yaml").read_text())
    assert sections["labels"] == RAW_NAMES
    assert len(sections["learning_map"]) == 34
    raw = np.array(list(sections["learning_map"]))
    np.testing.assert_array_equal(to_classes(raw), list(sections["learning_map"].values()))
    for class_id, raw_id in sections["learning_map_inv"].items():
        assert CATEGORIES[class_id] == sections["labels"][raw_id]
        assert taxonomy().colors[class_id].tolist() == sections["color_map"][raw_id][::-1]  # blue, green, red
