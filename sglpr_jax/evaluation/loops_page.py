"""HTML page of the loops within and between recordings: trajectories, matched images, probabilities, rejected pairs."""

from collections.abc import Iterable, Sequence

import numpy as np
from jaxtyping import Float

from sglpr_jax.data.recording import Recording
from sglpr_jax.evaluation import figures
from sglpr_jax.evaluation.page import Picture, Section, Text, figure_picture, missing, render
from sglpr_jax.evaluation.report import TextTable
from sglpr_jax.loops.calibration import reliability_of
from sglpr_jax.loops.closure import MEANING, LoopClosure, RejectedClosure, count_reasons, to_upright
from sglpr_jax.loops.keyframes import square_image
from sglpr_jax.loops.result import LoopSearchResult, diagnose_no_loops
from sglpr_jax.odometry.path import level_odometry
from sglpr_jax.pose_graph.folder import unique_names
from sglpr_jax.pose_graph.optimize import OptimizedTrajectory, placements, trajectory_error
from sglpr_jax.same_place import NEGATIVE_M
from sglpr_jax.se3 import yaw_of

PAGE = "index.html"
SHOWN_PAIRS = 9
SHOWN_ROWS = 40
NO_MATPLOTLIB = missing("The pictures need matplotlib: pip install 'sglpr-jax[viz]'.")


def loops_page(result: LoopSearchResult, *, optimized: OptimizedTrajectory | None = None) -> str:
    """Return the page of one or several recordings as self-contained HTML.

    With `optimized` trajectories it shows them before and after the correction.
    """
    if len(result.sessions) == 1:
        title = f"Loops of {result.sessions[0].recording.name}"
        return render(title, _about(result), _recording_sections(result, optimized))
    names = unique_names(result)
    sections = [_transforms(result, names), *_common_frames(result, names, optimized)]
    for match, query in result.pairs:
        pair = result.between(match, query)
        if pair.transforms or pair.rejected:
            recordings = result.sessions[query].recording, result.sessions[match].recording
            blocks = [_pairs(*recordings, pair.loops, nothing="No common place found."), *_reasons(pair.rejected)]
            sections.append(Section(f"{names[match]} and {names[query]}", blocks))
    for number, name in enumerate(names):
        within = result.within(number)
        first, *others = _recording_sections(within, None)
        sections.append(Section(f"{name}: {first.title}", [Text(_about(within)), *first.blocks]))
        sections += [Section(f"{name}: {section.title}", section.blocks) for section in others]
    between = sum(loop.match_session != loop.query_session for loop in result.loops)
    about = f"{len(result.loops) - between} loops within and {between} loops between {len(names)} recordings."
    return render(f"Loops of {', '.join(names)}", about, sections)


def _about(result: LoopSearchResult) -> str:
    return f"{result}; {'with odometry' if result.sessions[0].odometry is not None else 'without odometry'}."


def _recording_sections(result: LoopSearchResult, optimized: OptimizedTrajectory | None) -> list[Section]:
    """Sections of one recording. With an `optimized` trajectory there is one about the correction."""
    session = result.sessions[0]
    reasons = diagnose_no_loops(result)
    return [
        *([Section("Why no loops", [Text(reason) for reason in reasons])] if reasons else []),
        Section("Trajectory", _trajectory(result)),
        *([Section("Corrected", [_corrected(result, optimized)])] if optimized is not None and session.frames else []),
        Section("Pairs", [_pairs(session.recording, session.recording, result.loops, nothing="No loops.")]),
        Section("Loops", [_table(result)]),
        Section("Rejected", _reasons(result.rejected)),
        Section("Reliability", _reliability(result)),
    ]


def _trajectory(result: LoopSearchResult) -> list[Picture | Text]:
    """Draw the loops on the trajectory, if positions are known, and the match of each query."""
    session = result.sessions[0]
    if not figures.can_draw():
        return [NO_MATPLOTLIB]
    if not session.frames:
        return [missing("No scan was processed.")]
    positions, source = session.recording.positions, session.recording.pose_source
    wrong, quality = _frames(wrong_loops(result)), "Long lines are drift, or wrong loops."
    if positions is not None and result.loops:
        share = f"{len(wrong)} of {len(result.loops)} loops are wrong{' (red)' if wrong else ''}"
        quality = f"{share}: more than {NEGATIVE_M:g} m apart by {source}."
    if session.odometry is not None:
        positions, source = level_odometry(session.odometry, session.recording.uprights)[:, :3, 3], "the odometry"
    pictures = []
    if positions is not None:
        caption = f"The trajectory from {source}. A line connects the two frames of each loop. {quality}"
        right = [pair for pair in _frames(result.loops) if pair not in set(wrong)]
        plot = figures.loops(positions[: session.frames], right, wrong=wrong)
        pictures.append(figure_picture(plot, "The loops on the trajectory", caption=caption))
    probabilities = [(loop.query, loop.match, loop.probability) for loop in result.loops]
    rejected = _frames(rejection.loop for rejection in result.rejected)
    plot = figures.loops_in_time(probabilities, session.frames, wrong=wrong, rejected=rejected)
    caption = "The match of each query. Rejected pairs are grey." if rejected else "The match of each query."
    return [*pictures, figure_picture(plot, "The loops in time", caption=caption)]


