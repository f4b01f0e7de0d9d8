"""Drives where places repeat: rendered, read, compared and searched.

Each drive is a file SCENERY-REVISIT-SENSOR-SEED.npz with these arrays, n scans each:

    descriptors (n, 256) float32, images (n, h, w) uint8, world_from_lidar (n, 4, 4), times (n,)
    scenery, sensor, revisit: names; seed
    scale: factor for lengths of the images; poses are in real metres

Comparisons of scans take most of the time of a search. They are kept beside the drives, in `compared/`, for the same
settings of the finder; delete the folder after a change of its code.
"""

import dataclasses
import hashlib
import itertools
import json
import time
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
import tyro
from jaxtyping import Bool, Float
from rich.console import Console
from rich.table import Table

import sglpr_jax
from benchmarks.drives import Case, Odometry, odometry_of, revisited
from benchmarks.quality.scoring import REPEATING_M, STOREY_M, WAY_M, pose_errors
from sglpr_jax.data.choices import Scale
from sglpr_jax.data.scaled import scaled, scaled_poses
from sglpr_jax.files import replacing
from sglpr_jax.frame_log import FrameLog
from sglpr_jax.loops.acceptance import accept_loops
from sglpr_jax.loops.candidates import CandidateSearch
from sglpr_jax.loops.checkpoint import frame_bytes, read_frame
from sglpr_jax.loops.comparison import Fits
from sglpr_jax.loops.config import MIN_CELLS
from sglpr_jax.loops.detector import LoopDetector
from sglpr_jax.loops.keyframes import Keyframe
from sglpr_jax.models.params import Params
from sglpr_jax.odometry.config import MOTION_DRIFT
from sglpr_jax.se3 import travelled
from sglpr_jax.sim.routes import REVISITS, Revisit
from sglpr_jax.sim.sceneries import REPEATING
from sglpr_jax.sim.styles import SCENERIES

CARS, WALKERS = ("hdl64e", "vlp16"), ("os0-32+backpack", "os0-32-140+handheld")
OF_SCENERY: dict[str, tuple[str, ...]] = {
    **dict.fromkeys(("hall", "yard"), WALKERS),
    **dict.fromkeys(("campus", "warehouse"), (*CARS, "os0-32+cart")),
    "forest": (*CARS, "os0-32+backpack"),
    "storeys": ("hdl32e", "vlp16"),
}
"""Sensors of a scenery, if they are not `CARS`."""


def render(
    *,
    sceneries: tuple[str, ...] = (*REPEATING, *SCENERIES),
    seeds: tuple[int, ...] = (1,),
    sensors: tuple[str, ...] = (),
    revisits: tuple[Revisit, ...] = REVISITS,
    scans: int = 300,
    azimuth_steps: int = 900,
    scale: Scale = 1,
    weights: str = "sglpr",
    out: Path = Path("build/repeating"),
) -> None:
    """Render drives, and store what the loop detector keeps of each scan. Files that exist are skipped.

    Args:
        sceneries: names of sceneries that repeat, and of towns.
        seeds: one drive for each.
        sensors: names in `drives.LIDARS`, with +CARRIER if it is not a vehicle. By default those of the scenery.
        revisits: whether and how the vehicle returns.
        scans: number of scans of each drive.
        azimuth_steps: firings of the sensor per turn.
        scale: factor for all lengths before a scan is described; another scale needs another folder.
        weights: the model that describes the scans.
        out: the folder.
    """
    drives = [
        Case(scenery, revisit, seed, sensor)
        for seed, revisit, scenery in itertools.product(seeds, revisits, sceneries)
        for sensor in sensors or OF_SCENERY.get(scenery, CARS)
    ]
    drives = [drive for drive in drives if not (out / _name(drive)).exists()]
    params = sglpr_jax.load(weights)
    for number, drive in enumerate(drives, 1):
        line = _render(drive, params, scans=scans, azimuth_steps=azimuth_steps, scale=scale, out=out)
        print(f"{number}/{len(drives)} {line}", flush=True)


