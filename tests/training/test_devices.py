"""One device runs the program that it ran before there was a mesh; what several do, a process of its own shows."""

import os
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace

import jax
import pytest

from sglpr_jax.training.devices import data_mesh
from sglpr_jax.training.image_network import ImageNetwork
from sglpr_jax.training.step import train_step


@pytest.mark.slow
def test_eight_devices():
    flags = {"JAX_PLATFORMS": "cpu", "XLA_FLAGS": f"{os.environ['XLA_FLAGS']} --xla_force_host_platform_device_count=8"}
    tests = Path(__file__).with_name("eight_devices.py")
    command = [sys.executable, "-m", "pytest", "-q", "-p", "no:cacheprovider", str(tests)]
    ended = subprocess.run(command, env=os.environ | flags, capture_output=True, text=True)
    assert ended.returncode == 0, ended.stdout + ended.stderr
    assert "4 passed" in ended.stdout


def test_on_one_device_nothing_is_added_to_the_step(config, params, make_batch):
    network = ImageNetwork(config)
    with jax.set_mesh(data_mesh(config, jax.devices()[:1])):
        traced = str(train_step.trace(network.new_state(params), make_batch(0), network=network).jaxpr)
    assert "dot_general" in traced
    assert "sharding_constraint" not in traced and "shard_map" not in traced


def test_hosts_that_do_not_divide_a_step_are_refused(config):
    hosts = [SimpleNamespace(process_index=i) for i in range(3)]
    with pytest.raises(ValueError, match=r"2 tuples of a step and the 8 images of a chunk .* found 3 hosts"):
        data_mesh(config, hosts)
