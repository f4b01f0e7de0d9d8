"""The text of the page that compares all contenders."""

from collections.abc import Mapping
from typing import Any

from benchmarks.learned.conclusions import baselines, labels, ours_and_peers, published_orders
from benchmarks.learned.tables import along_trainings, costs, kitti, published_recall, simulated, summary

HEAD = """# Leaderboard

The runs `NAME-0` were trained on the same simulated recordings, from random weights, with seed 0. Each had one hour on
one core, while the second core was busy too. The learning rate is the best of three short trainings.
These trainings differ:

* `paper-112-0`, SG-LPR as printed, had 9,000 s, a first stage without rotations, and the learning rate 4e-4, with which
  an earlier training learned.
* `bevplace++-0` has the learning rate of `resnet34-netvlad-0`, 3e-4. This is the same network with one rotation.
* `sgpr-0` has the learning rate 3e-4. The scores of its three short trainings were all below 0.07, and 3e-4 had the
  lowest loss.
* `sglpr-no-labels-0` has no segmentation head, the learning rate of `sglpr-0`, and only 16,000 images.

Final weights are scored, also where an earlier snapshot was better. Other rows:

* `sglpr` and `circular` are the shipped weights, which were trained longer and on more towns. KITTI 00, 02 and 06
  influenced their design. `sglpr-0` has the network of `sglpr` and the training of the others.
* `NAME@random:0` are untrained networks.
* `scan-context` and `thumbnail` are [handcrafted methods](guides/methods.md). The thumbnail (25 × 25 block means) fails
  under rotation and shows how difficult a recording is.

`python -m benchmarks.learned.leaderboard` writes this page from `benchmarks/learned/results.json`. The
[guide](guides/peers.md#all-methods-on-equal-terms) has the commands. A dash means: not measured.

![Recall@1 against images seen, and against milliseconds](images/leaderboard.svg)

## Recordings

Neither weights nor learning rates were chosen on these recordings.

* *Town*: an unseen town, the mean of two recordings, with revisits in the same and in the opposite direction.
* *Other sceneries*: outskirts, lanes and a car park, with revisits in the opposite direction.
* *Other sensors*: a town seen by a VLP-16 and an OS1-64, with revisits in the opposite direction.
* *Another day*: a second session in the map of a first one.
* *Rotated*: every scan is rotated by a random yaw.
* *KITTI*: the mean of 00, 02 and 06, as ready-made images.

The tables along the training use another town, the held-out town, on which the learning rates were chosen.
"""


def page_of(results: Mapping[str, Any]) -> str:
    """Return the page of kept results."""
    scores, runs, measured = results["scores"], results["runs"], results["costs"]
    parts = [HEAD, summary(scores, measured), *ours_and_peers(scores), published_recall(scores), baselines(scores)]
    parts += [labels(scores), published_orders(scores), costs(measured), simulated(scores), kitti(scores)]
    return "\n".join(part for part in [*parts, *along_trainings(runs)] if part)
