"""One set of flags opens a recording, whatever the command."""

from pathlib import Path

import pytest
import tyro

from sglpr_jax.cli.embed import EmbedCommand
from sglpr_jax.cli.evaluate import EvaluateCommand
from sglpr_jax.cli.loops import LoopsCommand
from sglpr_jax.cli.map import MapCommand
from sglpr_jax.cli.recording import PosedRecordingOptions, RecordingOptions
from sglpr_jax.cli.segment import SegmentCommand

POSED = {
    EmbedCommand: ("--data", "scans", "--out", "a.npz"),
    LoopsCommand: ("scans", "--out", "a"),
}
UNPOSED = {
    MapCommand: ("scans", "--out", "a.safetensors", "--poses", "poses.tum"),
    EvaluateCommand: ("08.npz", "--poses", "poses.tum"),
    SegmentCommand: ("--data", "scans", "--out", "a"),
}


FLAGS = ("--seq", "07", "--pose-source", "kitti", "--format", "nclt", "--sensor-height", "2.5")


@pytest.mark.parametrize("command", [*POSED, *UNPOSED], ids=lambda command: command.__name__)
def test_commands_share_the_flags_of_a_recording(command):
    options = PosedRecordingOptions if command in POSED else RecordingOptions
    given = (POSED | UNPOSED)[command]
    assert tyro.cli(command, args=given).source == options()
    assert tyro.cli(command, args=(*given, *FLAGS)).source == options("07", "kitti", "nclt", 2.5)


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
