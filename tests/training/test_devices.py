"""Several devices and hosts share a step. Tests on eight devices run in a separate process."""

import os
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace

import pytest

from sglpr_jax.training import devices
from sglpr_jax.training.devices import data_mesh, on_all_hosts


@pytest.mark.slow
def test_eight_devices():
    flags = {"JAX_PLATFORMS": "cpu", "XLA_FLAGS": f"{os.environ['XLA_FLAGS']} --xla_force_host_platform_device_count=8"}
    tests = Path(__file__).with_name("eight_devices.py")
    command = [sys.executable, "-m", "pytest", "-q", "-p", "no:cacheprovider", str(tests)]
    ended = subprocess.run(command, env=os.environ | flags, capture_output=True, text=True)
    assert ended.returncode == 0, ended.stdout + ended.stderr
    assert "2 passed" in ended.stdout


def test_hosts_that_do_not_divide_a_step_are_refused(config):
    hosts = [SimpleNamespace(process_index=i) for i in range(3)]
    with pytest.raises(ValueError, match=r"2 tuples of a step and the 8 images of a chunk .* found 3 hosts"):
        data_mesh(config, hosts)


def test_an_error_of_another_host_ends_this_one(monkeypatch):
    monkeypatch.setattr(devices, "any_host", lambda failed: True)
    with pytest.raises(ConnectionError, match="another host ended with an error"):
        on_all_hosts(lambda: 1)
