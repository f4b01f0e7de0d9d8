"""Comparisons on the leaderboard: with SG-LPR, with baselines, of labels, and with published orders."""

import itertools
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

from benchmarks.learned.cells import (
    LABELLED,
    SIMULATED,
    TOWN,
    TRAINED_TOWN,
    Column,
    Scores,
    both,
    finals,
    images_of,
    mean,
    method_of,
    number,
    section,
    text,
)
from sglpr_jax.evaluation.published import TABLE_1

OURS = "sglpr-0"
"""The run that the peers are compared with."""
SG_LPR = "sglpr"
"""Beginning of the names of our network and its variants."""
AHEAD = 0.005
"""Difference of two scores from which a contender is ahead."""
NEARLY = 1.5
"""Largest ratio of two numbers of images that are compared."""
FAR = 0.1
"""Difference by which a trained network is far above a baseline."""
REVERSED = 0.02
"""Difference from which two means are in an order."""
PUBLISHED_NAMES = {
    "m2dp": "M2DP",
    "scan-context": "Scan Context",
    "lidar-iris": "LiDAR Iris",
    "ssc": "SSC",
    "pointnetvlad-0": "PointNetVLAD",
    "overlap-transformer-0": "OverlapTransformer",
    "disco-0": "DiSCO",
    "sgpr-0": "SGPR",
    "rinet-0": "RINet",
    "paper-112-0": "SG-LPR",
}
"""Contenders that are rows of the paper's table 1."""
LABELS = {
    "rinet-0": "true",
    "rinet-0/weights-1024000": "true",
    "rinet-0, predicted labels": "predicted",
    "rinet-0, no labels": "one for all points",
    "sgpr-0": "true",
    "sgpr-0, predicted labels": "predicted",
    "sgpr-0, no labels": "one for all points",
    "sglpr-0": "true, while training",
    "sglpr-0/weights-16000": "true, while training",
    "sglpr-no-labels-0": "none",
}
"""Contenders, and the labels that they have."""


def ours_and_peers(scores: Mapping[str, Scores]) -> Iterator[str]:
    """Yield the tables of each peer beside our network at equal times and at equal numbers of images."""
    if OURS not in scores:
        return
    finished = [name for name in finals(scores) if images_of(scores[name]) and not name.startswith(SG_LPR)]
    yield _beside_ours(
        scores,
        [(name, OURS) for name in finished],
        f"""## After the training

Recall@1 of each network / of `{OURS}`, both after their training. RINet and SGPR have the true label of each point.
""",
    )
    yield _beside_ours(
        scores,
        [pair for name in finished if (pair := _equal_images(scores, name))],
        f"""## At equal numbers of images

Recall@1 of each network / of `{OURS}` after at most as many images. An image counts each time that it is used.
""",
    )


def _equal_images(scores: Mapping[str, Scores], name: str) -> tuple[str, str] | None:
    """Return weights of a run and of ours with nearly the same number of images, the last such pair."""
    theirs = [one for one in scores if one == name or one.startswith(f"{name}/")]
    ours = [one for one in scores if one == OURS or one.startswith(f"{OURS}/")]
    pairs = [(images_of(scores[b]), a, b) for a in theirs for b in ours if _near(scores[a], scores[b])]
    return max(pairs)[1:] if pairs else None


def _near(theirs: Scores, ours: Scores) -> bool:
    return 0 < images_of(ours) <= images_of(theirs) <= NEARLY * images_of(ours)


def _beside_ours(scores: Mapping[str, Scores], pairs: Sequence[tuple[str, str]], about: str) -> str:
    rows, ahead = [], []
    for name, own in pairs:
        theirs, ours = scores[name], scores[own]
        cells = [(column, mean(theirs, column, "recall"), mean(ours, column, "recall")) for column in SIMULATED]
        titles = [column.title for column, a, b in cells if a and b and a >= b + AHEAD]
        ahead += [f"`{name}` ({'all columns' if len(titles) == len(cells) else '; '.join(titles)})"] if titles else []
        counts = (f"{images_of(one):,}" for one in (theirs, ours))
        rows.append([f"`{name}`", *counts, *(both(a, b) for _, a, b in cells)])
    head = ["", "its images", f"images of `{OURS}`", *(column.title for column in SIMULATED)]
    return section(f"{about}Ahead of `{OURS}` by {AHEAD} or more: {', '.join(ahead) or 'none'}.\n", head, rows)


