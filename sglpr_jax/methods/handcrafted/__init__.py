"""Methods without training. Each file contains a pure function and declares its inputs.

A new method needs a file here, an entry in the list below, and its name in `methods/names.py`.
"""

from sglpr_jax.methods.handcrafted.lidar_iris import LIDAR_IRIS
from sglpr_jax.methods.handcrafted.m2dp import M2DP
from sglpr_jax.methods.handcrafted.polar_fft import POLAR_FFT
from sglpr_jax.methods.handcrafted.probe import PROBE
from sglpr_jax.methods.handcrafted.ring import RING
from sglpr_jax.methods.handcrafted.scan_context import SCAN_CONTEXT
from sglpr_jax.methods.handcrafted.solid import SOLID
from sglpr_jax.methods.handcrafted.ssc import SSC, SSC_24
from sglpr_jax.methods.method import HandcraftedMethod

_METHODS = (SCAN_CONTEXT, M2DP, LIDAR_IRIS, SSC, SSC_24, SOLID, RING, PROBE, POLAR_FFT)
HANDCRAFTED: dict[str, HandcraftedMethod] = {method.name: method for method in _METHODS}
"""All handcrafted methods by their names on the command line."""
