"""Result of a loop search: sessions, loops within and between them, rejected pairs, and transforms of their frames."""

import dataclasses
import itertools
from collections.abc import Iterable

import numpy as np
from jaxtyping import Float

from sglpr_jax.data.choices import Scale
from sglpr_jax.data.mounting import upright_from_lidar
from sglpr_jax.data.recording import Recording
from sglpr_jax.loops.closure import DEGENERATE_M, MEANING, LoopClosure, RejectedClosure, convert_rejected, count_reasons
from sglpr_jax.loops.comparison import Candidate
from sglpr_jax.loops.config import MIN_CELLS, DetectorConfig
from sglpr_jax.loops.frame_alignment import SegmentAlignment
from sglpr_jax.loops.probability import LoopModel
from sglpr_jax.odometry.drift_model import DriftModel
from sglpr_jax.se3 import travelled


@dataclasses.dataclass(frozen=True, eq=False)
class Session:
    """A searched recording."""

    recording: Recording
    frames: int
    """Number of scans that were searched: all, unless the search was stopped."""
    odometry: Float[np.ndarray, "n 4 4"] | None = None
    """Pose of the LiDAR at every scan of the recording."""
    drift: DriftModel = DriftModel()
    """Drift of the odometry, estimated from the drive."""
    skipped: tuple[str, ...] = ()
    """Ids of scans that cannot be read."""
    keyframes: int = 0
    """Number of scans that were compared or cannot be read. The others are near one of these."""
    empty: int = 0
    """Number of keyframes that are almost empty."""
    unregistered: int = 0
    """Number of loops within the session that were not registered because the search was stopped."""
    candidates: tuple[Candidate, ...] = ()
    """All compared pairs or, with `max_places`, that many of the last ones. Lengths are multiplied by the scale."""


@dataclasses.dataclass(frozen=True, eq=False)
class LoopSearchResult:
    """Loops within and between sessions."""

    sessions: tuple[Session, ...]
    loops: tuple[LoopClosure, ...] = ()
    """Loops within each session, then those between each pair of sessions."""
    rejected: tuple[RejectedClosure, ...] = ()
    """Rejected pairs, with reasons. Left out are other pairs of the query of a loop, and improbable pairs that the
    motion excludes."""
    transforms: tuple[SegmentAlignment, ...] = ()
    """Transforms between the frames of sessions: for each pair, one for each accepted pair of segments, that with most
    loops first. If both sessions have odometry, there is at most one."""
    model: LoopModel | None = None
    """Model of the probabilities."""
    config: DetectorConfig = DetectorConfig()
    """Settings of the search."""
    scale: Scale = 1
    """Factor for all lengths during the search. The results are in metres."""
    stopped: bool = False
    """Whether the search between sessions was stopped before its end."""

    @property
    def whole(self) -> bool:
        """Whether the search was completed, with the registration of all loops."""
        is_whole = (session.frames == len(session.recording) and not session.unregistered for session in self.sessions)
        return not self.stopped and all(is_whole)

    def split(self, poses: Float[np.ndarray, "n 4 4"]) -> list[Float[np.ndarray, "_ 4 4"]]:
        """Divide the poses of all searched frames by session."""
        return np.split(poses, np.cumsum([session.frames for session in self.sessions])[:-1])

    @property
    def unique_names(self) -> list[str]:
        """Name of each session's recording. A repeated name gets the suffix ~2, ~3 and so on."""
        names: list[str] = []
        for session in self.sessions:
            name, number = session.recording.name, 2
            while name in names:
                name, number = f"{session.recording.name}~{number}", number + 1
            names.append(name)
        return names

    @property
    def pairs(self) -> list[tuple[int, int]]:
        """All pairs of sessions, by number: first the session of the matches, then that of the queries."""
        return list(itertools.combinations(range(len(self.sessions)), 2))

    def between(self, match: int, query: int) -> "LoopSearchResult":
        """Results with matches in one session and queries in another one, by number. Both may be the same session."""
        pair = match, query
        return dataclasses.replace(
            self,
            loops=tuple(loop for loop in self.loops if _sessions_of(loop) == pair),
            rejected=tuple(closure for closure in self.rejected if _sessions_of(closure.loop) == pair),
            transforms=tuple(
                transform for transform in self.transforms if (transform.match.session, transform.query.session) == pair
            ),
        )

    def within(self, session: int) -> "LoopSearchResult":
        """Results of one session, as if it had been searched alone: its number becomes 0."""

        def in_session_0(loop: LoopClosure) -> LoopClosure:
            return dataclasses.replace(loop, match_session=0, query_session=0)

        result = self.between(session, session)
        return dataclasses.replace(
            result,
            sessions=(self.sessions[session],),
            loops=tuple(map(in_session_0, result.loops)),
            rejected=tuple(convert_rejected(result.rejected, in_session_0)),
        )

    def is_degenerate(self, loop: LoopClosure) -> bool:
        """Whether the position of a loop is uncertain by more than `DEGENERATE_M` in some horizontal direction."""
        mounting = self.sessions[loop.query_session].recording.mounting_of(loop.query)
        horizontal = upright_from_lidar(mounting)[:2, :3]  # the two horizontal axes in the LiDAR frame
        return bool(np.linalg.eigvalsh(horizontal @ loop.covariance[:3, :3] @ horizontal.T)[-1] > DEGENERATE_M**2)

    def without_degenerate(self) -> "LoopSearchResult":
        """Reject the degenerate loops. Transforms stay, because their estimation weighs loops by their covariance."""
        loops = tuple(loop for loop in self.loops if not self.is_degenerate(loop))
        degenerate = [RejectedClosure(loop, "degenerate") for loop in self.loops if self.is_degenerate(loop)]
        rejected = ordered_rejections([*self.rejected, *degenerate])
        return dataclasses.replace(self, loops=loops, rejected=tuple(rejected))

    def __str__(self) -> str:
        """One line for each session, then one for each pair of sessions."""
        lines = [self.within(number)._describe_session() for number in range(len(self.sessions))]
        lines += [self.between(match, query)._describe_pair(match, query) for match, query in self.pairs]
        return "\n".join(lines)

    def _describe_session(self) -> str:
        """Describe the loops of a result with one session."""
        session = self.sessions[0]
        degenerate = sum(map(self.is_degenerate, self.loops))
        loops = f"{len(self.loops)} loops{f' ({degenerate} degenerate)' if degenerate else ''}"
        scans = f"{session.frames} of {len(session.recording)} frames of {session.recording.name}"
        text = f"{loops} in {scans}{f' ({session.keyframes} keyframes)' if session.keyframes < session.frames else ''}"
        skipped = f", {len(session.skipped)} scans skipped" if session.skipped else ""
        unregistered = f", {session.unregistered} not registered" if session.unregistered else ""
        scale = f", scale {self.scale}" if self.scale != 1 else ""
        return f"{text}, {len(self.rejected)} rejected{self._reason_counts()}{unregistered}{skipped}{scale}"

    def _describe_pair(self, match: int, query: int) -> str:
        """Describe the loops between two sessions, which must be those of `between`."""
        names = f"{self.unique_names[match]} and {self.unique_names[query]}"
        if not self.transforms:
            return f"{names}: no common place found{self._reason_counts()}"
        transforms = "; ".join(map(str, self.transforms))
        return f"{names}: {len(self.loops)} loops, {len(self.rejected)} rejected{self._reason_counts()}; {transforms}"

    def _reason_counts(self) -> str:
        """Numbers of rejected pairs by reason, in brackets, or an empty text."""
        counts = (f"{reason}: {count}" for reason, count in count_reasons(self.rejected).items())
        return f" ({', '.join(counts)})" if self.rejected else ""


