import pytest

from sglpr_jax.data.readers import open_recording, recording_names

from .conftest import assert_one_line_error

THIN = ("--scans", 3, "--azimuth-steps", 40, "--seed", 5)


@pytest.mark.slow
def test_drives_are_written_once_and_other_settings_are_refused(command, tmp_path):
    out = tmp_path / "town"
    first = command("simulate", "--out", out, *THIN, "--seq", "08")
    assert first.status == 0 and "08" in first.out
    assert "simulating 1 recordings of 3 scans, about 0 MB" in first.error
    drive = open_recording(out, "08")
    assert len(drive) == 3 and drive.has_labels and len(drive.points(0)) > 500
    assert "simulating" not in command("simulate", "--out", out, *THIN, "--seq", "08").error
    other = command("simulate", "--out", out, "--scans", 4, "--azimuth-steps", 40, "--seed", 5, "--seq", "08")
    assert_one_line_error(other, "simulation.json", "scans 4", "found 3")


def test_the_training_set_is_one_dataset_with_places_by_two_sensors(command, tmp_path, monkeypatch):
    town = {"seed": 5, "routes": ("08",), "images": True, "azimuth_steps": 40}
    datasets = {"town": town, "town-vlp16": {**town, "sensor": "vlp16"}}
    monkeypatch.setattr("sglpr_jax.sim.training_set.training_set", lambda: datasets)
    written = command("simulate", "--out", tmp_path, "--training-set", "--scans", 3)
    assert written.status == 0 and recording_names(tmp_path) == ("town/08", "town-vlp16/08")
    drives = [open_recording(tmp_path, name) for name in recording_names(tmp_path)]
    assert [drive.name for drive in drives] == ["town/08", "town-vlp16/08"]
    assert drives[0].world == drives[1].world != "" and drives[0].has_labels
    assert drives[0].image(0).any() and (drives[0].image(0) != drives[1].image(0)).any()
    wrong = command("simulate", "--out", tmp_path, "--training-set", "--sensor", "vlp16")
    assert_one_line_error(wrong, "--training-set, expected no other flag than --scans, found --sensor")
