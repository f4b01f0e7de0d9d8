"""The commands: `bin/NAME`, after `pip install` `sglpr-NAME`, or `python -m sglpr_jax.cli NAME`."""

import importlib
import sys
from collections.abc import Callable
from pathlib import Path

from sglpr_jax.cli.runtime import INSTALLED_AS, parse_command, run

COMMANDS = {
    "convert": ("ConvertCommand", "convert"),
    "demo": ("DemoCommand", "demo"),
    "embed": ("EmbedCommand", "embed_recording"),
    "evaluate": ("EvaluateCommand", "evaluate_file"),
    "export": ("ExportCommand", "export"),
    "live": ("LiveCommand", "live"),
    "loops": ("LoopsCommand", "loops_of_recording"),
    "map": ("MapCommand", "write_map"),
    "peers": ("PeersCommand", "run_peers"),
    "relocalize": ("RelocalizeCommand", "relocalize"),
    "reproduce": ("ReproduceCommand", "reproduce"),
    "segment": ("SegmentCommand", "segment"),
    "simulate": ("SimulateCommand", "write_simulation"),
    "train": ("TrainCommand", "train_and_test"),
}
"""Name of each command, which is also its module: the dataclass of its flags and the function that runs it."""


def load_command(name: str) -> tuple[type, Callable]:
    """Return the dataclass and the function of a command."""
    module = importlib.import_module(f"sglpr_jax.cli.{name}")
    flags_class, function = COMMANDS[name]
    return getattr(module, flags_class), getattr(module, function)


def main() -> None:
    """Run the command that `sglpr-NAME`, or the first argument of `python -m sglpr_jax.cli`, names."""
    if not Path(sys.argv[0]).name.startswith(INSTALLED_AS):
        if len(sys.argv) < 2 or sys.argv[1] not in COMMANDS:
            found = sys.argv[1] if len(sys.argv) > 1 else "none"
            sys.exit(f"error: expected a command, one of {', '.join(COMMANDS)}, found {found}")
        sys.argv = [f"bin/{sys.argv[1]}", *sys.argv[2:]]
    name = Path(sys.argv[0]).stem.removeprefix(INSTALLED_AS)
    flags_class, function = load_command(name)
    run(lambda: parse_command(flags_class, name), function)


if __name__ == "__main__":
    main()
