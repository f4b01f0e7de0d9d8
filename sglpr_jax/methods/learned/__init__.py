"""Networks of other publications, trained here from random weights. Each file declares one or two methods."""

from sglpr_jax.methods.learned.bevplace import BEVPLACE, RESNET34_NETVLAD
from sglpr_jax.methods.learned.disco import DISCO
from sglpr_jax.methods.learned.method import LearnedMethod
from sglpr_jax.methods.learned.overlap_transformer import OVERLAP_TRANSFORMER
from sglpr_jax.methods.learned.pointnetvlad import POINTNETVLAD
from sglpr_jax.methods.learned.rinet import RINET
from sglpr_jax.methods.learned.sgpr import SGPR

LEARNED: dict[str, LearnedMethod] = {
    method.name: method
    for method in (RINET, BEVPLACE, RESNET34_NETVLAD, DISCO, OVERLAP_TRANSFORMER, POINTNETVLAD, SGPR)
}
"""All learned methods by their names on the command line."""
