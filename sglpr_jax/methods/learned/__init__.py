"""Networks of other publications, trained here from random weights. Each file declares one or two methods."""

from sglpr_jax.methods.learned.method import LearnedMethod
from sglpr_jax.methods.learned.pointnetvlad import POINTNETVLAD
from sglpr_jax.methods.learned.sgpr import SGPR

LEARNED: dict[str, LearnedMethod] = {method.name: method for method in (POINTNETVLAD, SGPR)}
"""All learned methods by their names on the command line."""
