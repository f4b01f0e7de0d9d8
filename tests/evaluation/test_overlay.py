"""The moved query covers the match where the pose is right, and not where it is wrong."""

import numpy as np
from scenes import place, relative, seen_from

from sglpr_jax.evaluation.loop_figures import overlaid
from sglpr_jax.se3 import transform


def test_a_right_pose_makes_the_picture_white_and_a_wrong_one_coloured():
    match, query = (0.3, -0.2, 0.5), (1.4, 0.8, 2.5)
    images = [seen_from(place(0), pose) for pose in (query, match)]
    right = overlaid(*images, transform(*relative(match, query)))
    wrong = overlaid(*images, transform(*relative(query, match)))
    assert right.shape == (64, 64, 3) and right.min() >= 0 and right.max() <= 1 + 1e-9

    def agreement(picture: np.ndarray) -> float:
        return float(np.minimum(picture[..., 0], picture[..., 1]).sum() / picture[..., 0].sum())

    assert agreement(right) > 0.5 > 0.3 > agreement(wrong)
    np.testing.assert_array_equal(right[..., 1], right[..., 2])


def test_without_a_motion_the_query_stays_and_an_empty_one_is_black():
    image = seen_from(place(1), (0.0, 0.0, 0.0))
    same = overlaid(image, image, np.eye(4))
    np.testing.assert_allclose(same[..., 0], same[..., 1], atol=1e-6)
    assert overlaid(np.zeros_like(image), image, np.eye(4))[..., 1].max() == 0
