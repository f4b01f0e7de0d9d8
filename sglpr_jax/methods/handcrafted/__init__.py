"""Methods that need no training: each file has a pure function and declares what it takes.

A new one is a file here, an entry of the list, and its name in `methods/names.py`.
"""

from sglpr_jax.methods.handcrafted.lidar_iris import LIDAR_IRIS
from sglpr_jax.methods.handcrafted.m2dp import M2DP
from sglpr_jax.methods.handcrafted.polar_fft import POLAR_FFT
from sglpr_jax.methods.handcrafted.random_vector import RANDOM
from sglpr_jax.methods.handcrafted.scan_context import SCAN_CONTEXT
from sglpr_jax.methods.handcrafted.solid import SOLID
from sglpr_jax.methods.handcrafted.ssc import SSC, SSC_24
from sglpr_jax.methods.handcrafted.thumbnail import THUMBNAIL
from sglpr_jax.methods.method import HandcraftedMethod

HANDCRAFTED: dict[str, HandcraftedMethod] = {
    method.name: method for method in (SCAN_CONTEXT, M2DP, LIDAR_IRIS, SSC, SSC_24, SOLID, POLAR_FFT, THUMBNAIL, RANDOM)
}
"""Every handcrafted method, by the name that a command line takes."""
