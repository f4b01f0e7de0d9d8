import numpy as np
from PIL import Image
from scenes import place, relative, seen_from

from sglpr_jax.evaluation import figures
from sglpr_jax.evaluation.protocols.result import Decision
from sglpr_jax.labels import CATEGORIES, taxonomy
from sglpr_jax.metrics import PrecisionRecallCurve
from sglpr_jax.se3 import transform


def pixels(figure, path):
    """Return the pixels (h, w, 3) of the saved picture."""
    figures.save(figure, path)
    assert [found.name for found in path.parent.iterdir()] == [path.name]
    with Image.open(path) as image:
        return np.asarray(image.convert("RGB")).astype(int)


def shows(picture, colour):
    """Return whether at least 20 pixels have this colour."""
    return np.sum(np.abs(picture - np.array(colour)).max(axis=-1) <= 3) >= 20


def legend(figure):
    drawn = [*figure.legends, figure.axes[0].get_legend()]
    return [text.get_text() for box in drawn if box is not None for text in box.get_texts()]


def test_precision_recall_names_each_curve_with_its_f1max(tmp_path):
    thresholds, recall = np.arange(3.0), np.array([1.0, 0.7, 0.3])
    good, poor = (
        PrecisionRecallCurve(thresholds, np.array(values), recall) for values in ([1.0, 1, 1], [0.5, 0.6, 0.4])
    )
    figure = figures.precision_recall({"good": good, "poor": poor}, title="Sequence 06")
    assert legend(figure) == ["good 1.000", f"poor {poor.f1_max:.3f}"]
    (axes,) = figure.axes
    assert (axes.get_xlabel(), axes.get_ylabel(), axes.get_title()) == ("recall", "precision", "Sequence 06")
    assert pixels(figure, tmp_path / "curve.png").std() > 10


def test_a_trajectory_shows_each_decision_in_its_colour(tmp_path, two_laps):
    decisions = np.full(800, Decision.NOT_A_QUERY, dtype=np.int8)
    decisions[300:400] = Decision.TRUE_NEGATIVE
    decisions[400:700] = Decision.TRUE_POSITIVE
    decisions[700:760] = Decision.FALSE_NEGATIVE
    figure = figures.trajectory(two_laps, decisions, title="Sequence 06")
    assert legend(figure) == ["not a query (340)", "true negative (100)", "true positive (300)", "false negative (60)"]
    (axes,) = figure.axes
    assert axes.get_aspect() == 1
    assert (axes.get_xlabel(), axes.get_ylabel()) == ("x [m]", "y [m]")
    picture = pixels(figure, tmp_path / "trajectory.png")
    assert shows(picture, (0x2B, 0x5F, 0xC4)) and not shows(picture, (0xD6, 0x27, 0x28))  # nothing is wrong, so no red
    assert shows(picture, (0xA9, 0xA9, 0xA9))


def test_a_segmentation_panel_has_metres_and_names_and_colours_of_classes(tmp_path):
    bev = np.zeros((20, 40), np.int32)
    bev[:, :20] = 3
    truth = np.where(bev > 0, CATEGORIES.index("road"), 0)
    prediction = np.where(bev > 0, CATEGORIES.index("building"), 0)
    moving = np.full((8, 8), taxonomy(25).names.index("moving"))
    assert legend(figures.segmentation_panel(moving, None, moving, resolution_m=1.0, categories=25)) == ["moving"]
    figure = figures.segmentation_panel(bev, truth, prediction, resolution_m=0.5, title="Sequence 08")
    counts, true_map, predicted = figure.axes
    assert legend(figure) == ["unlabeled", "road", "building"]
    for axes in (counts, true_map, predicted):
        assert axes.get_images()[0].get_extent() == [-10, 10, -5, 5]
    picture = pixels(figure, tmp_path / "classes.png")
    third = picture.shape[1] // 3
    road, building = taxonomy().colors[[CATEGORIES.index("road"), CATEGORIES.index("building")]]
    middle = picture[: picture.shape[0] // 2]
    assert shows(middle[:, third : 2 * third], road) and not shows(middle[:, third : 2 * third], building)
    assert shows(middle[:, 2 * third :], building) and not shows(middle[:, 2 * third :], road)


def test_an_overlay_is_white_with_the_right_pose_and_coloured_with_a_wrong_one():
    match, query = (0.3, -0.2, 0.5), (1.4, 0.8, 2.5)
    images = [seen_from(place(0), pose) for pose in (query, match)]
    right = figures.overlaid(*images, transform(*relative(match, query)))
    wrong = figures.overlaid(*images, transform(*relative(query, match)))
    assert right.shape == (64, 64, 3) and right.min() >= 0 and right.max() <= 1 + 1e-9

    def agreement(picture: np.ndarray) -> float:
        return float(np.minimum(picture[..., 0], picture[..., 1]).sum() / picture[..., 0].sum())

    assert agreement(right) > 0.5 > 0.3 > agreement(wrong)
    np.testing.assert_array_equal(right[..., 0], right[..., 2])