def _sessions_of(loop: LoopClosure) -> tuple[int, int]:
    """Numbers of the sessions of match and query."""
    return loop.match_session, loop.query_session


def ordered_rejections(rejected: Iterable[RejectedClosure]) -> list[RejectedClosure]:
    """Sort rejected pairs: those within the sessions, then those between them, in the order of their frames."""

    def order(closure: RejectedClosure) -> tuple[bool, tuple[int, int], int, int]:
        match, query = _sessions_of(closure.loop)
        return match != query, (match, query), closure.loop.query, closure.loop.match

    return sorted(rejected, key=order)


def diagnose_no_loops(result: LoopSearchResult) -> list[str]:
    """Explain why sessions have no loops, one sentence for each reason, with the name of its session if several."""
    if len(result.sessions) != 1:
        sentences = []
        for number, name in enumerate(result.unique_names):
            sentences += [f"{name}: {line}" for line in diagnose_no_loops(result.within(number))]
        return sentences
    if result.loops:
        return []
    session = result.sessions[0]
    if not session.frames:
        return ["The search was stopped before the first scan."]
    reasons, scans = [], len(session.recording)
    if session.frames < scans:
        reasons.append(f"The search was stopped after {session.frames} of {scans} frames.")
    if 2 * session.empty > session.keyframes:
        reasons.append(
            f"{session.empty} of {session.keyframes} scans are almost empty (fewer than {MIN_CELLS} occupied cells of "
            "the image): check the format and the range of the points, and whether the sensor was covered."
        )
    if 2 * len(session.skipped) > session.keyframes:
        reasons.append(f"{len(session.skipped)} of {session.keyframes} scans cannot be read.")
    if result.rejected:
        reason, count = next(iter(count_reasons(result.rejected).items()))  # the most frequent one
        return [*reasons, f"{len(result.rejected)} pairs were rejected. For {count} of them: {MEANING[reason]}"]
    source = "images"
    if session.odometry is not None:  # a length that contradicts the drive shows wrong odometry
        source = f"odometry, which is {travelled(session.odometry[: session.frames])[-1]:.1f} m long"
    return [
        *reasons,
        f"No pair was possible: according to the {source}, no scan came back to a place after at least "
        f"{result.config.candidates.recent_m / result.scale:g} m of travelled distance.",
    ]