def _name(case: Case) -> str:
    return f"{case.world}-{case.route}-{case.sensor}-{case.seed}.npz"


def _render(case: Case, params: Params, *, scans: int, azimuth_steps: int, scale: Scale, out: Path) -> str:
    """Render a drive, write its file, and return a line about it."""
    begin = time.perf_counter()
    simulated = case.simulate(scans=scans, azimuth_steps=azimuth_steps)
    recording, finder = scaled(simulated, scale), CandidateSearch(params)
    keyframe = [finder.keyframe(recording.scan(i, labels=False)) for i in range(len(recording))]
    with replacing(out / _name(case)) as temporary, temporary.open("wb") as file:
        np.savez_compressed(
            file,
            descriptors=np.stack([one.descriptor for one in keyframe]),
            images=np.stack([one.image for one in keyframe]),
            world_from_lidar=simulated.poses.world_from_lidar,
            times=simulated.poses.times,
            scale=np.array(scale),
            scenery=case.world,
            revisit=case.route,
            sensor=case.sensor,
            seed=case.seed,
        )
    seconds, empty = time.perf_counter() - begin, np.mean([np.count_nonzero(one.image) < MIN_CELLS for one in keyframe])
    return f"{_name(case)}: {len(keyframe)} scans in {seconds:.1f} s, {empty:.0%} nearly empty"


class RenderedDrive(NamedTuple):
    """A drive as its file holds it."""

    keyframe: Sequence[Keyframe]
    world_from_lidar: Float[np.ndarray, "n 4 4"]
    times: Float[np.ndarray, " n"]
    about: dict[str, str]
    """Scenery, revisit, sensor and seed."""
    scale: int = 1
    """Factor that all lengths, also those of the poses, were multiplied by."""

    def odometry(self, kind: Odometry) -> Float[np.ndarray, "n 4 4"] | None:
        """The true poses, the same with drift, or None."""
        real = odometry_of(kind, scaled_poses(self.world_from_lidar, 1 / self.scale), seed=int(self.about["seed"]))
        return None if real is None else scaled_poses(real, self.scale)

    @property
    def revisits(self) -> Bool[np.ndarray, " n"]:
        """Which scans come within 3 m of one from which at least 30 m were travelled."""
        poses, scale = self.world_from_lidar, self.scale
        return revisited(poses[:, :3, 3], travelled(poses), near_m=REPEATING_M * scale, apart=WAY_M * scale)


def read(path: Path) -> RenderedDrive:
    """Read a drive."""
    with np.load(path) as file:
        scale = int(file["scale"]) if "scale" in file else 1
        about = {name: str(file[name]) for name in ("scenery", "revisit", "sensor", "seed")}
        keyframe = [Keyframe(*each, None) for each in zip(file["descriptors"], file["images"], strict=True)]
        return RenderedDrive(keyframe, scaled_poses(file["world_from_lidar"], scale), file["times"], about, scale)


def chosen(folder: Path, sceneries: Sequence[str], sensors: Sequence[str]) -> Iterator[Path]:
    """Files of some sceneries and sensors; of all, if none is named."""
    for path in sorted(folder.glob("*.npz")):
        scenery, _, rest = path.stem.split("-", 2)
        if (not sceneries or scenery in sceneries) and (not sensors or rest.rsplit("-", 1)[0] in sensors):
            yield path


