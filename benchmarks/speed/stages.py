"""Time of the loop search by stage, with and without odometry, for raw scans or ready-made images."""

import tempfile
import time
from collections import Counter
from collections.abc import Callable
from contextlib import ExitStack
from pathlib import Path
from typing import Any
from unittest import mock

import jax
import numpy as np
from jaxtyping import Float

import sglpr_jax
from benchmarks.drives import odometry_of, on_disk, ready_made
from benchmarks.table import Table
from sglpr_jax.data.recording import Recording
from sglpr_jax.loops.candidates import CandidateSearch
from sglpr_jax.loops.comparison import KeyframeComparison
from sglpr_jax.loops.detector import LoopDetector
from sglpr_jax.sim.recording import simulate_recording
from sglpr_jax.sim.sensor import SENSORS

STAGES = {
    "image and descriptor": (CandidateSearch, "keyframe"),
    "motion": (CandidateSearch, "_add_motion"),
    "coarse comparison": (KeyframeComparison, "_most_similar"),
    "exact comparison": (KeyframeComparison, "_compare_exactly"),
    "candidates": (KeyframeComparison, "candidates"),
    "rest": (LoopDetector, "add"),
}
"""Method of each stage. The time of a method called by another one counts for the former only."""
WARM_UP = 200
"""Scans of a first search, which does not count."""


class Stopwatch:
    """Processor seconds of methods, without those of the timed methods that they call."""

    def __init__(self) -> None:
        self.seconds = Counter[str]()
        self._inner_s = [0.0]
        """Seconds of timed methods within each open call."""

    def timed(self, stage: str, method: Callable[..., Any]) -> Callable[..., Any]:
        """The method, whose seconds count for a stage."""

        def run(*arguments: Any, **options: Any) -> Any:
            start = time.process_time()
            self._inner_s.append(0.0)
            result = jax.block_until_ready(method(*arguments, **options))
            spent_s = time.process_time() - start
            self.seconds[stage] += spent_s - self._inner_s.pop()
            self._inner_s[-1] += spent_s
            return result

        return run


def stages(
    *,
    data: Path | None = None,
    seqs: tuple[str, ...] = ("06",),
    scans: int = 700,
    rates: tuple[float, ...] = (10.0, 20.0),
    weights: str = "sglpr",
    seed: int = 3,
) -> None:
    """Print processor milliseconds of a scan by stage, with keyframes and loops. One core: under `taskset -c 0`.

    Without `data`, the scans are those of a simulated drive with 64 beams. At twice the rate it has twice the scans.
    Reading is not timed.

    Args:
        data: folder of ready-made images in the layout NN/imgs/*.png with NN/pose.txt.
        seqs: sequences of `data`, or routes of the simulator.
        scans: scans of the simulated drive at the first rate.
        rates: scans a second of the simulated drive.
        weights: model that describes the scans.
        seed: seed of the simulated drive and of the drift of the odometry.
    """
    params = sglpr_jax.load(weights)
    table = Table("drive", "odometry", "scans", "keyframes", "loops", *(f"{stage}, ms" for stage in STAGES), "all, ms")
    for name in seqs:
        for rate in (0.0,) if data is not None else rates:
            with tempfile.TemporaryDirectory() as folder:
                if data is not None:
                    recording, poses = ready_made(data, name)
                else:
                    count, sensor = round(scans * rate / rates[0]), SENSORS["hdl64e"]
                    drive = simulate_recording(name, scans=count, sensor=sensor, seed=seed, rate_hz=rate)
                    recording, poses = on_disk(drive, Path(folder) / "scans"), drive.poses.world_from_lidar
                for odometry in ("none", "drifting"):
                    given = odometry_of(odometry, poses, seed=seed)
                    _search(recording, given, params, Stopwatch(), WARM_UP)
                    watch = Stopwatch()
                    detector = _search(recording, given, params, watch, len(recording))
                    counts = (len(recording), len(detector.finder), len(detector.loops))
                    milliseconds = [1e3 * watch.seconds[stage] / len(recording) for stage in STAGES]
                    cells = (f"{value:.2f}" for value in (*milliseconds, sum(milliseconds)))
                    table.add(f"{name}, {rate:g} Hz" if rate else name, odometry, *map(str, counts), *cells)


def _search(
    recording: Recording,
    odometry: Float[np.ndarray, "n 4 4"] | None,
    params: sglpr_jax.Params,
    watch: Stopwatch,
    scans: int,
) -> LoopDetector:
    """Searches the first scans of a recording, timed."""
    with ExitStack() as timed:
        for stage, (owner, name) in STAGES.items():
            timed.enter_context(mock.patch.object(owner, name, watch.timed(stage, getattr(owner, name))))
        detector = LoopDetector(params)
        for i in range(min(scans, len(recording))):
            time_s = None if recording.times is None else float(recording.times[i])
            detector.add(recording.scan(i), time=time_s, odometry=None if odometry is None else odometry[i])
    return detector
