"""A simulated town that is driven through twice."""

from drives import drive, revisit  # noqa: F401
