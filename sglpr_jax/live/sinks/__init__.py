"""Sinks of loop edges, one module each. A module is imported when its sink is asked for.

A module has the function `open_sink(where, options, report)`. To support a new sink, add a module and its name.
"""

import dataclasses
from typing import Protocol, runtime_checkable

from sglpr_jax.live.frame import FrameStatus, LoopEdge
from sglpr_jax.live.report import Report
from sglpr_jax.live.sources import check_name, module_of

SINKS = {"json": None, "dds": "live", "zenoh": "live", "ros1": "live", "rerun": "view"}
"""Names of the sinks, with the extra that each needs."""


@runtime_checkable
class Sink(Protocol):
    """Receiver of results. A sink that raises an error is reported once and left out."""

    def frame(self, status: FrameStatus) -> None:
        """Receive the status after a scan."""
        ...

    def loop(self, edge: LoopEdge) -> None:
        """Receive a loop. It is on disk before."""
        ...

    def close(self) -> None:
        """Release files and connections."""
        ...


@dataclasses.dataclass(frozen=True)
class SinkOptions:
    """Options of all sinks. Each sink uses those that apply to it."""

    prefix: str = "/sglpr"
    """Beginning of the names of published topics."""
    map_frame: str = "map"
    odometry_frame: str = "odom"
    """Frames of the published transform and markers."""


def open_sink(text: str, options: SinkOptions, report: Report) -> Sink:
    """Open the sink that a text names: `NAME` or `NAME:WHERE`, such as `json:loops.jsonl`.

    Arguments:
      text: Name of the sink and, after a colon, its file, domain or endpoint.
      options: Options of the sink.
      report: Function for trouble with single messages.

    Raises:
      ValueError: If no sink has this name.
      ImportError: If the extra of the sink is not installed.
    """
    name, where = check_name(text, SINKS, kind="sinks")
    return module_of(name, SINKS, kind="sinks").open_sink(where, options, report)
