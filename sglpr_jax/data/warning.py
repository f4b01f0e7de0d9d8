"""What looks wrong in the data but can be read: told, not raised."""

import warnings


class DataWarning(UserWarning):
    """Data can be read but does not look as expected; the message names the file, what was expected and found."""


def warn(message: str) -> None:
    """Tell whoever opened the data."""
    warnings.warn(message, DataWarning, stacklevel=3)
