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


@pytest.mark.parametrize("command", POSED, ids=lambda command: command.__name__)
def test_commands_share_the_flags_of_a_recording_and_its_poses(command):
    assert tyro.cli(command, args=POSED[command]).source == PosedRecordingOptions()
    flags = ("--seq", "07", "--pose-source", "kitti", "--format", "nclt", "--sensor-height", "2.5")
    flags += ("--pose-topic", "/odom", "--poses", "p.csv", "--pose-format", "csv", "--times", "t.txt")
    flags += ("--time-unit", "ms")
    found = tyro.cli(command, args=(*POSED[command], *flags)).source
    files = (Path("p.csv"), "csv", Path("t.txt"))
    assert found == PosedRecordingOptions("07", "kitti", "nclt", 2.5, "/odom", *files, time_unit="ms")


@pytest.mark.parametrize("command", UNPOSED, ids=lambda command: command.__name__)
def test_commands_with_poses_of_their_own_or_none_share_the_other_flags(command):
    assert tyro.cli(command, args=UNPOSED[command]).source == RecordingOptions()
    flags = ("--seq", "07", "--pose-source", "kitti", "--format", "nclt", "--sensor-height", "estimate")
    found = tyro.cli(command, args=(*UNPOSED[command], *flags))
    assert found.source == RecordingOptions("07", "kitti", "nclt", "estimate")
    assert getattr(found, "poses", None) == (Path("poses.tum") if "--poses" in UNPOSED[command] else None)


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
