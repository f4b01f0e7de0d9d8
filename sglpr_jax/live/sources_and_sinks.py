"""Sources of scans and sinks of loops for the live node: what each must implement, and how one is opened by name.

The module `live/NAME.py` is imported when it is used. It has `open_source(where, options, report, map_names)`,
`open_sink(where, options, report)` or, for a connection to ROS, `open_transport(where, report)`. To support another
source or sink, add a module and its name.
"""

import importlib
from collections.abc import Collection, Iterator
from types import ModuleType
from typing import Protocol, runtime_checkable

from sglpr_jax.extras import install_command
from sglpr_jax.live.data_types import FrameStatus, LiveFrame, LoopEdge, Report
from sglpr_jax.live.options import LiveOptions

SOURCES = {"folder": None, "bag": "ros", "dds": "live", "zenoh": "live"}
SINKS = {"json": None, "dds": "live", "zenoh": "live", "rerun": "view"}
"""Names of sources and sinks, with the extra of the package that each needs."""
TRANSPORTS = ("dds", "zenoh")
"""Connections to ROS, each a source and a sink."""


@runtime_checkable
class Source(Protocol):
    """Source of scans."""

    def frames(self) -> Iterator[LiveFrame | None]:
        """Yield scans as they arrive, and None after `WAIT_S` seconds without a scan, so that the node can react to
        signals. Ends if no more scans can come."""
        ...

    @property
    def dropped(self) -> int:
        """Number of scans that were replaced by newer ones before they were taken."""
        ...

    def close(self) -> None: ...


@runtime_checkable
class Sink(Protocol):
    """Receiver of results. After an error it is not used again."""

    def frame(self, status: FrameStatus) -> None:
        """Publish the status after a scan."""

    def loop(self, edge: LoopEdge) -> None:
        """Publish a loop."""

    def close(self) -> None: ...


def open_source(text: str, options: LiveOptions, report: Report, *, map_names: Collection[str] = ()) -> Source:
    """Open the source that a text names: `NAME` or `NAME:WHERE`, such as `folder:my_scans`.

    `report` receives errors of single scans and messages. Scans of files are skipped up to the last one whose name is
    in `map_names`. Raises ValueError if no source has this name, and ImportError if its extra is not installed.
    """
    name, where, module = named_module(text, SOURCES, kind="sources")
    if name not in TRANSPORTS:
        return module.open_source(where, options, report, map_names)
    from sglpr_jax.live.ros_topics import RosSource  # needs the same extra

    return RosSource(module.open_transport(where, report), options, report)


def open_sink(text: str, options: LiveOptions, report: Report) -> Sink:
    """Open the sink that a text names, such as `json:loops.jsonl`, as `open_source` does."""
    name, where, module = named_module(text, SINKS, kind="sinks")
    if name not in TRANSPORTS:
        return module.open_sink(where, options, report)
    from sglpr_jax.live.ros_topics import RosSink  # needs the same extra

    return RosSink(module.open_transport(where, report), options)


def named_module(text: str, known: dict[str, str | None], *, kind: str) -> tuple[str, str, ModuleType]:
    """Split `NAME:WHERE`, and import the module of this name. `kind` is "sources" or "sinks".

    Raises ValueError if the name is not known, and ImportError, which names the extra, if a package is missing.
    """
    name, _, where = text.partition(":")
    if name not in known:
        raise ValueError(f"{text}: expected one of the {kind} {', '.join(known)}, found {name or 'nothing'}")
    try:
        return name, where, importlib.import_module(f"sglpr_jax.live.{name}")
    except ModuleNotFoundError as error:
        if error.name is not None and error.name.startswith("sglpr_jax"):
            raise
        extra = known[name]
        advice = f"; {install_command(extra)}" if extra else ""
        raise ImportError(f"{name}: expected the package {error.name}, found none{advice}") from error
