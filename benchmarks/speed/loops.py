"""Memory of the loop detector on a long drive, and time of a keyframe."""

import dataclasses
import gc
import sys
import time
from collections.abc import Callable, Sequence
from types import FunctionType, ModuleType

import numpy as np

import sglpr_jax
from benchmarks.table import Table
from sglpr_jax.loops.comparison import NO_FITS
from sglpr_jax.loops.config import DetectorConfig
from sglpr_jax.loops.detector import LoopDetector
from sglpr_jax.registration.bev_alignment import BevRegistration
from sglpr_jax.sim.recording import simulate_recording
from sglpr_jax.sim.sensor import HDL64E

STEP_S, STEP_M, LAP = 0.1, 1.0, 2000
"""Time and distance between two frames, and frames of a lap."""
SCANS = 20
"""Number of different simulated scans."""


def loops(
    *,
    frames: Sequence[int] = (1000, 4541, 20_000),
    repeats: int = 20,
    azimuth_steps: int = 900,
    weights: str = "sglpr",
) -> None:
    """Print bytes a frame, and processor milliseconds of a further keyframe, after some numbers of frames.

    Every scan is a keyframe here; on a road, one of two or three scans is. The vehicle drives the same circle again and
    again. Descriptors are random, images are those of a few simulated scans, and no images are compared but for the
    timed scans. One core: under `taskset -c 0`.

    Args:
        frames: numbers of frames at which memory and time are measured.
        repeats: scans that are timed.
        azimuth_steps: firings of the simulated sensor per turn.
        weights: the model that describes the timed scans.
    """
    detector = LoopDetector(sglpr_jax.load(weights), config=DetectorConfig(keyframe_m=0.0))
    rng = np.random.default_rng(0)
    finder, sensor = detector.finder, dataclasses.replace(HDL64E, azimuth_steps=azimuth_steps)
    drive = simulate_recording("08", scans=60, sensor=sensor, seed=101)
    scans = [drive.scan(i, labels=False) for i in range(SCANS)]
    keyframes = [finder.keyframe(scan) for scan in scans]
    table = Table("frames", "MB", "bytes a frame", "ms to describe a keyframe", "ms a keyframe")
    before = held_bytes(detector)
    for end in frames:
        while len(detector) < end:
            frame = len(detector)
            drawn = rng.normal(size=finder.index.width).astype(np.float32)
            keyframe = keyframes[frame % SCANS]._replace(descriptor=drawn / np.linalg.norm(drawn))
            keyframe = keyframe._replace(image=keyframe.image.copy())
            spread = np.diag([0.1, 0.1, 0.0]) ** 2
            motion = map(np.asarray, (STEP_M, 0.0, 2 * np.pi / LAP, spread, 0.9, 0.3))
            link = BevRegistration(*motion) if frame else None
            detector.add_keyframe(keyframe, time=STEP_S * frame, fits=NO_FITS._replace(link=link))
        held = held_bytes(detector) - before
        describing = _mean_s(lambda scan: finder.keyframe(scan), scans, repeats)
        adding = _mean_s(lambda scan: detector.add(scan, time=STEP_S * len(detector)), scans, repeats)
        milliseconds = (f"{1e3 * one:.1f}" for one in (describing, adding))
        table.add(f"{end:,}", f"{held / 1e6:.0f}", f"{held / end:,.0f}", *milliseconds)


def _mean_s(job: Callable[[sglpr_jax.Scan], object], scans: list[sglpr_jax.Scan], repeats: int) -> float:
    """Mean processor seconds of a job. The first runs, which compile, do not count."""
    for i in range(2 * repeats):
        if i == repeats:
            start = time.process_time()
        job(scans[i % SCANS])
    return (time.process_time() - start) / repeats


def held_bytes(root: object) -> int:
    """Bytes of an object and of all objects that it refers to, without functions, modules and classes."""
    known_ids, queue, total = {id(root)}, [root], 0
    while queue:
        current = queue.pop()
        total += sys.getsizeof(current)
        referents = [current.base] if isinstance(current, np.ndarray) else gc.get_referents(current)
        for referent in referents:
            if id(referent) not in known_ids and not isinstance(referent, type | ModuleType | FunctionType):
                known_ids.add(id(referent))
                queue.append(referent)
    return total
