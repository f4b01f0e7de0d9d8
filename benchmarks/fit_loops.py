"""Fit the models of loops that ship with the package: how probable a pair is, by what simulated towns showed.

    python benchmarks/fit_loops.py --weights rings

Every town is driven through by a LiDAR of 64 beams; of each scan the nearest three descriptors are verified. Pairs up
to 10 m apart are loops, those beyond 20 m are none.
"""

import dataclasses
from pathlib import Path

import numpy as np
import tyro
from jaxtyping import Bool
from rich.progress import track

import sglpr_jax
from sglpr_jax.files import write_json
from sglpr_jax.loops.candidates import CandidateFinder, labelled
from sglpr_jax.loops.probability import DEFAULTS, OF_IMAGES, Evidence, fit
from sglpr_jax.models.params import Params
from sglpr_jax.sim.recording import simulate_recording
from sglpr_jax.sim.sensor import HDL64E

TOWNS = ("00:11", "08:12", "06:13", "02:14", "05:15", "08:16")
"""Routes and seeds of the towns."""


def main(
    *,
    weights: tuple[str, ...] = ("rings",),
    towns: tuple[str, ...] = TOWNS,
    scans: int = 600,
    azimuth_steps: int = 900,
    out: Path = DEFAULTS,
) -> None:
    """Fit and write the models.

    Args:
        weights: for each of these a model of all evidence; the first one's pairs make that of the images alone too.
        towns: routes and seeds, ROUTE:SEED.
        scans: of each town.
        azimuth_steps: firings of the sensor per turn.
        out: the file to write.
    """
    models = {}
    for name in weights:
        params = sglpr_jax.load(name)
        evidence, is_loop = pairs(params, towns, scans, azimuth_steps)
        about = f"{is_loop.sum()} loops and {(~is_loop).sum()} others of simulated towns {', '.join(towns)}, "
        made_with = about + f"{scans} scans of 64 x {azimuth_steps}; benchmarks/fit_loops.py --weights {name}"
        if not models:
            models[""] = fit(evidence, is_loop, names=OF_IMAGES, made_with=made_with)
        key = CandidateFinder(params).index.weights_hash
        models[key] = fit(evidence, is_loop, made_with=made_with)
        print(f"{name}: {models[key]}")
    write_json(out, {name: model.to_json() for name, model in models.items()})


def pairs(
    params: Params, towns: tuple[str, ...], scans: int, azimuth_steps: int
) -> tuple[Evidence, Bool[np.ndarray, " n"]]:
    """The evidence of all candidates of all towns, and which are loops."""
    sensor = dataclasses.replace(HDL64E, azimuth_steps=azimuth_steps)
    found = []
    for town in towns:
        route, seed = town.split(":")
        drive = simulate_recording(route, scans=scans, sensor=sensor, seed=int(seed))
        finder, candidates = CandidateFinder(params), []
        for i in track(range(len(drive)), description=town):
            candidates += finder.add(drive.record(i, labels=False), time=float(drive.times[i]))
        found.append(labelled(candidates, drive.positions))
    evidence, is_loop = zip(*found, strict=True)
    return Evidence(*(np.concatenate(values) for values in zip(*evidence, strict=True))), np.concatenate(is_loop)


if __name__ == "__main__":
    tyro.cli(main)
