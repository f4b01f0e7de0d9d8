"""Optional packages (the extras of pyproject.toml): the command that installs them."""

import importlib
import importlib.metadata
import re
import shlex
import sys
from types import ModuleType

_REQUIREMENT = re.compile(
    r"(?P<package>[^;]+?)\s*;\s*(?:(?P<platforms>.+)\s+and\s+)?extra\s*==\s*[\"'](?P<extra>[\w-]+)[\"']"
)
"""Line of a package's metadata: `gtsam>=4.3; extra == 'slam'`, with conditions of the platform before the extra."""


def optional_module(name: str, purpose: str, *, extra: str) -> ModuleType:
    """Import a module of an extra. Raises ImportError, with its purpose and how to install it, if it is missing."""
    try:
        return importlib.import_module(name)
    except ImportError as error:
        package = name.partition(".")[0].replace("_", "-")
        raise ImportError(f"{purpose} needs {package}: {install_command(extra)}") from error


def install_command(extra: str) -> str:
    """Return the command that installs the packages of an extra for the running Python.

    It names the packages themselves, because this package is on no index.
    """
    lines = importlib.metadata.requires("sglpr-jax") or ()
    requirements = [match for line in lines if (match := _REQUIREMENT.match(line)) and match["extra"] == extra]
    packages = ["; ".join(filter(None, match.group("package", "platforms"))) for match in requirements]
    return shlex.join([sys.executable, "-m", "pip", "install", *packages])
