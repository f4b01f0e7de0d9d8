"""Submaps of the PointNetVLAD benchmark are no scans in metres: wherever they are opened, they are refused."""

import numpy as np
import pytest

from sglpr_jax.data.readers import open_recording, recording_names

OXFORD = ("pointcloud_20m_10overlap", "pointcloud_locations_20m_10overlap.csv")
DISTRICT = ("pointcloud_25m_25", "pointcloud_centroids_25.csv")


@pytest.mark.parametrize(("folder", "table"), [OXFORD, DISTRICT])
def test_submaps_are_refused_with_the_reason(tmp_path, folder, table):
    run = tmp_path / "oxford" / "2014-05-19-13-20-57"
    (run / folder).mkdir(parents=True)
    submap = np.random.default_rng(0).uniform(-1, 1, (4096, 3))
    submap.tofile(run / folder / "1400505794141322.bin")
    (run / table).write_text("timestamp,northing,easting\n1400505794141322,5735712.8,620084.4\n")
    for root in (run / folder, run, run.parent, tmp_path):
        assert recording_names(root) == (run.name,)
        with pytest.raises(ValueError, match=r"expected scans in metres, found submaps .* by an unknown factor"):
            open_recording(root)


def test_the_error_about_unknown_layouts_does_not_offer_them(tmp_path):
    with pytest.raises(FileNotFoundError) as error:
        recording_names(tmp_path)
    assert "pointcloud" not in str(error.value) and ", ," not in str(error.value)


def test_scaled_clouds_of_a_plain_folder_are_refused_too(tmp_path):
    np.random.default_rng(0).uniform(-1, 1, (4096, 3)).tofile(tmp_path / "a.bin")
    with pytest.raises(ValueError, match=r"all points within 1 m, as in scaled clouds"):
        open_recording(tmp_path)