def compared(
    path: Path, drive: RenderedDrive, params: Params, *, odometry: Odometry = "none", breaks: bool = False
) -> list[Fits]:
    """Comparisons of each scan; read from the folder where they are kept.

    With `breaks`, the motion is unknown in the middle of the drive.
    """
    finder = CandidateSearch(params)
    name = f"{path.stem}-{_settings(finder, odometry)}{'-broken' * breaks}.log"
    path = path.parent / "compared" / name
    if not path.exists():
        poses = drive.odometry(odometry)
        with replacing(path) as temporary:
            log = FrameLog(temporary)
            for i, (keyframe, stamp) in enumerate(zip(drive.keyframe, drive.times.tolist(), strict=True)):
                pose = None if poses is None else poses[i]
                finder.add_keyframe(
                    keyframe, time=stamp, odometry=pose, continues=not (breaks and i == len(drive.keyframe) // 2)
                )
                log.append(i, frame_bytes(None, finder.fits))
            log.close()
    return [read_frame(content, i, {}, source=path)[1] for i, content in FrameLog(path).records()]


def _settings(finder: CandidateSearch, odometry: Odometry) -> str:
    """Hash of all that decides the comparisons."""
    parts = [finder.config, finder.verification, MOTION_DRIFT if odometry == "none" else finder.drift]
    about = json.dumps([finder.index.weights_hash, odometry, *map(dataclasses.asdict, parts)])
    return hashlib.sha256(about.encode()).hexdigest()[:16]


def search(
    drives: tyro.conf.Positional[Path],
    *,
    odometry: Odometry = "none",
    sceneries: tuple[str, ...] = (),
    sensors: tuple[str, ...] = (),
    weights: str = "sglpr",
) -> None:
    """Search rendered drives: wrong loops and recall by scenery, without or with odometry.

    A loop is wrong if its pose is (`scoring.PoseErrors`). Revisits are scans within 3 m of one on the same storey from
    which at least 30 m were travelled.

    Args:
        drives: folder of `render`.
        odometry: poses that the detector is given.
        sceneries: those to search; without them all.
        sensors: likewise.
        weights: the model that described the scans.
    """
    params, found = sglpr_jax.load(weights), dict[str, dict[str, list[np.ndarray]]]()
    for path in chosen(drives, sceneries, sensors):
        drive = read(path)
        counts = _counts(path, drive, params, odometry)
        found.setdefault(drive.about["revisit"], {}).setdefault(drive.about["scenery"], []).append(counts)
        print(f"{path.stem}: {counts[1]} loops, {counts[2]} wrong", flush=True)
    for revisit, of_sceneries in found.items():
        table = Table("scenery", "scans", "loops", "wrong", "of these in the plane", "recall", title=revisit)
        everything = [one for some in of_sceneries.values() for one in some]
        for scenery, some in (*of_sceneries.items(), ("all", everything)):
            *numbers, again, right = np.sum(some, axis=0).tolist()
            table.add_row(scenery, *map(str, numbers), f"{right / again:.3f}" if again else "")
        Console().print(table)


def _counts(path: Path, drive: RenderedDrive, params: Params, odometry: Odometry) -> np.ndarray:
    """Scans, loops, wrong ones, those of them in the plane, revisits, and revisits with a right loop."""
    given, detector = drive.odometry(odometry), LoopDetector(params)
    frames = compared(path, drive, params, odometry=odometry)
    for i, (keyframe, frame) in enumerate(zip(drive.keyframe, frames, strict=True)):
        pose = None if given is None else given[i]
        detector.add_keyframe(keyframe, time=float(drive.times[i]), odometry=pose, fits=frame)
    drift = detector.finder.present_drift
    path = detector.finder.motion.path
    loops = detector.loops if given is None else accept_loops(detector.loops, path, drift=drift)[0]
    fits = np.array([one.match_from_query for one in loops])
    errors = pose_errors([(one.query, one.match) for one in loops], fits, drive.world_from_lidar)
    right = {loop.query for loop, ok in zip(loops, errors.right, strict=True) if ok}
    again, in_plane = drive.revisits, errors.wrong & (errors.storey_m <= STOREY_M)
    found = sum(frame in right for frame in np.flatnonzero(again).tolist())
    return np.array([len(drive.keyframe), len(loops), errors.wrong.sum(), in_plane.sum(), again.sum(), found])
