"""Two processes on one computer, with the real command line, train the run of a single process."""

import os
import socket
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import safetensors.numpy

from sglpr_jax.training.metrics_log import read_metrics

from .conftest import Ended

TIMES = {"steps_per_second", "data_wait"}
SECONDS = 300


def free_port() -> int:
    with socket.socket() as asked:
        asked.bind(("127.0.0.1", 0))
        return asked.getsockname()[1]


def on_two_hosts(*arguments: object) -> list[Ended]:
    """Run `bin/train` in two processes with one device each, and wait for both."""
    command = [sys.executable, "-m", "sglpr_jax.cli", "train", *map(str, arguments), "--hosts", "2"]
    command += ["--coordinator", f"127.0.0.1:{free_port()}", "--host-index"]
    flags = f"{os.environ['XLA_FLAGS']} --xla_force_host_platform_device_count=1"
    environment = os.environ | {"JAX_PLATFORMS": "cpu", "XLA_FLAGS": flags}
    pipes = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE, "text": True}
    hosts = [subprocess.Popen([*command, str(i)], env=environment, **pipes) for i in range(2)]
    try:
        printed = [host.communicate(timeout=SECONDS) for host in hosts]
    finally:
        for host in hosts:
            host.kill()
    return [Ended(host.returncode, *texts) for host, texts in zip(hosts, printed, strict=True)]


def logged(folder: Path) -> list[dict]:
    return [{k: v for k, v in line.items() if k not in TIMES} for line in read_metrics(folder / "metrics.jsonl")]


def written(folder: Path) -> set[str]:
    """What a run left, but for the insides of its checkpoints."""
    return {str(path.relative_to(folder)) for depth in ("*", "[!c]*/*", "checkpoints/*") for path in folder.glob(depth)}


@pytest.mark.slow
def test_two_hosts_make_the_run_of_one(trained, town, preset, tmp_path):
    out = tmp_path / "run"
    first, second = on_two_hosts("--seq", "08", "--data", town, "--preset", preset, "--out", out)
    assert (first.status, second.status) == (0, 0), first.error + second.error
    assert written(out) == written(trained.folder)
    assert (out / "config.json").read_bytes() == (trained.folder / "config.json").read_bytes()
    assert "top-1 F1max" in first.out and "top-1 F1max" not in second.out
    found, expected = logged(out), logged(trained.folder)
    assert [line.keys() for line in found] == [line.keys() for line in expected]
    for one, other in zip(found, expected, strict=True):
        np.testing.assert_allclose(list(one.values()), list(other.values()), rtol=1e-4)
    weights, of_one = (
        safetensors.numpy.load_file(folder / "weights" / "model.safetensors") for folder in (out, trained.folder)
    )
    assert weights.keys() == of_one.keys()
    for name in of_one:
        if not name.endswith("qkv/bias"):  # nothing feels the keys' bias: its steps are rounding
            np.testing.assert_allclose(
                weights[name], of_one[name], rtol=0, atol=5e-5
            )  # sums of floats in another order
