"""Simulated datasets: `simulate` plans the recordings and writes them. An interrupted run can be resumed."""

import dataclasses
import hashlib
import json
import math
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

from sglpr_jax.data.readers.simulation import SIMULATION
from sglpr_jax.files import check_still_there, read_json, write_bytes
from sglpr_jax.sim import RATE_HZ, SCANS
from sglpr_jax.sim.drive import CARRIERS, check_rate_and_seed, name_of_path, read_path, scan_rows
from sglpr_jax.sim.layouts import LAYOUTS, Layout
from sglpr_jax.sim.recording import (
    PlannedRecording,
    SimulatedRecording,
    carried_height_m,
    numbered_ids,
    plan_sessions,
    simulate_recording,
    simulate_repeating,
    with_submaps,
)
from sglpr_jax.sim.routes import ROLES
from sglpr_jax.sim.sceneries import REPEATING
from sglpr_jax.sim.sensor import SENSORS, Sensor
from sglpr_jax.sim.styles import SCENERIES

VERSION = 4  # version of the simulator's output; it changes whenever the scans of a seed change
WORKERS = 2  # rendering threads; the compiled program leaves capacity for more than one
ROUTES = ("00", "05", "08")  # default routes in towns
REVISITED = ("01", "06", "08")
"""Default routes in repeating sceneries: without revisits, with revisits in the same and in the opposite direction."""
DAYS = ("2012-01-15", "2012-02-04", "2012-03-17")  # default dates of sessions
AZIMUTH_STEPS = 900  # firings per revolution in the default datasets
BYTES_PER_RAY = {"scans": 16, "nclt": 5}  # approximate size of a scan with its labels, by layout
BYTES_PER_IMAGE = 3500  # approximate size of an image with its label image, in bytes


@dataclasses.dataclass(frozen=True)
class Simulated:
    """Description of a simulated dataset, before or after it is written."""

    root: Path
    names: tuple[str, ...]  # names of the recordings
    scans: int  # maximum number of scans in each recording
    layout: str  # name of the layout, from `LAYOUTS`
    sensor: Sensor

    @property
    def missing(self) -> tuple[str, ...]:
        """Recordings that are not complete."""
        return tuple(name for name in self.names if not LAYOUTS[self.layout].is_finished(self.root, name))

    @property
    def missing_bytes(self) -> int:
        """Approximate size of the missing recordings, in bytes."""
        rays = len(self.sensor.elevations_deg) * self.sensor.azimuth_steps
        bytes_per_scan = BYTES_PER_RAY[self.layout] * rays if self.layout in BYTES_PER_RAY else BYTES_PER_IMAGE
        return bytes_per_scan * self.scans * len(self.missing)

    def __str__(self) -> str:
        return f"{self.root}: recordings {', '.join(self.names)}"


