"""Measurements survive interruptions without lost or repeated lines, and give the speed of a run."""

import json

import numpy as np
import pytest

from sglpr_jax.training.metrics_log import MetricsLog, read_metrics, throughput


def write(path, steps, *, start_step=0):
    log = MetricsLog(path, start_step=start_step)
    for step in steps:
        log.append(step, {"loss": step / 10})
    return log


def test_lines_are_read_as_they_were_written(tmp_path):
    path = tmp_path / "metrics.jsonl"
    log = MetricsLog(path)
    log.append(1, {"loss": np.float32(0.5), "score": 1})
    log.append(2, {"loss": float("nan"), "other": np.float32("inf")})
    log.close()
    assert read_metrics(path) == [
        {"step": 1, "loss": 0.5, "score": 1.0},
        {"step": 2, "loss": None, "other": None},
    ]
    assert all(json.loads(line) for line in path.read_text().splitlines())


def test_a_resumed_run_removes_the_lines_of_repeated_steps(tmp_path):
    path = tmp_path / "metrics.jsonl"
    write(path, [1, 2, 3, 4]).close()
    write(path, [3, 4, 5], start_step=2).close()
    assert [line["step"] for line in read_metrics(path)] == [1, 2, 3, 4, 5]


def test_an_incomplete_last_line_is_ignored_and_replaced(tmp_path):
    path = tmp_path / "metrics.jsonl"
    write(path, [1, 2]).close()
    whole = path.read_text()
    path.write_text(whole[:-5])
    assert [line["step"] for line in read_metrics(path)] == [1]
    write(path, [2], start_step=1).close()
    assert path.read_text() == whole


def test_a_full_disk_is_an_error_with_the_file_and_the_incomplete_line_is_removed_later(tmp_path, small_files):
    path = tmp_path / "metrics.jsonl"
    log = write(path, [1, 2])
    whole = path.read_bytes()
    with small_files(len(whole) + 10), pytest.raises(OSError, match=rf"{path}: cannot be written: File too large"):
        log.append(3, {"loss": 0.3})
    log.close()
    assert len(path.read_bytes()) == len(whole) + 10  # a part of the third line
    with small_files(len(whole)):
        write(path, [], start_step=2).close()
    assert path.read_bytes() == whole


@pytest.mark.parametrize(
    "line",
    ['{"step": 2, "lo', "[2]", '{"step": true}', '{"step": 2, "loss": "x"}', '{"step": 0}'],
)
def test_a_damaged_line_is_an_error_with_its_number_and_the_file_is_unchanged(tmp_path, line):
    path = tmp_path / "metrics.jsonl"
    write(path, [1, 2, 3]).close()
    first, _, third = path.read_text().splitlines()
    damaged = f"{first}\n{line}\n{third}\n"
    path.write_text(damaged)
    for read in (read_metrics, MetricsLog):
        with pytest.raises(ValueError, match=rf"{path}, line 2: expected "):
            read(path)
    assert path.read_text() == damaged


def test_throughput_is_the_mean_over_all_lines():
    lines = [
        {"step": 10, "loss": 1.0},
        {"step": 10, "score": 0.5},
        {"step": 20, "steps_per_second": 10.0, "data_wait": 0.5},  # a second, half of it waiting
        {"step": 50, "steps_per_second": 10.0, "data_wait": 0.0},  # three seconds
    ]
    found = throughput(lines)
    assert found is not None
    assert found.steps_per_second == pytest.approx(10)
    assert found.data_wait == pytest.approx(0.125)
    assert throughput(lines[:2]) is None
