"""HTML page of the loops within and between recordings: trajectories, rejected pairs, probabilities, matched images."""

from collections.abc import Iterable, Sequence

import numpy as np
from jaxtyping import Float

from sglpr_jax.data.recording import Recording
from sglpr_jax.evaluation import figures
from sglpr_jax.evaluation.page import Picture, Section, Text, figure_picture, missing, render
from sglpr_jax.evaluation.report import TextTable
from sglpr_jax.loops.calibration import reliability_of
from sglpr_jax.loops.closure import MEANING, LoopClosure, RejectedClosure, count_reasons, to_upright
from sglpr_jax.loops.frame_alignment import TrajectorySegment
from sglpr_jax.loops.keyframes import square_image
from sglpr_jax.loops.result import LoopSearchResult, diagnose_no_loops
from sglpr_jax.odometry.path import level_odometry
from sglpr_jax.pose_graph.optimize import OptimizedTrajectory, describe_errors, placements
from sglpr_jax.same_place import NEGATIVE_M
from sglpr_jax.se3 import yaw_of

PAGE = "index.html"
SHOWN_PAIRS = 9
"""Maximum number of loops whose images are shown."""
SHOWN_ROWS = 40
"""Maximum number of rows of the table of loops."""


def loops_page(result: LoopSearchResult, *, optimized: OptimizedTrajectory | None = None) -> str:
    """Return the HTML page of one or several recordings, with `optimized` trajectories before and after correction."""
    if len(result.sessions) == 1:
        title = f"Loops of {result.sessions[0].recording.name}"
        return render(title, _summary(result), _recording_sections(result, optimized))
    names = result.unique_names
    sections = [_transform_section(result, names), *_common_frame_sections(result, names, optimized)]
    for match, query in result.pairs:
        between = result.between(match, query)
        if between.transforms or between.rejected:
            recordings = result.sessions[query].recording, result.sessions[match].recording
            overlays = _overlay_picture(*recordings, between.loops, without_loops="No common place found.")
            blocks = [overlays, *_rejection_blocks(between.rejected)]
            sections.append(Section(f"{names[match]} and {names[query]}", blocks))
    for session, name in enumerate(names):
        within = result.within(session)
        first, *others = _recording_sections(within, None)
        sections.append(Section(f"{name}: {first.title}", [Text(_summary(within)), *first.blocks]))
        sections += [Section(f"{name}: {section.title}", section.blocks) for section in others]
    loops_between = sum(loop.match_session != loop.query_session for loop in result.loops)
    loops_within = len(result.loops) - loops_between
    about = f"{loops_within} loops within and {loops_between} loops between {len(names)} recordings."
    return render(f"Loops of {', '.join(names)}", about, sections)


def _summary(result: LoopSearchResult) -> str:
    """Return the line below the title: the numbers of the result, and whether there is odometry."""
    return f"{result}; {'without' if result.sessions[0].odometry is None else 'with'} odometry."


def _recording_sections(result: LoopSearchResult, optimized: OptimizedTrajectory | None) -> list[Section]:
    """Return the sections about one recording. With an `optimized` trajectory, the first one shows the correction."""
    session = result.sessions[0]
    overlays = _overlay_picture(session.recording, session.recording, result.loops, without_loops="No loops.")
    sections = [
        Section("Why no loops", [Text(reason) for reason in diagnose_no_loops(result)]),
        Section("Trajectory", _trajectory_blocks(result, optimized)),
        Section("Rejected", _rejection_blocks(result.rejected)),
        Section("Loops", [*_time_pictures(result), *_loop_table(result)]),
        Section("Pairs", [overlays]),
        Section("Reliability", _reliability_blocks(result)),
    ]
    return [section for section in sections if section.blocks]


def _trajectory_blocks(result: LoopSearchResult, optimized: OptimizedTrajectory | None) -> list[Picture | Text]:
    """Draw the loops on the trajectory: odometry, also the corrected one, or known positions if there is no odometry.
    Texts above give the size and the error of the correction."""
    session, texts = result.sessions[0], []
    if not session.frames:
        return [missing("No scan was processed.")]
    positions, source = session.recording.positions, session.recording.pose_source
    wrong = _frame_pairs(wrong_loops(result))
    quality = "Long lines are drift, or wrong loops."
    if positions is not None and result.loops:
        wrong_share = f"{len(wrong)} of {len(result.loops)} loops are wrong{' (red)' if wrong else ''}"
        quality = f"{wrong_share}: more than {NEGATIVE_M:g} m apart by {source}."
    trajectories = {} if positions is None else {"positions": positions[: session.frames]}
    if session.odometry is not None:
        uprights, source = session.recording.uprights[: session.frames], "the odometry"
        paths = {"odometry": session.odometry[: session.frames]}
        if optimized is not None:
            texts = [Text(_as_sentence(text)) for text in (str(optimized), *describe_errors(result, optimized))]
            paths["corrected"], source = optimized.poses, "the odometry, and its correction"
        trajectories = {name: level_odometry(poses, uprights)[:, :3, 3] for name, poses in paths.items()}
    if not trajectories:
        return []
    caption = f"The trajectory from {source}. A line connects the two frames of each loop. {quality}"
    not_wrong = [pair for pair in _frame_pairs(result.loops) if pair not in set(wrong)]
    plot = figures.loops(trajectories, not_wrong, wrong=wrong)
    return [*texts, figure_picture(plot, "The loops on the trajectory", caption=caption)]


