"""Fit the models of loops that ship with the package: how probable it is that two scans show one place.

    python -m benchmarks.quality.repeating_scans --seeds 1 2 --out build/fit
    python -m benchmarks.quality.fit_loops build/fit --weights sglpr circular

Every drive is searched by the loop detector's finder, one candidate a scan. A pair is a loop if its scans are at most
half as far apart as frames of other places (`other_m`, at most 10 m), and none beyond that. All sceneries count alike,
so that the towns do not drown the tunnels, and so do drives without revisits, in the same and in the opposite
direction. The drives of a few sceneries are left out, to judge the model by them.
"""

import functools
from collections import Counter
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context
from pathlib import Path
from typing import NamedTuple

import numpy as np
import tyro
from jaxtyping import Bool, Float

import sglpr_jax
from benchmarks.quality.drives import compared, distances, read
from sglpr_jax.files import write_json
from sglpr_jax.loops.candidates import CandidateFinder
from sglpr_jax.loops.probability import ALL, DEFAULTS, OF_IMAGES, Evidence, fit
from sglpr_jax.models.weights import weights_hash

LEFT_OUT = ("garage", "highway", "rooms_equal", "vineyard", "warehouse", "gardens", "lanes")
"""Sceneries that have no part in the fit."""
LOOP_M = 10.0
PAIRS = 600.0
"""The drives of a scenery with one kind of revisits count as this number of pairs."""


class Pairs(NamedTuple):
    """Candidates of one drive that are known to be loops or not."""

    evidence: Float[np.ndarray, "n k"]
    is_loop: Bool[np.ndarray, " n"]


def main(
    drives: tyro.conf.Positional[Path],
    *,
    weights: tuple[str, ...] = ("sglpr", "circular"),
    left_out: tuple[str, ...] = LEFT_OUT,
    workers: int = 1,
    out: Path = DEFAULTS,
) -> None:
    """Fit and write the models.

    Args:
        drives: folder of `repeating_scans.py`, described by `sglpr`.
        weights: a model of all evidence for each; the first one's pairs make that of the images alone too.
        left_out: sceneries that have no part in the fit.
        workers: number of processes.
        out: the file to write.
    """
    files = [path for path in sorted(drives.glob("*.npz")) if path.stem.split("-")[0] not in left_out]
    models = {}
    for name in weights:
        with ProcessPoolExecutor(workers, mp_context=get_context("spawn")) as pool:
            found = list(pool.map(functools.partial(pairs, weights=name), files))
        evidence = Evidence(*np.concatenate([one.evidence for one in found]).T)
        is_loop = np.concatenate([one.is_loop for one in found])
        kinds = [tuple(path.stem.split("-")[:2]) for path in files]
        counts = Counter[tuple[str, ...]]()
        for kind, one in zip(kinds, found, strict=True):
            counts[kind] += len(one.is_loop)
        shares = np.concatenate(
            [np.full(len(one.is_loop), PAIRS / counts[kind]) for kind, one in zip(kinds, found, strict=True)]
        )
        sceneries = ", ".join(dict.fromkeys(path.stem.split("-")[0] for path in files))
        about = f"{is_loop.sum()} loops and {(~is_loop).sum()} others of {len(files)} simulated drives ({sceneries})"
        made_with = f"{about}; benchmarks/quality/fit_loops.py --weights {name}"
        if not models:
            models[""] = fit(evidence, is_loop, names=OF_IMAGES, weights=shares, made_with=made_with)
        key = weights_hash(sglpr_jax.load(name))
        models[key] = fit(evidence, is_loop, weights=shares, made_with=made_with)
        print(f"{name}: {models[key]}")
    write_json(out, {name: model.to_json() for name, model in models.items()})


def pairs(path: Path, *, weights: str) -> Pairs:
    """The evidence of the candidates of one drive, and which are loops."""
    params = sglpr_jax.load(weights)
    drive = read(path, None if weights == "sglpr" else params)
    frames = compared(drive, CandidateFinder(params), path.parent / "compared")
    candidates = [one for frame in frames for one in frame.candidates]
    apart = distances([(one.query, one.match) for one in candidates], drive.world_from_lidar)
    evidence = np.array([one.evidence for one in candidates], np.float64).reshape(-1, len(ALL))
    loop, other = apart <= min(LOOP_M, drive.other_m / 2), apart > drive.other_m
    return Pairs(evidence[loop | other], loop[loop | other])


if __name__ == "__main__":
    tyro.cli(main)
