"""Callbacks: several as one, the progress on stderr, and event files."""

import inspect
import struct
import sys
from pathlib import Path

import pytest
from tensorboardX.proto.event_pb2 import Event, SessionLog

from sglpr_jax.training.callbacks import Callback, Callbacks, EventFiles, ProgressBar

TOLD = {name: method for name, method in vars(Callback).items() if not name.startswith("_")}


def test_all_callbacks_are_called_in_their_order():
    told = []

    class Noting(Callback):
        def __init__(self, own: str):
            self._own = own

        def __getattribute__(self, name):
            if name not in TOLD:
                return super().__getattribute__(name)
            return lambda *values: told.append((self._own, name, values))

    both = Callbacks(Noting("first"), Noting("second"))
    for name, method in TOLD.items():
        wanted = list(inspect.signature(method).parameters)[1:]
        values = tuple({"recording": "00", "values": {"loss": 0.5}, "scores": {}}.get(each, 3) for each in wanted)
        getattr(both, name)(*values)
        assert told[-2:] == [("first", name, values), ("second", name, values)]
    assert len(told) == 2 * len(TOLD) > 10


@pytest.fixture
def terminal(monkeypatch):
    """Stderr counts as a terminal, so that there is a bar."""
    monkeypatch.setenv("FORCE_COLOR", "1")


@pytest.mark.usefixtures("terminal")
def test_a_progress_bar_can_be_used_for_a_second_training(capsys):
    bar = ProgressBar()
    for steps in (4, 7):
        bar.on_start(0, steps)
        bar.on_step(3, {"loss": 0.5})
        bar.close()
        assert f"3/{steps}" in capsys.readouterr().err


def test_without_a_terminal_each_call_prints_a_line(capsys):
    bar = ProgressBar()
    bar.on_start(0, 4)
    assert capsys.readouterr().err == "step 0 of 4: compiling the first step\n"
    for step in (2, 4):
        bar.on_step(step, {"loss": 0.5, "steps_per_second": 3.0})
        assert capsys.readouterr().err == f"step {step} of 4: loss 0.5  steps_per_second 3\n"
    bar.close()


def read_events(path: Path) -> list[Event]:
    """The events of a file of TFRecords: length, checksum, bytes, checksum."""
    content, events = path.read_bytes(), []
    while content:
        (length,) = struct.unpack("<Q", content[:8])
        events.append(Event.FromString(content[12 : 12 + length]))
        content = content[16 + length :]
    return events


def test_event_files_contain_the_measurements(tmp_path):
    events = EventFiles(tmp_path / "run" / "tensorboard")
    events.on_step(3, {"loss": 0.25, "triplet": 0.5})
    (path,) = (tmp_path / "run" / "tensorboard").iterdir()
    version, start, measured = read_events(path)  # already there
    events.on_score(6, {"score": 1.0})
    events.close()
    assert version.file_version == "brain.Event:2"
    assert (start.step, start.session_log.status) == (3, SessionLog.START)
    assert measured.step == 3 and measured.wall_time > 1e9
    assert {value.tag: value.simple_value for value in measured.summary.value} == {"loss": 0.25, "triplet": 0.5}
    assert [event.step for event in read_events(path)] == [0, 3, 3, 6]


def test_without_the_extra_the_error_says_how_to_install_it(tmp_path, monkeypatch):
    for name in [name for name in sys.modules if name.startswith("tensorboardX")]:
        monkeypatch.delitem(sys.modules, name)
    monkeypatch.setitem(sys.modules, "tensorboardX", None)
    with pytest.raises(ImportError, match=r"-m pip install .*tensorboard"):
        EventFiles(tmp_path / "tensorboard")
