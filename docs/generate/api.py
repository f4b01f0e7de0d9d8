"""The page of the API: everything that `sglpr_jax` exports, under a few headings; the texts are the docstrings."""

import sglpr_jax

GROUPS = {
    "From a scan to a descriptor": ["load", "read_scan", "scan_image", "describe", "segment", "forward", "Outputs"],
    "Recordings": [
        *("open_recording", "recording_names", "Recording", "Scan"),
        *("deskewed", "deskew", "submaps", "SubmapBuilder", "scaled"),
    ],
    "Finding places again": ["embed", "DescriptorFile", "Index", "FleetIndex"],
    "Scores": ["evaluate", "Evaluation"],
    "Loops": ["find_loops", "LoopDetector", "LoopClosure"],
    "Maps": [
        *("map_recording", "PlaceMap", "point_cloud", "write_cloud", "CloudConfig"),
        *("occupancy_grid", "OccupancyConfig"),
    ],
    "Training": ["preset", "train", "TrainResult", "init", "save", "for_places", "save_program"],
    "Simulation": ["simulate"],
    "Weights and presets": ["Params", "shipped_weights", "MODELS", "model_preset"],
    "What a model is": ["ModelConfig", "SwinConfig", "CircularConfig", "SglprConfig", "HeadConfig"],
    "Images of a scan": ["Grid", "rasterize", "rasterize_labels", "density_bev", "rotate_image", "rotate_points"],
    "Labels": ["CATEGORIES", "taxonomy", "to_classes"],
}
HEAD = """# API

What `import sglpr_jax` gives. `describe`, `forward`, `segment`, `is_describable`, `rasterize`, `rasterize_labels`,
`rotate_image` and `rotate_points` are JAX: pure, for `jit` and `vmap`, `describe` and `forward` for `grad` too. What
reads scans or makes density images (`scan_image`, `density_bev`) is numpy.
Shapes stand in the signatures, as jaxtyping writes them: `Float[Array, "*b h w"]` is an array of floating point numbers
with any leading axes, h rows and w columns. Points are metres in the LiDAR frame: x forward, y left, z up.
"""


def api_page() -> str:
    """All public names, each once."""
    exported = list(sglpr_jax.__all__)
    grouped = {title: [name for name in names if name in exported] for title, names in GROUPS.items()}
    rest = sorted(set(exported) - {name for names in grouped.values() for name in names})
    sections = [_section(title, names) for title, names in {**grouped, "Everything else": rest}.items() if names]
    return "\n".join([HEAD, *sections])


def _section(title: str, names: list[str]) -> str:
    return "\n".join([f"## {title}\n", *(f"::: sglpr_jax.{name}\n" for name in names)])
