"""Warnings about data that looks wrong but can be read."""

import warnings


class DataWarning(UserWarning):
    """Data can be read but looks wrong. The message names the file, what was expected and what was found."""


def warn(message: str) -> None:
    """Issue a `DataWarning` for the caller of the current function."""
    warnings.warn(message, DataWarning, stacklevel=3)
