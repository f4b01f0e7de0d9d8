"""LiDAR place recognition in JAX: the public API, by task.

    params = sglpr_jax.load("sglpr")                    # weights by name, or by folder
    bev = sglpr_jax.scan_image(points, params.config)   # scan (n, 3), metres -> image (h, w)
    descriptor = sglpr_jax.describe(params, bev)        # image -> 256 numbers of unit length

- describe a place, under jit, vmap and grad: `load`, `scan_image`, `describe`, `is_describable`; `segment`, `forward`
- read recordings: `open_recording`, `recording_names`, `read_scan`, `Recording`, `Scan`; `Mounting`,
  `estimate_mounting`, `GroundFilter`; `deskewed`, `deskew`, `submaps`, `SubmapBuilder`, `scaled`
- find places again: `embed`, `DescriptorFile`, `Index`, for a fleet `FleetIndex`
- score retrieval: `evaluate`
- find loops: `find_loops` of recordings, `LoopDetector` for a stream of scans; `read_odometry`, `optimize_trajectory`,
  `IncrementalTrajectory`; `scan_odometry`, and `slam` for all of it; `map_recording`, `PlaceMap` for scans of another
  day; `point_cloud`, `write_cloud` and `occupancy_grid` for other programs
- train: `preset`, `train`; initialise with `init`, store with `save`, publish with `for_places`, `average`,
  `save_program`
- simulate recordings with labels: `simulate`, `simulate_recording`, `simulate_repeating`; `SENSORS`, `CARRIERS`
- images and classes: `Grid`, `rasterize`, `density_bev`, `rotate_image`, `taxonomy`, `to_classes` and more
- configure a model: `ModelConfig`, its backbones `SwinConfig`, `CircularConfig`, `SglprConfig`, its `HeadConfig`
"""

import lazy_loader

__version__ = "0.3.0"

# Importing JAX takes most of a second, so each name is imported when it is first used; `__init__.pyi` lists them.
__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
