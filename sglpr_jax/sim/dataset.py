"""Writing of simulated drives to disk. An interrupted run can be resumed, and the same seed gives the same bytes."""

import dataclasses
import functools
import hashlib
import json
import math
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

from sglpr_jax.files import read_json, replacing
from sglpr_jax.sim.carriers import VEHICLE, Carrier
from sglpr_jax.sim.choices import RATE_HZ
from sglpr_jax.sim.drive import check_drawing, name_of_path, read_path, thinned
from sglpr_jax.sim.layouts import LAYOUTS, Layout
from sglpr_jax.sim.recording import SimulatedRecording, simulate_recording, with_submaps
from sglpr_jax.sim.repeating import default_rate, simulate_repeating
from sglpr_jax.sim.routes import ROLES
from sglpr_jax.sim.sceneries import REPEATING
from sglpr_jax.sim.scenery import TOWN, Scenery
from sglpr_jax.sim.sensor import HDL64E, SENSORS, Sensor
from sglpr_jax.sim.sessions import plan_sessions

SETTINGS_FILE = "simulation.json"
VERSION = 3
"""Version of the simulator's output. It changes whenever the scans of a seed change."""
OLD_NAMES = {"crossing_every": "crossing_every_m", "wavelength": "wavelength_m"}
"""Field names of a scenery in older datasets, and their current names."""
WORKERS = 2
"""Number of rendering threads. The compiled program leaves capacity for more than one."""

Progress = Callable[[str, int, int], None]


def write_dataset(
    root: Path,
    *,
    names: Sequence[str] = ("00", "05", "08"),
    along: Sequence[Path] = (),
    scans: int = 300,
    sensor: Sensor = HDL64E,
    seed: int = 0,
    rate_hz: float | None = None,
    scenery: Scenery | str = TOWN,
    carrier: Carrier = VEHICLE,
    submap_m: float = 0.0,
    layout: str = "scans",
    progress: Progress | None = None,
) -> Path:
    """Writes simulated drives into a folder.

    Each drive has its own town, which depends on `seed` and the name of the drive. Existing files are kept. The same
    call resumes an interrupted run and gives the same bytes. Files are written atomically.

    In sceneries of `REPEATING`, a route stands only for the direction of its revisits, and the drive is that of
    `simulate_repeating`.

    Arguments:
      root: Output folder.
      names: Routes, from `ROLES`.
      along: KITTI pose files to drive along, see `read_path`.
      scans: Number of scans of each drive. Along a pose file it is the maximum, see `simulate_recording`.
      sensor: LiDAR.
      seed: Seed of the towns, at least 0.
      rate_hz: Scans per second of a route. Not used along pose files. None is 4 in towns, elsewhere the rate
        of the carrier or of the scenery.
      scenery: Scenery of the towns, or a name from `REPEATING`.
      carrier: Carrier of the sensor. In towns, only its height and sway are used.
      submap_m: Travelled distance of submaps, in metres (`sglpr_jax.submaps`). 0 writes scans.
      layout: "scans", "images" or "varied", see `LAYOUTS`.
      progress: Function that is called as `progress(name, done, scans)` whenever scans are done.

    Returns:
      `root`.

    Raises:
      ValueError: A route, the scenery or the layout is unknown, two drives have one name, or `scans` is below 2. Or
        `rate_hz` is not positive, `seed` or `submap_m` is negative, or a pose file is malformed. Or `root` holds other
        files, or a dataset with other settings. Or the scenery is from `REPEATING`, and there is a pose file, or two
        routes have revisits in the same direction.
      OSError: A file cannot be read or written. The message names the file.
    """
    rate_hz = _checked_rate(scenery, names, along, rate_hz, carrier)
    check_drawing(rate_hz, seed)
    if not 0 <= submap_m < math.inf:
        raise ValueError(f"submap_m: expected metres, at least 0, found {submap_m}")
    files = {**dict.fromkeys(names), **{name_of_path(file): file for file in along}}
    unknown = [name for name in names if name not in ROLES]
    if unknown or scans < 2:
        raise ValueError(f"expected drives among {', '.join(ROLES)} with 2 scans or more, found {unknown}, {scans}")
    if len(files) < len(names) + len(along) or layout not in ("scans", "images", "varied"):
        drives = [*names, *map(name_of_path, along)]
        expected = "different names and layout scans, images or varied"
        raise ValueError(f"expected {expected}, found {', '.join(drives)} and {layout}")
    what = {"scans": scans, "seed": seed, "rate_hz": rate_hz}
    ways = {f"drive {name}": _fingerprint(file) for name, file in files.items()}
    lengths = {"submap_m": submap_m} if submap_m else {}
    _claim(root, {"layout": layout, **what, **lengths, **_settings(sensor, scenery, carrier)}, ways)
    options = {"sensor": sensor, "scenery": scenery, "carrier": carrier, "submap_m": submap_m, **what}
    for name, file in files.items():
        count = scans if file is None else len(thinned(read_path(file), scans).times)
        simulate = functools.partial(_recording, name, along=file, **options)
        show = functools.partial(progress, name) if progress else lambda done, scans: None
        ids = tuple(f"{i:06d}" for i in range(count))
        _write_drive(root, name, simulate, ids=ids, layout=LAYOUTS[layout], progress=show)
    return root


