"""bin/loops: find the loop closures of a recording and write them for a pose graph."""

import dataclasses
import itertools
import shlex
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import tyro

from sglpr_jax.cli.config_file import record_command
from sglpr_jax.cli.recording import (
    AUTO,
    CloudOptions,
    DetectorFlags,
    PosedRecordingOptions,
    SubmapOptions,
    beside,
    open_with_odometry,
    report_bad_scan,
)
from sglpr_jax.cli.runtime import open_page, with_installed_names
from sglpr_jax.data.choices import ScaleChoice
from sglpr_jax.files import check_writable, exclusive_lock
from sglpr_jax.loops.config import Degenerate
from sglpr_jax.models.shipped import DEFAULT_WEIGHTS
from sglpr_jax.odometry.config import OdometryConfig, OdometryFormat
from sglpr_jax.progress import progress_bar
from sglpr_jax.stop_request import stop_on_signal

if TYPE_CHECKING:
    from collections.abc import Sequence

UNFINISHED = "unfinished"
"""Folder of the checkpoint of a running command, inside the output folder."""


@dataclasses.dataclass(frozen=True)
class LoopsCommand:
    """Find the loop closures of a recording: pairs of scans of one place, their relative poses and probabilities.

    With several recordings, the command finds the loops within and between them, and the transforms between their
    frames, which need not be the same. It writes frames.json with the transforms.

    The command writes loops.g2o, loops.jsonl, loops.csv, rejected.jsonl (rejected pairs, with their reasons),
    index.html and command.json (the flags). With odometry it also writes trajectory.tum and trajectory.kitti, and with
    --optimize the corrected trajectory. Ctrl-C writes the loops found until then. The same command continues a run that
    was interrupted or killed.

    Example:
      bin/loops my_scans                                         by the scans alone
      bin/loops my_scans --odometry auto --optimize              SLAM: also odometry and a corrected trajectory
      bin/loops my_scans --odometry auto --optimize --cloud map.ply --grid map.yaml
      bin/loops my_scans --odometry odometry.tum --optimize      corrects your odometry
      bin/loops drive.mcap --odometry drive.mcap --pose-topic /odom --out found
      bin/loops KITTI --seq 08 --odometry KITTI/poses/08.txt --odometry-format kitti
      bin/loops my_scans --odometry odometry.tum --submap-m 10   a sensor with a narrow view
      bin/loops monday tuesday --odometry auto --optimize        two drives in one frame
    """

    recording: Annotated[Path | tuple[Path, ...], tyro.conf.Positional]
    """A dataset, a bag or a folder of scans, in any supported layout, or several of them."""
    out: Path | None = None
    """Output folder. None: NAME-loops beside the recording NAME."""
    odometry: Literal["auto"] | Path | tuple[Path, ...] | None = None
    """File with a pose for each scan, tum file with poses at other times, which are interpolated, or the bag itself.
    `auto` computes odometry from the scans (extra odometry), and deskews them if their points have times. Without
    odometry, loops are found by the scans alone. Several recordings need one file each, in the same order."""
    odometry_format: OdometryFormat = "auto"
    """Format of --odometry. 12 numbers a line are kitti (camera axes) or lidar (z up), and 8 numbers are tum. `auto`
    recognises tum and .g2o."""
    scan_odometry: OdometryConfig = OdometryConfig()
    """Settings of --odometry auto."""
    weights: str = DEFAULT_WEIGHTS
    """Name of shipped weights, folder of a training run, or folder with config.json and model.safetensors."""
    source: tyro.conf.OmitArgPrefixes[PosedRecordingOptions] = PosedRecordingOptions()
    submap: tyro.conf.OmitArgPrefixes[SubmapOptions] = SubmapOptions()
    scale: ScaleChoice = 1
    """Factor for all lengths while scans are compared. 2 or 4 enlarges places that are small in an image, such as
    rooms. Results are in metres. `auto` is 4 if nine tenths of the points are less than 8 m away, otherwise 1."""
    register: bool = True
    """Register the full scans of loops in 6 degrees of freedom and check their overlap. Images are not
    registered."""
    optimize: bool = False
    """Correct the odometry by the loops (extra gtsam): trajectory-optimized.tum and .kitti. The correction of thousands
    of frames takes minutes."""
    rerun: Path | None = None
    """Also write trajectories, scans, loops and image pairs of one recording to this .rrd file, for the rerun viewer
    (extra view)."""
    output: tyro.conf.OmitArgPrefixes[CloudOptions] = CloudOptions()
    decision: tyro.conf.OmitArgPrefixes[DetectorFlags] = DetectorFlags()
    degenerate: Degenerate = "keep"
    """Loops whose position has a standard deviation of more than 1 m in one horizontal direction, for example between
    plain walls: `keep` writes these loops with that information matrix, and `drop` rejects them."""
    skip_bad: bool = False
    """Report unreadable scans and skip them."""
    open: bool = False
    """Open the page in a browser."""

    @property
    def folder(self) -> Path:
        """Output folder."""
        return self.out or beside(self.recordings[0], self.source.seq, "-loops")

    @property
    def recordings(self) -> tuple[Path, ...]:
        """Paths of all recordings."""
        return (self.recording,) if isinstance(self.recording, Path) else self.recording

    @property
    def odometry_files(self) -> tuple[Path, ...]:
        """Files of the odometry, or an empty tuple."""
        if self.odometry is None or self.odometry == AUTO:
            return ()
        return (self.odometry,) if isinstance(self.odometry, Path) else self.odometry


