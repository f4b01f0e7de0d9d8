"""Methods without training. A new one needs a file here, an entry in `_METHODS`, and its name in `methods/names.py`."""

from functools import partial

from sglpr_jax.methods.handcrafted.lidar_iris import lidar_iris, lidar_iris_distance
from sglpr_jax.methods.handcrafted.m2dp import m2dp
from sglpr_jax.methods.handcrafted.polar_fft import READY_MADE_RADIUS, polar_fft
from sglpr_jax.methods.handcrafted.probe import probe, probe_distance
from sglpr_jax.methods.handcrafted.ring import ring, ring_distance
from sglpr_jax.methods.handcrafted.scan_context import scan_context, scan_context_distance
from sglpr_jax.methods.handcrafted.solid import solid
from sglpr_jax.methods.handcrafted.ssc import NEWEST, ssc, ssc_distance
from sglpr_jax.methods.method import HandcraftedMethod

_METHODS = (
    HandcraftedMethod(
        "scan-context", 'Kim and Kim, "Scan Context", IROS 2018', "points", scan_context, scan_context_distance
    ),
    HandcraftedMethod("m2dp", 'He, Wang and Zhang, "M2DP", IROS 2016', "points", m2dp),
    HandcraftedMethod("lidar-iris", 'Wang et al., "LiDAR Iris", IROS 2020', "points", lidar_iris, lidar_iris_distance),
    HandcraftedMethod("ssc", 'Li et al., "Semantic Scan Context", IROS 2021', "labelled points", ssc, ssc_distance),
    HandcraftedMethod(
        "ssc-24",
        "SSC with the 24 rings from 5 m of its authors' last version",
        "labelled points",
        partial(ssc, grid=NEWEST),
        partial(ssc_distance, grid=NEWEST),
    ),
    HandcraftedMethod("solid", 'Kim et al., "Narrowing your FOV with SOLiD", RA-L 2024', "points", solid),
    HandcraftedMethod("ring", 'Lu et al., "RING++", T-RO 2023', "points", ring, ring_distance),
    HandcraftedMethod(
        "probe", 'this project, after the abstract of Lee et al., "PROBE", RA-L 2026', "points", probe, probe_distance
    ),
    HandcraftedMethod(
        "polar-fft", "this project", "images", polar_fft, None, partial(polar_fft, radius=READY_MADE_RADIUS)
    ),
)
HANDCRAFTED: dict[str, HandcraftedMethod] = {method.name: method for method in _METHODS}
"""All handcrafted methods by their names on the command line."""