def wrong_loops(result: LoopSearchResult) -> list[LoopClosure]:
    """Return loops whose true positions are more than 20 m apart. Empty if true positions are not known."""
    return [loop for loop in result.loops if (_true_distance_m(result, loop) or 0) > NEGATIVE_M]


def _true_distance_m(result: LoopSearchResult, loop: LoopClosure) -> float | None:
    """Return the true distance between the two frames of a loop in metres, or None if it is not known."""
    positions = result.sessions[0].recording.positions
    return None if positions is None else float(np.linalg.norm(positions[loop.query] - positions[loop.match]))


def _frames(loops: Iterable[LoopClosure]) -> list[tuple[int, int]]:
    return [(loop.query, loop.match) for loop in loops]


def _corrected(result: LoopSearchResult, optimized: OptimizedTrajectory) -> Picture | Text:
    """Draw the trajectory before and after the correction. If true positions are known, the caption has both errors."""
    session = result.sessions[0]
    assert session.odometry is not None
    trajectories = {"odometry": session.odometry[: session.frames], "optimized": optimized.poses}
    caption = _sentence(optimized)
    truth = session.recording.positions
    if truth is not None and session.frames > 2:
        errors_m = {name: trajectory_error(poses, truth[: session.frames]) for name, poses in trajectories.items()}
        errors = ", ".join(f"{name} {error:.2f} m" for name, error in errors_m.items())
        caption += f" Position error (RMSE after alignment with {session.recording.pose_source}): {errors}."
    if not figures.can_draw():
        return missing(caption)
    upright = session.recording.uprights[: session.frames]
    level = {name: level_odometry(poses, upright)[:, :3, 3] for name, poses in trajectories.items()}
    return figure_picture(figures.trajectories(level), "The trajectory before and after", caption=caption)


def _sentence(optimized: OptimizedTrajectory) -> str:
    words = str(optimized)
    return f"{words[0].upper()}{words[1:]}."


def _reliability(result: LoopSearchResult) -> list[Picture | Text | TextTable]:
    """Plot and table of the share of loops over the predicted probability, if true positions are known."""
    session = result.sessions[0]
    if session.recording.positions is None or result.model is None:
        return [missing("The share of loops among the pairs is not known: the recording has no poses.")]
    bins = reliability_of(session.candidates, result.model, session.recording.positions)
    if not bins:
        return [missing("No pair was compared.")]
    header = ("probability", "pairs", "loops", "share", "said")
    rows = [
        (f"{b.low:g} to {b.high:g}", f"{b.pairs}", f"{b.loops}", f"{b.share:.3f}", f"{b.probability:.3f}") for b in bins
    ]
    table = TextTable(header, rows, header[1:])
    if not figures.can_draw():
        return [table]
    caption = (
        f"Share of loops among all candidates, before neighbours and odometry are considered. A loop is a pair up to "
        f"10 m apart by {session.recording.pose_source}; pairs 10 to 20 m apart are ignored. Labels: number of pairs."
    )
    plot = figures.reliability([(b.probability, b.share, b.pairs) for b in bins])
    return [figure_picture(plot, "Share of loops over probability", caption=caption), table]


def _pairs(query: Recording, match: Recording, loops: Sequence[LoopClosure], *, nothing: str) -> Picture | Text:
    """Images of some loops, laid over each other. `nothing` is the text without loops."""
    if not loops:
        return missing(nothing)
    if not figures.can_draw():
        return NO_MATPLOTLIB
    rows = np.unique(np.linspace(0, len(loops) - 1, SHOWN_PAIRS).astype(int))
    images = {
        f"query {query.numbers[loop.query]}, match {match.numbers[loop.match]}": overlay_of(query, match, loop)
        for loop in (loops[row] for row in rows)
    }
    caption = "Match in red, query in cyan; cells with points of both are white. Pairs are spread over the recording."
    return figure_picture(figures.overlays(images), "Pairs of images", caption=caption)


