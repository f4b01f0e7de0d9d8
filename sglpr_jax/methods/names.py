"""Names of all methods, for modules that must not import the methods."""

from typing import TYPE_CHECKING, Literal

NETWORK = "sglpr"
HANDCRAFTED_NAMES = ("scan-context", "m2dp", "lidar-iris", "ssc", "ssc-24", "solid", "ring", "probe", "polar-fft")
LEARNED_NAMES = ("rinet", "bevplace++", "resnet34-netvlad", "disco", "overlap-transformer", "pointnetvlad", "sgpr")
"""Names of the networks of other publications. Their weights are trained by the user."""
UNTRAINED, SHIPPED = "untrained", "shipped"
"""Methods for comparison with a newly trained network: the same network with random and with the default weights."""
BESIDE = (UNTRAINED, "polar-fft")
"""Default methods for comparison with a newly trained network."""

if TYPE_CHECKING:
    BesideName = LearnedName = AnyMethodName = str
else:
    BesideName = Literal[(UNTRAINED, SHIPPED, *HANDCRAFTED_NAMES)]
    LearnedName = Literal[LEARNED_NAMES]
    AnyMethodName = Literal[(NETWORK, *HANDCRAFTED_NAMES, *LEARNED_NAMES)]
"""One of these names. Command lines list them in the help and reject others."""
