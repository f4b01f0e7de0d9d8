"""A simulated drive."""

from drives import drive  # noqa: F401
