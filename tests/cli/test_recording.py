from pathlib import Path

import pytest

from sglpr_jax.cli.recording import PosedRecordingOptions, RecordingOptions


def test_the_recording_is_opened_as_they_say_and_described(town, capsys):
    recording = RecordingOptions("08", sensor_height=2.0).open(town)
    assert recording.name == "08" and recording.mounting.height_m == 2
    assert "sensor: 2.00 m above the ground, as given" in capsys.readouterr().err
    with pytest.raises(ValueError, match=r"p\.csv: expected poses or times for a plain folder"):
        PosedRecordingOptions("08", poses=Path("p.csv")).open(town)
    with pytest.raises(ValueError, match="expected a bag with the pose topic /odom, found sequences/NN"):
        RecordingOptions("08", pose_topic="/odom").open(town)
    with pytest.raises(ValueError, match="expected a bag with the IMU topic /imu, found sequences/NN"):
        RecordingOptions("08", imu_topic="/imu").open(town)