def _time_pictures(result: LoopSearchResult) -> list[Picture]:
    """Plot the match of each query, also of the rejected pairs."""
    if not result.loops and not result.rejected:
        return []
    wrong = _frame_pairs(wrong_loops(result))
    probabilities = [(loop.query, loop.match, loop.probability) for loop in result.loops]
    rejected = _frame_pairs(rejection.loop for rejection in result.rejected)
    plot = figures.loops_in_time(probabilities, result.sessions[0].frames, wrong=wrong, rejected=rejected)
    caption = "The match of each query. Rejected pairs are grey." if rejected else "The match of each query."
    return [figure_picture(plot, "The loops in time", caption=caption)]


def wrong_loops(result: LoopSearchResult) -> list[LoopClosure]:
    """Return the loops whose true positions are more than 20 m apart, or [] if true positions are not known."""
    return [loop for loop in result.loops if (_true_distance_m(result, loop) or 0) > NEGATIVE_M]


def _true_distance_m(result: LoopSearchResult, loop: LoopClosure) -> float | None:
    """Return the true distance between the two frames of a loop in metres, or None if it is not known."""
    positions = result.sessions[0].recording.positions
    return None if positions is None else float(np.linalg.norm(positions[loop.query] - positions[loop.match]))


def _frame_pairs(loops: Iterable[LoopClosure]) -> list[tuple[int, int]]:
    """Return the frame numbers (query, match) of each loop."""
    return [(loop.query, loop.match) for loop in loops]


def _as_sentence(line: str) -> str:
    """Return a line of a summary with a capital and a full stop."""
    return f"{line[0].upper()}{line[1:]}."


def _reliability_blocks(result: LoopSearchResult) -> list[Picture | Text | TextTable]:
    """Return plot and table of the true share of loops by predicted probability, or a text without true positions."""
    session = result.sessions[0]
    if session.recording.positions is None or result.model is None:
        return [missing("How reliable the probabilities are is not known: the recording has no true poses.")]
    bins = reliability_of(session.candidates, result.model, session.recording.positions)
    if not bins:
        return [missing("No pair was compared.")]
    header = ("probability", "pairs", "loops", "share", "said")
    rows = [
        (f"{b.low:g} to {b.high:g}", f"{b.pairs}", f"{b.loops}", f"{b.share:.3f}", f"{b.probability:.3f}") for b in bins
    ]
    table = TextTable(header, rows, header[1:])
    caption = (
        f"Share of loops among all candidates, before neighbours and odometry are considered. A loop is a pair up to "
        f"10 m apart by {session.recording.pose_source}; pairs 10 to 20 m apart are ignored. Labels: number of pairs."
    )
    plot = figures.reliability([(b.probability, b.share, b.pairs) for b in bins])
    return [figure_picture(plot, "Share of loops over probability", caption=caption), table]


def _overlay_picture(
    query: Recording, match: Recording, loops: Sequence[LoopClosure], *, without_loops: str
) -> Picture | Text:
    """Return the overlaid images of up to 9 loops between two recordings, or the text `without_loops`."""
    if not loops:
        return missing(without_loops)
    images = {}
    for row in np.unique(np.linspace(0, len(loops) - 1, SHOWN_PAIRS).astype(int)):
        loop = loops[row]
        title = f"query {query.numbers[loop.query]}, match {match.numbers[loop.match]}"
        images[title] = overlaid_scans(query, match, loop)
    caption = "Match in green, query in magenta, points of both in white. The pairs are spread over the recording."
    return figure_picture(figures.overlays(images), "Pairs of images", caption=caption)


def overlaid_scans(query: Recording, match: Recording, loop: LoopClosure) -> Float[np.ndarray, "h w 3"]:
    """Overlay the images of the two scans of a loop, each from its recording, as RGB colours (`figures.overlaid`)."""
    upright_loop = to_upright(loop, query=query.mounting_of(loop.query), match=match.mounting_of(loop.match))
    query_image = square_image(query.scan(loop.query, labels=False))
    match_image = square_image(match.scan(loop.match, labels=False))
    return figures.overlaid(query_image, match_image, upright_loop.match_from_query)