def baselines(scores: Mapping[str, Scores]) -> str:
    """Return the table of each network beside its untrained self and the thumbnail, and who is not far above both."""
    rows, near = [], []
    for name in finals(scores):
        untrained = scores.get(f"{method_of(name)}@random:0", {})
        recall = mean(scores[name], TOWN, "recall")
        if not images_of(scores[name]) or recall is None:
            continue
        against = [mean(one, TOWN, "recall") for one in (untrained, scores.get("thumbnail", {}))]
        near += [f"`{name}`"] if any(one is not None and recall < one + FAR for one in against) else []
        directions = [Column("", (test,)) for test in (*TOWN.tests, *TRAINED_TOWN)]
        cells = (both(*(mean(one, column, "recall") for one in (scores[name], untrained))) for column in directions)
        rows.append([f"`{name}`", text(recall), *map(text, against), *cells])
    about = f"""## Beside untrained networks and the thumbnail

Recall@1 in the unseen town. Then trained / untrained, for revisits in the same and in the opposite direction, in this
town and in a town of the training.
Not above both baselines by {FAR} or more: {", ".join(near) or "none"}.

* `overlap-transformer-0`: one hour did not improve Recall@1, not even in a town of its training. Its search preferred
  the published learning rate, 5e-6, to a higher one. The published training takes 100 epochs of KITTI.
* `pointnetvlad-0`: in a town of its training, only revisits in the same direction gained. It found no revisit in the
  opposite direction there, although the training rotates the scans. The published training takes 20 epochs of Oxford.
* `sgpr-0`: it is far above its untrained self, but not above the thumbnail. The published training takes 500 epochs of
  KITTI.
* `paper-112-0`: its training is far from finished. The preset `paper-112` trains with 2,400,000 images, for which one
  core would need three weeks.
"""
    head = [
        "",
        "trained",
        "untrained",
        "thumbnail",
        "same direction",
        "opposite direction",
        "training town, same",
        "training town, opposite",
    ]
    return section(about, head, rows)


def labels(scores: Mapping[str, Scores]) -> str:
    """Return the table of what labels are worth."""
    rows = [
        [
            f"`{name.split(',')[0].split('/')[0]}`",
            kind,
            number(images_of(scores[name])),
            *(text(mean(scores[name], column, "recall")) for column in LABELLED),
        ]
        for name, kind in LABELS.items()
        if name in scores
    ]
    about = """## What labels are worth

Recall@1. RINet and SGPR need a label for each point. Each row was trained and tested with one kind: the true label,
the label that the shipped `sglpr` predicts within 25 m of the sensor, or the label *building* for all points. `sglpr-0`
needs labels only while training, for its segmentation head. Compare rows with equal numbers of images.

RINet needs its labels: with one label for all points, it is hardly better than untrained. With predicted labels it
loses a twentieth in the town and a fifth in other sceneries. `sglpr` with its segmentation head is ahead of `sglpr`
without it in the town and behind elsewhere, with one seed.
"""
    return section(about, ["", "labels", "images seen", *(column.title for column in LABELLED)], rows)


def published_orders(scores: Mapping[str, Scores]) -> str:
    """Return the published orders of two methods that are reversed here."""
    known = [(name, _row(title)) for name, title in PUBLISHED_NAMES.items() if name in scores]
    pairs, rows = 0, []
    for (name, row), (other, against) in itertools.permutations(known, 2):
        score = "pairs" if row.f1max_protocol == "pairs-f1max" else "top1"
        here, there = mean(scores[name], TOWN, score), mean(scores[other], TOWN, score)
        if row.f1max_protocol != against.f1max_protocol or here is None or there is None:
            continue
        if row.mean >= against.mean + REVERSED:
            pairs += 1
            if here <= there - REVERSED:
                rows.append([f"{row.method}, {against.method}", both(row.mean, against.mean), both(here, there)])
    about = f"""## Published orders and these trainings

F1max of two methods, the mean of their rows in table 1 of the SG-LPR paper, beside F1max by the same protocol in the
unseen town. SG-LPR is `paper-112-0`, whose training is far from finished: its rows do not contradict the paper.
Of {pairs} pairs that differ by {REVERSED} or more in the paper, these are in the opposite order here:
"""
    return section(about, ["", "published", "here"], rows)


def _row(title: str) -> Any:
    return next(row for row in TABLE_1.rows if row.method == title)
