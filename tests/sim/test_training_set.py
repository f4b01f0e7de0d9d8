"""The training set: options that the simulator accepts, and towns that several sensors see."""

import collections

from sglpr_jax.data.readers.simulation import simulated_world
from sglpr_jax.sim.dataset import Simulated, simulate
from sglpr_jax.sim.training_set import SEEDS, training_set


class Checked(Exception):
    """The simulator has checked the options of a dataset, and would now write its scans."""


def test_the_simulator_accepts_every_dataset_and_two_routes_of_each_seed_are_seen_three_times(tmp_path):
    def stop(dataset: Simulated) -> None:
        raise Checked

    worlds = collections.Counter()
    for name, options in training_set().items():
        try:
            simulate(tmp_path / name, scans=2, on_start=stop, **options)
        except Checked:
            worlds.update(simulated_world(tmp_path / name, route) for route in options["routes"])
    assert sum(worlds.values()) == sum(len(options["routes"]) for options in training_set().values())
    seeds, both_directions = sum(map(len, SEEDS.values())), 2
    assert sum(times == 3 for times in worlds.values()) == both_directions * seeds