def _rejection_blocks(rejected: Sequence[RejectedClosure]) -> list[Text | TextTable]:
    """Return a table of the reasons for which pairs were rejected, with counts and meanings."""
    if not rejected:
        return [missing("No pair was rejected.")]
    rows = [(reason, str(count), MEANING[reason]) for reason, count in count_reasons(rejected).items()]
    about = "Pairs that look like loops but were rejected. They are listed in rejected.jsonl."
    return [Text(about), TextTable(("reason", "pairs", "meaning"), rows, ("pairs",))]


def _loop_table(result: LoopSearchResult) -> list[Text | TextTable]:
    """Return the order of the loops in words and a table of up to 40: wrong loops first, if they are known, then by
    increasing probability."""
    if not result.loops:
        return [missing("No loops.")]
    recording = result.sessions[0].recording
    wrong = set(_frame_pairs(wrong_loops(result)))
    order = f"Sorted{': wrong loops first, then' if wrong else ''} by increasing probability."
    if len(result.loops) > SHOWN_ROWS:
        order += f" The table has {SHOWN_ROWS} of {len(result.loops)} loops. The file loops.csv has all."
    header = ("query", "match", "x [m]", "y [m]", "yaw [deg]", "probability", "overlap")
    if recording.positions is not None:
        header += ("true distance [m]",)
    rows = []
    for loop in sorted(result.loops, key=lambda loop: ((loop.query, loop.match) not in wrong, loop.probability)):
        x, y = loop.match_from_query[:2, 3]
        true_distance_m = _true_distance_m(result, loop)
        cells = (
            recording.ids[loop.query],
            recording.ids[loop.match],
            f"{x:.2f}",
            f"{y:.2f}",
            f"{np.degrees(loop.yaw):.1f}",
            f"{loop.probability:.4f}",
            "" if loop.overlap is None else f"{loop.overlap:.2f}",
        )
        rows.append(cells if true_distance_m is None else (*cells, f"{true_distance_m:.1f}"))
    return [Text(order, "about"), TextTable(header, rows[:SHOWN_ROWS], header[2:])]


def _transform_section(result: LoopSearchResult, names: list[str]) -> Section:
    """Return a table of the transforms between each two recordings. `names` are those of the recordings."""
    header = ("match", "query", "loops", "x [m]", "y [m]", "z [m]", "yaw [deg]", "+- [m]", "+- [deg]")
    rows = []
    for match, query in result.pairs:
        transforms = result.between(match, query).transforms
        for transform in transforms:
            frames = (_frame_name(transform.match, names[match]), _frame_name(transform.query, names[query]))
            pose = transform.match_from_query
            sigma = np.sqrt(np.diag(transform.covariance))  # x, y, z in metres; roll, pitch, yaw in radians
            numbers = (*pose[:3, 3], np.degrees(yaw_of(pose)), np.hypot(*sigma[:2]), np.degrees(sigma[5]))
            rows.append((*frames, f"{transform.loops}", *(f"{number:.2f}" for number in numbers)))
        if not transforms:
            rows.append((names[match], names[query], "no common place found", *[""] * (len(header) - 3)))
    meaning = (
        "Pose of the query recording's frame in the match recording's frame, with standard deviations of position in "
        "the plane and yaw. All numbers are in frames.json."
    )
    return Section("Transforms", [Text(meaning), TextTable(header, rows, header[2:])])


def _frame_name(segment: TrajectorySegment, name: str) -> str:
    """Return the coordinate frame of a part of a recording in words, given the recording's name."""
    return name if segment.is_odometry else f"{name}, from the LiDAR at scan {segment.first} to scan {segment.last}"


def _common_frame_sections(
    result: LoopSearchResult, names: list[str], optimized: OptimizedTrajectory | None
) -> list[Section]:
    """Draw each group of recordings with common places in one coordinate frame, if all recordings have odometry."""
    if any(session.odometry is None for session in result.sessions):
        return []
    groups = placements(result)  # of each recording: the first recording of its group, and the transform to its frame
    pictures = []
    for first in dict.fromkeys(group for group, _ in groups):
        positions = {}  # of the frames of each recording in the group
        for session, (group, group_from_odom) in enumerate(groups):
            odometry = result.sessions[session].odometry
            if group == first and odometry is not None:
                poses = group_from_odom @ odometry[: result.sessions[session].frames]
                poses = poses if optimized is None else result.split(optimized.poses)[session]
                positions[session] = poses[:, :3, 3]
        if len(positions) < 2:
            continue
        pairs = [
            (positions[loop.query_session][loop.query], positions[loop.match_session][loop.match])
            for loop in result.loops
            if loop.match_session != loop.query_session and {loop.match_session, loop.query_session} <= set(positions)
        ]
        caption = f"The odometry in the frame of {names[first]}. A line connects the two scans of each loop."
        caption = caption if optimized is None else f"{_as_sentence(str(optimized))} Frame of {names[first]}."
        plot = figures.loops_between({names[session]: path for session, path in positions.items()}, pairs)
        pictures.append(figure_picture(plot, "Trajectories in one frame", caption=caption))
    return [Section("Together", pictures)] if pictures else []