def loops_of_recording(command: LoopsCommand) -> int:
    """Run the command. Returns the exit status."""
    check_flags(command)
    with exclusive_lock(command.folder / UNFINISHED):
        return _search_and_write(command)


def check_flags(command: LoopsCommand) -> None:
    """Raise ValueError if flags are inconsistent or an input would be overwritten, ImportError without an extra."""
    from sglpr_jax.odometry import kiss_icp  # slow imports, not needed for --help
    from sglpr_jax.pose_graph.factor_graph import gtsam_library
    from sglpr_jax.pose_graph.folder import LOOPS_G2O, TRAJECTORIES

    recordings, files = command.recordings, command.odometry_files
    if not recordings:
        raise ValueError("expected a recording, found none")
    if files and len(files) != len(recordings):
        raise ValueError(f"--odometry: expected a file for each of {len(recordings)} recordings, found {len(files)}")
    if command.rerun is not None:
        if len(recordings) > 1:
            raise ValueError("--rerun shows one recording, found several recordings")
        from sglpr_jax.evaluation import rerun_file  # slow import, not needed without --rerun

        rerun_file.check_installed()
        check_writable(command.rerun)
    if len(recordings) > 1 and (command.source.poses or command.source.times):
        raise ValueError("--poses and --times are those of one recording, found several recordings")
    if command.odometry is None and command.optimize:
        raise ValueError("--optimize corrects odometry: expected --odometry, found none; give auto, a file or a bag")
    if command.odometry == AUTO:
        kiss_icp.check_installed()
    if command.optimize:
        gtsam_library()
    command.output.check(recordings, submap_m=command.submap.submap_m)
    if command.output.any and not command.optimize:
        raise ValueError("--cloud and --grid need a corrected trajectory: expected --optimize, found none")
    for path in (*files, command.source.poses, command.source.times):
        if path is None or path.resolve().parent != command.folder.resolve():
            continue
        if path.name in (LOOPS_G2O, *TRAJECTORIES) or path.name.startswith("trajectory-"):
            raise ValueError(
                f"{path}: expected inputs that this run does not overwrite, found an output file; choose another --out"
            )