def overlay_of(query: Recording, match: Recording, loop: LoopClosure) -> Float[np.ndarray, "h w 3"]:
    """Overlay the images of the two scans of a loop, as RGB colours from 0 to 1 (`figures.overlaid`)."""
    level = to_upright(loop, query=query.mounting_of(loop.query), match=match.mounting_of(loop.match))
    images = (
        square_image(query.scan(loop.query, labels=False)),
        square_image(match.scan(loop.match, labels=False)),
    )
    return figures.overlaid(*images, level.match_from_query)


def _reasons(rejected: Sequence[RejectedClosure]) -> list[Text | TextTable]:
    """Table of the reasons for rejections, with counts."""
    if not rejected:
        return [missing("No pair was rejected.")]
    rows = [(reason, str(count), MEANING[reason]) for reason, count in count_reasons(rejected).items()]
    about = "Pairs that look like loops but were rejected. They are listed in rejected.jsonl."
    return [Text(about), TextTable(("reason", "pairs", "meaning"), rows, ("pairs",))]


def _table(result: LoopSearchResult) -> Text | TextTable:
    """Table of the wrong loops, if known, and of the loops with the lowest probabilities."""
    if not result.loops:
        return missing("No loops.")
    recording, wrong = result.sessions[0].recording, set(_frames(wrong_loops(result)))
    header = ("query", "match", "x [m]", "y [m]", "yaw [deg]", "probability", "overlap")
    header += () if recording.positions is None else ("true distance [m]",)
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
    return TextTable(header, rows[:SHOWN_ROWS], header[2:])


def _transforms(result: LoopSearchResult, names: list[str]) -> Section:
    """Table of the transforms between the recordings."""
    header = ("match", "query", "loops", "x [m]", "y [m]", "z [m]", "yaw [deg]", "+- [m]", "+- [deg]")
    rows = []
    for pair in result.pairs:
        transforms = result.between(*pair).transforms
        for aligned in transforms:
            frames = (
                names[session]
                if segment.is_odometry
                else f"{names[session]}, from the LiDAR at scan {segment.first} to scan {segment.last}"
                for session, segment in zip(pair, (aligned.match, aligned.query), strict=True)
            )
            pose, sigma = aligned.match_from_query, np.sqrt(np.diag(aligned.covariance))
            values = (*pose[:3, 3], np.degrees(yaw_of(pose)), np.hypot(*sigma[:2]), np.degrees(sigma[5]))
            rows.append((*frames, f"{aligned.loops}", *(f"{value:.2f}" for value in values)))
        if not transforms:
            rows.append((*(names[session] for session in pair), "no common place found", *[""] * 6))
    meaning = (
        "Pose of the query recording's frame in the match recording's frame, with standard deviations of position in "
        "the plane and yaw. All numbers are in frames.json."
    )
    return Section("Transforms", [Text(meaning), TextTable(header, rows, header[2:])])


def _common_frames(result: LoopSearchResult, names: list[str], optimized: OptimizedTrajectory | None) -> list[Section]:
    """Section with the trajectories of each group of recordings with a common place, if there is odometry."""
    groups = placements(result)
    if not figures.can_draw() or any(session.odometry is None for session in result.sessions):
        return []
    pictures = []
    for group in dict.fromkeys(group for group, _ in groups):
        positions = {}
        for number, ((other, group_from_odom), session) in enumerate(zip(groups, result.sessions, strict=True)):
            if other == group and session.odometry is not None:
                poses = group_from_odom @ session.odometry[: session.frames]
                positions[number] = (poses if optimized is None else result.split(optimized.poses)[number])[:, :3, 3]
        if len(positions) < 2:
            continue
        pairs = [
            (positions[loop.query_session][loop.query], positions[loop.match_session][loop.match])
            for loop in result.loops
            if loop.match_session != loop.query_session and {loop.match_session, loop.query_session} <= set(positions)
        ]
        caption = f"The odometry in the frame of {names[group]}. A line connects the two scans of each loop."
        caption = caption if optimized is None else f"{_sentence(optimized)} Frame of {names[group]}."
        plot = figures.loops_between({names[number]: path for number, path in positions.items()}, pairs)
        pictures.append(figure_picture(plot, "Trajectories in one frame", caption=caption))
    return [Section("Together", pictures)] if pictures else []
