"""bin/segment: write the semantic map of every scan or image of a sequence, and score the maps if there are labels."""

import dataclasses
from pathlib import Path
from typing import TYPE_CHECKING

import tyro

from sglpr_jax.cli.config_file import record_command
from sglpr_jax.cli.recording import RecordingOptions
from sglpr_jax.cli.runtime import console
from sglpr_jax.fields import Share
from sglpr_jax.models.shipped import DEFAULT_WEIGHTS
from sglpr_jax.progress import progress_bar

if TYPE_CHECKING:
    from sglpr_jax.data.scan import Scan
    from sglpr_jax.retrieval.image_maps import SemanticMap

RESULT_FILE = "segmentation.json"


@dataclasses.dataclass(frozen=True)
class SegmentCommand:
    """Write the semantic map of each scan, seen from above, as a PNG of class ids (docs/reference/labels.md).

    For a ready-made image, the map is a label image with the same pixels, which bin/train --pseudo-labels reads. If
    there are labels, the command also writes the intersection over union of every class and a picture of one scan
    (figure 7).

    Example:
      bin/segment --data KITTI --seq 08 --out maps/
      bin/segment --weights runs/simulated --data IMAGES --seq 06 --min-confidence 0.8 --out pseudo/06
    """

    data: Path
    """A dataset, a bag or a folder of scans or ready-made images, in any supported layout."""
    out: Path
    """Output folder. It is created if it does not exist."""
    weights: str = DEFAULT_WEIGHTS
    """Name of shipped weights, folder of a training run, or folder with config.json and model.safetensors."""
    source: tyro.conf.OmitArgPrefixes[RecordingOptions] = RecordingOptions()
    min_confidence: Share = 0.0
    """Minimum probability of the most likely class. Cells below it stay unlabelled and are not scored."""


def segment(command: SegmentCommand) -> None:
    from sglpr_jax.evaluation.segmentation import PICTURE, segment_recording  # slow imports, not needed for --help
    from sglpr_jax.files import check_still_there, check_writable, file_name, write_json
    from sglpr_jax.models.weights_file import load
    from sglpr_jax.retrieval.image_maps import save_map

    check_writable(command.out / RESULT_FILE)
    params = load(command.weights)
    if not params.config.segments:
        raise ValueError(f"{command.weights}: expected weights with a segmentation head, found none")
    recording = command.source.open(command.data)
    recorded = record_command(command, command.out)
    for name in (RESULT_FILE, PICTURE):  # scores of an earlier recording
        (command.out / name).unlink(missing_ok=True)
    labelled_cells = occupied_cells = 0

    def write_semantic_map(row: int, scan: "Scan", semantic_map: "SemanticMap") -> None:
        nonlocal labelled_cells, occupied_cells
        path = command.out / f"{file_name(recording.ids[row])}.png"
        save_map(path, semantic_map, scan, categories=params.config.categories)
        labelled_cells += semantic_map.seen.sum()
        occupied_cells += (semantic_map.counts > 0).sum()

    options = {"min_confidence": command.min_confidence, "progress": progress_bar}
    scores = segment_recording(params, recording, command.out, on_map=write_semantic_map, **options)
    share = labelled_cells / max(occupied_cells, 1)
    print(f"{command.out}: {len(recording)} semantic maps of {share:.0%} of the cells with points")
    if scores is not None:
        console().print(scores)
        write_json(command.out / RESULT_FILE, scores.to_json())
    check_still_there(recorded)