def _checked_rate(
    scenery: Scenery | str, names: Sequence[str], along: Sequence[Path], rate_hz: float | None, carrier: Carrier
) -> float:
    """Scans per second, after a check that the scenery has the drives."""
    if isinstance(scenery, Scenery):
        return RATE_HZ if rate_hz is None else rate_hz
    if scenery not in REPEATING:
        raise ValueError(f"expected a scenery among {', '.join(REPEATING)}, found {scenery!r}")
    revisits = [ROLES[name].revisit for name in names if name in ROLES]
    if along or len(set(revisits)) < len(revisits):
        expected = "no pose files and routes with different revisits, such as 01 06 08"
        raise ValueError(f"scenery {scenery}: expected {expected}, found {' '.join([*names, *map(str, along)])}")
    return default_rate(REPEATING[scenery], carrier) if rate_hz is None else rate_hz


def _recording(
    name: str, *, along: Path | None, scenery: Scenery | str, submap_m: float, **options
) -> SimulatedRecording:
    """Drive of a route or along a pose file, with submaps of `submap_m`."""
    if isinstance(scenery, str):
        recording = simulate_repeating(scenery, revisit=ROLES[name].revisit, **options)
    else:
        recording = simulate_recording(name, along=along, scenery=scenery, **options)
    return with_submaps(recording, submap_m)


def write_sessions(
    root: Path,
    *,
    dates: Sequence[str],
    route: str = "00",
    scans: int = 300,
    sensor: Sensor = SENSORS["hdl32e-nclt"],
    seed: int = 0,
    rate_hz: float = RATE_HZ,
    scenery: Scenery = TOWN,
    progress: Progress | None = None,
) -> Path:
    """Writes one town on several days into the folder `root`, in NCLT's layout, and returns `root`.

    `plan_sessions` describes the other arguments and the drives. `write_dataset` describes files, progress and errors.
    Sessions cannot be added to a dataset, because the streets depend on the number of days.
    """
    what = {"route": route, "scans": scans, "seed": seed, "rate_hz": rate_hz}
    sessions = plan_sessions(dates, sensor=sensor, scenery=scenery, **what)
    _claim(root, {"layout": "nclt", "sessions": dates, **what, **_settings(sensor, scenery)}, {})
    for date, ids, simulate in sessions:
        show = functools.partial(progress, date) if progress else lambda done, scans: None
        _write_drive(root, date, simulate, ids=ids, layout=LAYOUTS["nclt"], progress=show)
    return root


