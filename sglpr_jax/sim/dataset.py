"""Simulated drives on disk, resumable: the same seed gives the same bytes."""

import dataclasses
import functools
import hashlib
import json
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

from sglpr_jax.files import read_json, replacing
from sglpr_jax.sim.choices import RATE_HZ
from sglpr_jax.sim.drive import check_drawing, name_of_path, read_path, thinned
from sglpr_jax.sim.layouts import LAYOUTS, Layout
from sglpr_jax.sim.recording import SimulatedRecording, simulate_recording
from sglpr_jax.sim.routes import ROLES
from sglpr_jax.sim.scenery import TOWN, Scenery
from sglpr_jax.sim.sensor import HDL64E, SENSORS, Sensor
from sglpr_jax.sim.sessions import plan_sessions

SETTINGS_FILE = "simulation.json"
VERSION = 3
"""Of what the simulator makes of a seed; a change in its scans needs a new one."""
OLD_NAMES = {"crossing_every": "crossing_every_m", "wavelength": "wavelength_m"}
"""Of fields of a scenery, as older datasets note them, and those of today."""
WORKERS = 2
"""Threads that render; the compiled program leaves other threads room."""

Progress = Callable[[str, int, int], None]


def write_dataset(
    root: Path,
    *,
    names: Sequence[str] = ("00", "05", "08"),
    along: Sequence[Path] = (),
    scans: int = 300,
    sensor: Sensor = HDL64E,
    seed: int = 0,
    rate_hz: float = RATE_HZ,
    scenery: Scenery = TOWN,
    layout: str = "scans",
    progress: Progress | None = None,
) -> Path:
    """Write the routes `names`, and the drives along the pose files `along`, into the folder `root`; return `root`.

    Every drive has a town of its own, drawn from `seed` and the drive's name, and `scans` scans (along a pose file: at
    most so many, see `simulate_recording`). `layout` is "scans", "images" or "varied", see `LAYOUTS`. Files that are
    there are kept, so a run that was cut off goes on where it stopped, to the same bytes; every file is whole or not
    there. `progress(name, done, scans)` is called as scans are done.

    Raises ValueError for unknown names, a rate not above 0, a seed below 0, malformed pose files, and where `root`
    holds another dataset or one of other settings; OSError, with the file's name, where something cannot be written.
    """
    check_drawing(rate_hz, seed)
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
    _claim(root, {"layout": layout, **what, **_settings(sensor, scenery)}, ways)
    options = {"sensor": sensor, "scenery": scenery, **what}
    for name, file in files.items():
        count = scans if file is None else len(thinned(read_path(file), scans).times)
        simulate = functools.partial(simulate_recording, name, along=file, **options)
        show = functools.partial(progress, name) if progress else lambda done, scans: None
        ids = tuple(f"{i:06d}" for i in range(count))
        _write_drive(root, name, simulate, ids=ids, layout=LAYOUTS[layout], progress=show)
    return root


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
    """Write one town on several days into the folder `root`, in NCLT's layout; return `root`.

    Of the arguments and the drives see `plan_sessions`, of files, progress and errors `write_dataset`. Sessions cannot
    be added: with more days the streets are others.
    """
    what = {"route": route, "scans": scans, "seed": seed, "rate_hz": rate_hz}
    sessions = plan_sessions(dates, sensor=sensor, scenery=scenery, **what)
    _claim(root, {"layout": "nclt", "sessions": dates, **what, **_settings(sensor, scenery)}, {})
    for date, ids, simulate in sessions:
        show = functools.partial(progress, date) if progress else lambda done, scans: None
        _write_drive(root, date, simulate, ids=ids, layout=LAYOUTS["nclt"], progress=show)
    return root


def _settings(sensor: Sensor, scenery: Scenery) -> dict:
    """What is noted of all datasets."""
    return {"version": VERSION, "sensor": dataclasses.asdict(sensor), "scenery": dataclasses.asdict(scenery)}


def _fingerprint(file: Path | None) -> str:
    """What tells one way from another; reads the file whole, so that a malformed one is noticed first."""
    if file is None:
        return "route"
    return hashlib.sha256(b"".join(values.tobytes() for values in read_path(file))).hexdigest()[:16]


def _claim(root: Path, settings: dict, ways: dict[str, str]) -> None:
    """Note settings and ways in `root`, or make sure that they are those already there; new drives may be added."""
    path = root / SETTINGS_FILE
    if path.exists():
        found = _read_settings(path)
    elif root.is_dir() and any(not file.name.startswith(".") for file in root.iterdir()):
        raise ValueError(f"{root} holds files that were not simulated (no {SETTINGS_FILE}); choose another folder")
    else:
        found = {}
    expected = json.loads(json.dumps({**settings, **ways}))  # as JSON gives them back: tuples are lists
    claimed = {**(found or expected), **{way: ways[way] for way in ways if way not in found}}
    different = [key for key, value in expected.items() if claimed.get(key) != value]
    if different:
        described = ", ".join(f"{key} {expected[key]} (found {found.get(key)})" for key in different)
        raise ValueError(f"{path} belongs to another simulated dataset; expected {described}; choose another folder")
    if claimed != found:
        _write(path, json.dumps(claimed, indent=1, sort_keys=True).encode())


def _read_settings(path: Path) -> dict:
    """The settings that were noted, by the names of today; datasets of before there were sceneries are towns."""
    settings = read_json(path)
    scenery = settings.get("scenery", dataclasses.asdict(TOWN)) if isinstance(settings, dict) else None
    if not isinstance(scenery, dict):
        raise ValueError(f"{path}: expected the settings of a simulated dataset, found {settings!r:.60}")
    scenery = {OLD_NAMES.get(name, name): value for name, value in scenery.items()}
    return {**settings, "scenery": json.loads(json.dumps(scenery))}


def _write_drive(
    root: Path,
    name: str,
    simulate: Callable[[], SimulatedRecording],
    *,
    ids: Sequence[str],
    layout: Layout,
    progress: Callable[[int, int], None],
) -> None:
    """Write what is missing of one drive; its town is built only where something is."""
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
    """Write a file whole or not at all."""
    with replacing(path) as temporary:
        temporary.write_bytes(content)
