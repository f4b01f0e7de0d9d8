"""Goldens: what differs between two runs of the commands is found, durations are not."""

import importlib

import numpy as np


def test_files_that_differ_are_named_and_durations_do_not_count(tmp_path):
    goldens = importlib.import_module("benchmarks.goldens")
    before, after = tmp_path / "before", tmp_path / "after"
    for folder, x, seconds in ((before, 1.0, 3.2), (after, 1.0 + 1e-8, 4.5)):
        (folder / "checkpoints").mkdir(parents=True)
        (folder / "checkpoints" / "state").write_text(f"{seconds}")
        (folder / "poses.tum").write_text(f"0 {x:.9f} 0 0")
        (folder / "loss.jsonl").write_text(f'{{"loss": 2.5, "steps_per_second": {seconds}}}')
        np.savez(folder / "found.npz", x=np.array([x]), ids=np.array(["a"]))
    assert goldens.differences(before, after, within=0.0) == ["found.npz: differs", "poses.tum: differs"]
    assert goldens.differences(before, after, within=1e-6) == []
    (after / "poses.tum").write_text("0 1 0 0 0")
    (after / "more.txt").write_text("")
    assert goldens.differences(before, after, within=1e-6) == ["more.txt: in one folder only", "poses.tum: differs"]
