"""bin/segment: write the semantic map of every scan or image of a sequence, and score the maps if there are labels."""

import dataclasses
from pathlib import Path

import tyro

from sglpr_jax.cli.config_file import record_command
from sglpr_jax.cli.recording import RecordingOptions
from sglpr_jax.cli.runtime import console, progress_bar
from sglpr_jax.fields import Share
from sglpr_jax.models.shipped import DEFAULT_WEIGHTS

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


def segment_recording(command: SegmentCommand) -> None:
    """Run the command."""
    import numpy as np  # slow imports, not needed for --help

    from sglpr_jax.evaluation.segmentation import confusion_matrix, draw_segmentation, score_confusion, title_of
    from sglpr_jax.files import check_writable, file_name, write_json
    from sglpr_jax.models.weights_file import load
    from sglpr_jax.retrieval.image_maps import save_map, semantic_maps

    check_writable(command.out / RESULT_FILE)
    params = load(command.weights)
    if not params.config.segments:
        raise ValueError(f"{command.weights}: expected weights with a segmentation head, found none")
    recording, least = command.source.open(command.data), command.min_confidence
    command.out.mkdir(parents=True, exist_ok=True)
    categories, classes, labelled, cells = params.config.categories, params.config.classes, 0, 0
    confusion = np.zeros((classes, classes), np.int64)
    with progress_bar(f"segment {recording.name}", len(recording)) as show:
        for row, record, found in semantic_maps(params, recording, min_confidence=least, on_progress=show):
            path = command.out / f"{file_name(recording.ids[row])}.png"
            save_map(path, found, record, categories=categories)
            confusion += confusion_matrix(found.truth, found.predicted, counted=found.seen, classes=classes)
            labelled, cells = labelled + found.seen.sum(), cells + (found.counts > 0).sum()
    print(f"{command.out}: {len(recording)} semantic maps of {labelled / max(cells, 1):.0%} of the cells with points")
    if recording.has_labels:
        scores = score_confusion(confusion, categories=categories, title=title_of(recording))
        draw_segmentation(params, recording, command.out, min_confidence=least)
        console().print(scores)
        write_json(command.out / RESULT_FILE, scores.to_json())
    record_command(command, command.out)