def _settings(sensor: Sensor, scenery: Scenery | str, carrier: Carrier = VEHICLE) -> dict:
    """Settings that are stored with every dataset."""
    surroundings = {"repeating": scenery} if isinstance(scenery, str) else dataclasses.asdict(scenery)
    sensed = {"sensor": dataclasses.asdict(sensor), "carrier": dataclasses.asdict(carrier)}
    return {"version": VERSION, "scenery": surroundings, **sensed}


def _fingerprint(file: Path | None) -> str:
    """Hash of a pose file, or "route". The whole file is read, so a malformed file raises an error early."""
    if file is None:
        return "route"
    return hashlib.sha256(b"".join(values.tobytes() for values in read_path(file))).hexdigest()[:16]


def _claim(root: Path, settings: dict, ways: dict[str, str]) -> None:
    """Stores settings and drives in `root`, or checks that they match the stored ones. New drives are added."""
    path = root / SETTINGS_FILE
    if path.exists():
        found = _read_settings(path)
    elif root.is_dir() and any(not file.name.startswith(".") for file in root.iterdir()):
        raise ValueError(f"{root} holds files that were not simulated (no {SETTINGS_FILE}); choose another folder")
    else:
        found = {}
    expected = json.loads(json.dumps({**settings, **ways}))  # as read from JSON: tuples become lists
    claimed = {**(found or expected), **{way: ways[way] for way in ways if way not in found}}
    different = [key for key, value in expected.items() if claimed.get(key) != value]
    if different:
        described = ", ".join(f"{key} {expected[key]} (found {found.get(key)})" for key in different)
        raise ValueError(f"{path} belongs to another simulated dataset; expected {described}; choose another folder")
    if claimed != found:
        _write(path, json.dumps(claimed, indent=1, sort_keys=True).encode())


def _read_settings(path: Path) -> dict:
    """Stored settings with the current field names.

    Older datasets have `TOWN`, sensors that repeat their rings, and a vehicle.
    """
    settings = read_json(path)
    scenery = settings.get("scenery", dataclasses.asdict(TOWN)) if isinstance(settings, dict) else None
    if not isinstance(scenery, dict):
        raise ValueError(f"{path}: expected the settings of a simulated dataset, found {settings!r:.60}")
    scenery = {OLD_NAMES.get(name, name): value for name, value in scenery.items()}
    sensor = settings.get("sensor")
    rings = {name: getattr(Sensor, name) for name in ("azimuths_deg", "pattern")}
    sensor = {**rings, **sensor} if isinstance(sensor, dict) else sensor
    carrier = settings.get("carrier", dataclasses.asdict(VEHICLE))
    return {**settings, **json.loads(json.dumps({"carrier": carrier, "sensor": sensor, "scenery": scenery}))}


def _write_drive(
    root: Path,
    name: str,
    simulate: Callable[[], SimulatedRecording],
    *,
    ids: Sequence[str],
    layout: Layout,
    progress: Callable[[int, int], None],
) -> None:
    """Writes the missing files of one drive. The town is built only if files are missing."""
    scans = len(ids)
    missing = [i for i in range(scans) if not all(file.exists() for file in layout.files_of_scan(root, name, ids[i]))]
    progress(scans - len(missing), scans)
    if not missing and layout.is_finished(root, name):
        return
    recording = simulate()

    def write_scan(i: int) -> None:
        contents = layout.scan_contents(*recording.render(i), recording.mounting)
        for file, content in zip(layout.files_of_scan(root, name, ids[i]), contents, strict=True):
            _write(file, content)

    with ThreadPoolExecutor(WORKERS) as pool:
        try:
            for done, _ in enumerate(pool.map(write_scan, missing), scans - len(missing) + 1):
                progress(done, scans)
        except BaseException:
            pool.shutdown(cancel_futures=True)
            raise
    for file, content in layout.drive_contents(recording.poses).items():
        _write(layout.file_of_drive(root, name, file), content)


def _write(path: Path, content: bytes) -> None:
    """Writes a file atomically."""
    with replacing(path) as temporary:
        temporary.write_bytes(content)