def simulate(
    out: Path | str,
    *,
    routes: Sequence[str] | None = None,
    along: Sequence[Path] = (),
    sessions: Sequence[str] = (),
    scans: int = SCANS,
    sensor: str | Sensor | None = None,
    azimuth_steps: int | None = None,
    seed: int = 0,
    rate_hz: float | None = None,
    scenery: str = "town",
    carrier: str = "vehicle",
    aside_m: float = 0.0,
    submap_m: float = 0.0,
    images: bool = False,
    vary: bool = False,
    on_start: Callable[[Simulated], None] = lambda dataset: None,
    on_progress: Callable[[int], None] = lambda done: None,
) -> Simulated:
    """Drives a simulated LiDAR through simulated towns and writes scans, labels and poses.

    Existing files are kept: the same call completes an interrupted dataset. Recordings can be added to a dataset.
    Sessions cannot, because their streets depend on the number of days.

    Arguments:
      out: Output folder.
      routes: Routes "00" to "10", each with its own town. None drives 00, 05 and 08, where places repeat 01, 06 and 08,
        or no route if there is `along`.
      along: KITTI pose files to drive along, see `read_path`.
      sessions: Dates such as "2012-01-15" on which one town is driven, in NCLT's layout, see `plan_sessions`. `routes`
        may then hold one route; None is 00.
      scans: Number of scans of each recording, at least 2. Along a pose file it is the maximum.
      sensor: LiDAR, or its name from `SENSORS`. None is hdl64e, or hdl32e-nclt with `sessions`.
      azimuth_steps: Firings per revolution. None is the sensor's own number.
      seed: Seed of the towns, at least 0.
      rate_hz: Scans per second of a route. None is 4 in towns, elsewhere the rate of the carrier or of the scenery.
      scenery: Name from `SCENERIES` (towns), or from `REPEATING`, where routes only give the direction of revisits.
      carrier: Name from `CARRIERS`. In towns, only its height and sway are used. `sessions` need a vehicle.
      aside_m: Distance of the drive to the left of its usual line through the same town, in metres.
      submap_m: Travelled distance of submaps, in metres. 0 writes scans.
      images: Whether to write density images with label images instead of scans.
      vary: Whether the images show scans that are rotated about z, most of them with lost points. See `layouts.vary`.
      on_start: Called with the dataset's description after all arguments are checked.
      on_progress: Called with the number of completed scans, counting `scans` for each recording.

    Returns:
      Description of the dataset.

    Raises:
      ValueError: An argument is unknown or out of range, arguments contradict each other, a pose file is malformed, or
        `out` holds other files or a dataset with other settings.
      OSError: A file cannot be read or written. The message names the file.

    Example:
      print(sglpr_jax.simulate("towns", routes=["08"], scans=400))
    """
    lidar = _find_sensor(sensor or ("hdl32e-nclt" if sessions else "hdl64e"), azimuth_steps)
    of_drives = {"aside_m": aside_m, "submap_m": submap_m}
    _check_arguments(routes, along, sessions, scenery, carrier, **of_drives, images=images, vary=vary)
    is_repeating = scenery in REPEATING
    if routes is None:
        default_routes = REVISITED if is_repeating else ROUTES
        routes = () if along or sessions else default_routes
    if rate_hz is None:
        rate_hz = (CARRIERS[carrier].rate_hz or REPEATING[scenery].rate_hz) if is_repeating else RATE_HZ
    layout = "scans"
    if sessions:
        layout = "nclt"
    elif images:
        layout = "varied" if vary else "images"
    options = {"scans": scans, "seed": seed, "rate_hz": rate_hz}
    settings = {
        "version": VERSION,
        "layout": layout,
        "scenery": {"repeating": scenery} if is_repeating else dataclasses.asdict(SCENERIES[scenery]),
        "sensor": dataclasses.asdict(lidar),
        "carrier": dataclasses.asdict(CARRIERS[carrier]),
        **of_drives,
        **options,
    }
    height_m = carried_height_m(CARRIERS[carrier], REPEATING.get(scenery))
    if height_m is not None:
        settings["height_m"] = height_m  # instead of the sensor's
    if sessions:
        route, pose_files = next(iter(routes), "00"), {}
        plans = plan_sessions(sessions, route=route, sensor=lidar, scenery=SCENERIES[scenery], **options)
        settings |= {"sessions": sessions, "route": route}
    else:
        check_rate_and_seed(rate_hz, seed)
        pose_files = _pose_files(routes, along, scans)
        options |= {"sensor": lidar, "carrier": CARRIERS[carrier], "aside_m": aside_m}
        plans = [_plan(name, file, scenery, submap_m, **options) for name, file in pose_files.items()]
    out = Path(out)
    _claim(out, settings, {f"drive {name}": _fingerprint(file) for name, file in pose_files.items()})
    dataset = Simulated(out, tuple(plan.name for plan in plans), scans, layout, lidar)
    on_start(dataset)
    for k, plan in enumerate(plans):

        def on_scan(done: int, k: int = k, count: int = len(plan.ids)) -> None:
            on_progress(k * scans + done * scans // count)

        _write_drive(out, plan, LAYOUTS[layout], on_scan)
    check_still_there(out / SIMULATION)
    return dataset


def default_dataset(cache: Path, *, sessions: bool = False) -> tuple[Path, dict]:
    """Folder below `cache` and options of `simulate` for the default towns, or for one town on three days."""
    folder = f"{'sessions' if sessions else 'simulated'}-v{VERSION}-{SCANS}x{AZIMUTH_STEPS}-seed0"
    options = {"scans": SCANS, "azimuth_steps": AZIMUTH_STEPS, "seed": 0}
    return cache / folder, options | ({"sessions": DAYS} if sessions else {})


def _find_sensor(sensor: str | Sensor, azimuth_steps: int | None) -> Sensor:
    """Sensor of this name, with `azimuth_steps` if it is not None. Raises ValueError if the name is unknown."""
    if isinstance(sensor, str):
        if sensor not in SENSORS:
            raise ValueError(f"expected a sensor among {', '.join(SENSORS)}, found {sensor!r}")
        sensor = SENSORS[sensor]
    return sensor if azimuth_steps is None else dataclasses.replace(sensor, azimuth_steps=azimuth_steps)


def _check_arguments(
    routes: Sequence[str] | None,
    along: Sequence[Path],
    sessions: Sequence[str],
    scenery: str,
    carrier: str,
    *,
    aside_m: float,
    submap_m: float,
    images: bool,
    vary: bool,
) -> None:
    """Raises ValueError if a scenery or carrier is unknown, or if arguments contradict each other."""
    names, sceneries = list(routes or ()), SCENERIES if sessions else {**SCENERIES, **REPEATING}
    # In a repeating scenery, a drive is determined by its kind of revisits, so two equal kinds are the same drive.
    revisits = [ROLES[name].revisit for name in names if name in ROLES]
    has_equal_drives = scenery in REPEATING and (along or len(set(revisits)) < len(revisits))
    rules = (  # condition that must hold, what was expected, what was found
        (
            not sessions or (not along and not images and len(names) <= 1),
            "with sessions, expected at most one route, no pose files and no images",
            f"{len(names)} routes, {len(along)} pose files, images {images}",
        ),
        (scenery in sceneries, f"expected a scenery among {', '.join(sceneries)}", repr(scenery)),
        (carrier in CARRIERS, f"expected a carrier among {', '.join(CARRIERS)}", repr(carrier)),
        (not sessions or carrier == "vehicle", "with sessions, expected the carrier vehicle", repr(carrier)),
        (not sessions or not submap_m, "with sessions, expected no submaps", f"submaps of {submap_m:g} m"),
        (not sessions or not aside_m, "with sessions, expected drives on their usual line", f"{aside_m:g} m aside"),
        (math.isfinite(aside_m), "aside_m: expected metres", f"{aside_m}"),
        (0 <= submap_m < math.inf, "submap_m: expected metres, at least 0", f"{submap_m}"),
        (images or not vary, "vary: expected images", "scans; vary changes scans before they are converted to images"),
        (
            not has_equal_drives,
            f"scenery {scenery}: expected no pose files and routes with different revisits, such as 01 06 08",
            " ".join([*names, *map(str, along)]),
        ),
    )
    for holds, expected, found in rules:
        if not holds:
            raise ValueError(f"{expected}, found {found}")


def _pose_files(routes: Sequence[str], along: Sequence[Path], scans: int) -> dict[str, Path | None]:
    """Pose file of each drive by the drive's name, or None for a route.

    Raises ValueError if a route is unknown, two drives have the same name, or `scans` is below 2.
    """
    unknown = [name for name in routes if name not in ROLES]
    if unknown or scans < 2:
        raise ValueError(f"expected drives among {', '.join(ROLES)} with 2 scans or more, found {unknown}, {scans}")
    names = [*routes, *map(name_of_path, along)]
    if len(set(names)) < len(names):
        raise ValueError(f"expected different names, found {', '.join(names)}")
    return dict(zip(names, [*[None] * len(routes), *along], strict=True))


def _plan(name: str, file: Path | None, scenery: str, submap_m: float, *, scans: int, **options) -> PlannedRecording:
    """Plans the drive `name` along a route or a pose file. `options` are those of `simulate_recording`."""

    def simulate() -> SimulatedRecording:
        if scenery in REPEATING:
            recording = simulate_repeating(scenery, revisit=ROLES[name].revisit, scans=scans, **options)
        else:
            recording = simulate_recording(name, along=file, scenery=SCENERIES[scenery], scans=scans, **options)
        return with_submaps(recording, submap_m) if submap_m else recording

    scan_count = scans if file is None else len(scan_rows(read_path(file), scans))
    return PlannedRecording(name, numbered_ids(scan_count), simulate)


def _fingerprint(file: Path | None) -> str:
    """Hash of a pose file, or "route". The whole file is read, so a malformed file raises an error early."""
    if file is None:
        return "route"
    return hashlib.sha256(b"".join(array.tobytes() for array in read_path(file))).hexdigest()[:16]


def _claim(root: Path, settings: dict, fingerprints: dict[str, str]) -> None:
    """Stores the settings and the fingerprints of drives in `root`. Fingerprints of new drives are added.

    Raises ValueError if `root` holds other files, or other settings or fingerprints.
    """
    path = root / SIMULATION
    if not path.exists() and root.is_dir() and any(not file.name.startswith(".") for file in root.iterdir()):
        raise ValueError(f"{root} holds files that were not simulated (no {SIMULATION}); choose another folder")
    stored = read_json(path) if path.exists() else {}
    if not isinstance(stored, dict):
        raise ValueError(f"{path}: expected the settings of a simulated dataset, found {stored!r:.60}")
    expected = json.loads(json.dumps({**settings, **fingerprints}))  # as read from JSON: tuples become lists
    merged = {**fingerprints, **(stored or expected)}
    different = [key for key, value in expected.items() if merged.get(key) != value]
    if different:
        described = ", ".join(f"{key} {expected[key]} (found {stored.get(key)})" for key in different)
        raise ValueError(f"{path} belongs to another simulated dataset; expected {described}; choose another folder")
    if merged != stored:
        write_bytes(path, json.dumps(merged, indent=1, sort_keys=True).encode())


def _write_drive(root: Path, plan: PlannedRecording, layout: Layout, progress: Callable[[int], None]) -> None:
    """Writes the missing files of one drive. The town is built only if files are missing.

    `progress` is called with the number of existing scans.
    """
    files = [layout.files_of_scan(root, plan.name, scan_id) for scan_id in plan.ids]
    missing = [i for i, scan_files in enumerate(files) if not all(file.exists() for file in scan_files)]
    progress(len(files) - len(missing))
    if not missing and layout.is_finished(root, plan.name):
        return
    recording = plan.simulate()

    def write_scan(i: int) -> None:
        contents = layout.scan_contents(*recording.render(i), recording.mounting)
        for file, content in zip(files[i], contents, strict=True):
            write_bytes(file, content)

    with ThreadPoolExecutor(WORKERS) as pool:
        try:
            for done, _ in enumerate(pool.map(write_scan, missing), len(files) - len(missing) + 1):
                progress(done)
        except BaseException:
            pool.shutdown(cancel_futures=True)
            raise
    for file, content in layout.drive_contents(recording.poses, recording.mounting).items():
        write_bytes(layout.file_of_drive(root, plan.name, file), content)
