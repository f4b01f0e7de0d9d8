"""Networks of other publications, trained here from random weights. Each file declares one or two methods."""

from sglpr_jax.methods.learned.method import LearnedMethod

LEARNED: dict[str, LearnedMethod] = {}
"""All learned methods by their names on the command line."""
