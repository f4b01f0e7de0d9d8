"""Event files hold what was measured, and a resumed run hides the steps it makes again."""

import struct
import sys
from pathlib import Path

import pytest
from tensorboardX.proto.event_pb2 import Event, SessionLog

from sglpr_jax.training.tensorboard import EventFiles


def read_events(path: Path) -> list[Event]:
    """The events of a file of TFRecords: length, checksum, bytes, checksum."""
    content, events = path.read_bytes(), []
    while content:
        (length,) = struct.unpack("<Q", content[:8])
        events.append(Event.FromString(content[12 : 12 + length]))
        content = content[16 + length :]
    return events


def test_events_are_what_was_measured(tmp_path):
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


def test_a_run_that_measured_nothing_leaves_nothing(tmp_path):
    EventFiles(tmp_path / "tensorboard").close()
    assert list(tmp_path.iterdir()) == []


def test_without_the_extra_the_error_says_how_to_install_it(tmp_path, monkeypatch):
    for name in [name for name in sys.modules if name.startswith("tensorboardX")]:
        monkeypatch.delitem(sys.modules, name)
    monkeypatch.setitem(sys.modules, "tensorboardX", None)
    with pytest.raises(ImportError, match=r"pip install 'sglpr-jax\[tensorboard\]'"):
        EventFiles(tmp_path / "tensorboard")