def _search_and_write(command: LoopsCommand) -> int:
    """Find the loops, write all files of the command and print a summary. Returns the exit status."""
    from sglpr_jax.evaluation.loops_page import PAGE, loops_page
    from sglpr_jax.evaluation.rerun_file import write_rerun
    from sglpr_jax.loops.checkpoint import ODOMETRY_LOG, delete_checkpoint
    from sglpr_jax.loops.closure import why_rejected
    from sglpr_jax.loops.result import diagnose_no_loops
    from sglpr_jax.loops.search import find_loops
    from sglpr_jax.models.weights_file import load
    from sglpr_jax.pose_graph.folder import write_loop_folder
    from sglpr_jax.pose_graph.optimize import describe_errors, optimize_trajectory, placements

    params, out, checkpoint = load(command.weights), command.folder, command.folder / UNFINISHED
    detector = command.decision.detector  # raises an error for invalid settings before the recordings are opened
    effective, recordings, odometry = open_with_odometry(
        command,
        command.recordings,
        AUTO if command.odometry == AUTO else command.odometry_files,
        format=command.odometry_format,
        checkpoint=lambda number: checkpoint / f"{number}" / ODOMETRY_LOG,
    )
    command.output.check_recordings(recordings)
    images = next((recording for recording in recordings if recording.has_images), None)
    if command.register and images is not None:
        print(f"loops are not registered, because {images.name} has ready-made images", file=sys.stderr)
    title = recordings[0].name if len(recordings) == 1 else f"of {len(recordings)} recordings"
    # Each scan is compared within its recording, and then with every earlier recording.
    comparisons = sum((1 + number) * len(recording) for number, recording in enumerate(recordings))
    with stop_on_signal() as stop, progress_bar(f"loops {title}", comparisons) as show:
        result = find_loops(
            recordings,
            params,
            odometry=odometry or None,
            config=detector,
            registered=None if command.register else False,
            scale=effective.scale,
            on_bad_scan=report_bad_scan if command.skip_bad else None,
            kept_in=checkpoint,
            should_stop=stop,
            on_progress=show,
        )
    if command.degenerate == "drop":
        result = result.without_degenerate()
    names = zip(result.unique_names, result.sessions, strict=True)
    unused = [name for name, session in names if session.odometry is None]
    optimized = None
    if command.optimize and not unused:
        print("correcting the trajectory, writing the page", file=sys.stderr)
        optimized = optimize_trajectory(result)
    paths = write_loop_folder(result, out, optimized=optimized, texts={PAGE: loops_page(result, optimized=optimized)})
    paths.append(record_command(effective, out))
    if command.rerun is not None:
        write_rerun(result, command.rerun, optimized=optimized)
    print(result, *diagnose_no_loops(result), *why_rejected(result.rejected), sep="\n")
    if optimized is not None:
        print(optimized, *describe_errors(result, optimized), sep="\n")
    elif command.optimize:
        reason = f"the odometry of {', '.join(unused)} contradicts the scans and is not used"
        print(f"trajectory not corrected: {reason}{'; no cloud or grid is written' if command.output.any else ''}")
    if not result.whole:  # a signal stopped the search
        _print_files(out / PAGE, paths)
        print("run the same command again to continue", file=sys.stderr)
        return stop.exit_status
    if optimized is not None and command.output.any:
        connected = [group == 0 for group, _ in placements(result)]
        for recording, is_connected in zip(recordings, connected, strict=True):
            if not is_connected:
                print(f"{recording.name}: not in the cloud, because it has no common place with {recordings[0].name}")
        command.output.write(
            list(itertools.compress(recordings, connected)),
            list(itertools.compress(result.split(optimized.poses), connected)),
            on_bad_scan=report_bad_scan if command.skip_bad else None,
        )
    delete_checkpoint(checkpoint)
    if command.rerun is not None:
        viewer = Path(sys.executable).with_name("rerun")
        print(f"{command.rerun}: shown by {viewer} {command.rerun}")
    _print_files(out / PAGE, paths)
    if (optimized is not None or not command.optimize) and (next_step := _next_step(effective)):
        print(with_installed_names(f"next: {next_step}"), file=sys.stderr)
    if command.open:
        open_page(out / PAGE)
    return 0


def _print_files(page: Path, paths: "Sequence[Path]") -> None:
    """Print the names of the written files of a folder, and then the path of its page."""
    print(f"{page.parent}: {', '.join(path.name for path in paths if path != page)}\npage: {page}")


def _next_step(command: LoopsCommand) -> str:
    """Return what the user may do after this command, or an empty text."""
    if command.odometry is None:
        return "--odometry auto --optimize computes odometry from the scans and corrects it"
    if not command.optimize:
        return "--optimize corrects the odometry"
    if not command.output.any:
        return "--cloud map.ply --grid map.yaml writes the scans in one frame, along the corrected trajectory"
    first, *others = command.recordings
    if others:
        return ""
    trajectory = command.folder / "trajectory-optimized.tum"
    flags = {"seq": command.source.seq, "poses": trajectory}
    flags |= {"scale": command.scale} if command.scale != 1 else {}
    flags |= {"weights": command.weights} if command.weights != DEFAULT_WEIGHTS else {}
    words = [word for name, value in flags.items() if value for word in (f"--{name}", str(value))]
    return f"{shlex.join(['bin/map', str(first), *words])} makes a map in which bin/relocalize finds scans"
