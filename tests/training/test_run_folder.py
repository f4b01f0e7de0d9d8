"""The folder of a run records settings, environment and command of each start."""

import json
import subprocess
import sys

import jax
import numpy as np

from sglpr_jax.training.run_folder import git_commit, note_environment


def git(folder, *arguments):
    identity = ("-c", "user.name=tester", "-c", "user.email=tester@example.com")
    return subprocess.run(["git", *identity, *arguments], cwd=folder, check=True, capture_output=True, text=True).stdout


def test_environment_and_command_line_are_noted_at_each_start(tmp_path, monkeypatch):
    monkeypatch.setenv("XLA_FLAGS", "--xla_cpu_enable_fast_math=false")
    for arguments in (["train", "--out", "a folder"], ["train", "--resume"], ["train", "--resume", "--steps", "9"]):
        monkeypatch.setattr(sys, "argv", arguments)
        note_environment(tmp_path, seed=3)
    noted = json.loads((tmp_path / "environment.json").read_text())
    assert noted["command"] == "train --out 'a folder'" and noted["seed"] == 3
    assert noted["packages"].keys() == {"sglpr-jax", "jax", "jaxlib", "flax", "optax", "numpy"}
    assert (noted["packages"]["jax"], noted["packages"]["numpy"]) == (jax.__version__, np.__version__)
    assert noted["python"] == ".".join(map(str, sys.version_info[:3]))
    assert noted["backend"] == jax.default_backend() and len(noted["devices"]) == jax.device_count()
    assert noted["variables"]["XLA_FLAGS"] == "--xla_cpu_enable_fast_math=false"
    assert [start["command"] for start in noted["resumes"]] == ["train --resume", "train --resume --steps 9"]
    assert all(start["packages"] == noted["packages"] for start in noted["resumes"])


def test_git_commit_returns_the_commit_and_whether_files_differ(tmp_path):
    assert git_commit(tmp_path) is None
    git(tmp_path, "init")
    assert git_commit(tmp_path) is None  # no commit yet
    (tmp_path / "file").write_text("a")
    git(tmp_path, "add", "file")
    git(tmp_path, "commit", "-m", "first")
    commit = git(tmp_path, "rev-parse", "HEAD").strip()
    assert git_commit(tmp_path) == {"commit": commit, "dirty": False}
    (tmp_path / "file").write_text("b")
    assert git_commit(tmp_path) == {"commit": commit, "dirty": True}
