"""Optional packages (the extras of pyproject.toml): the command that installs them."""

import importlib.metadata
import re
import shlex
import sys

_REQUIREMENT = re.compile(
    r"(?P<package>[^;]+?)\s*;\s*(?:(?P<platforms>.+)\s+and\s+)?extra\s*==\s*[\"'](?P<extra>[\w-]+)[\"']"
)
"""Line of a package's metadata: `gtsam>=4.3; extra == 'slam'`, with conditions of the platform before the extra."""


def install_command(extra: str) -> str:
    """Return the command that installs the packages of an extra for the running Python.

    It names the packages themselves, because this package is on no index.
    """
    lines = importlib.metadata.requires("sglpr-jax") or ()
    requirements = [match for line in lines if (match := _REQUIREMENT.match(line)) and match["extra"] == extra]
    packages = ["; ".join(filter(None, match.group("package", "platforms"))) for match in requirements]
    return shlex.join([sys.executable, "-m", "pip", "install", *packages])
