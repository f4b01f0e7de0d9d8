"""Twenty wrong lines, each in a copy of the tree: whether the tests notice it."""

import os
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import NamedTuple


class Mutation(NamedTuple):
    """One line made wrong, and the tests that should notice it."""

    line: str
    """Text that only one file of the package contains."""
    wrong: str
    """What replaces the text."""
    tests: tuple[str, ...]
    """Patterns of paths below `tests`. Some name the places of earlier versions."""
    other_line: str | None = None
    other_wrong: str = ""
    """The same for trees whose names differ: text that is looked for if `line` is in no file, and its replacement."""

    def in_tree(self, tree: Path) -> tuple[list[Path], str, str]:
        """Files of the package with the text, the text, and what replaces it."""
        for line, wrong in ((self.line, self.wrong), (self.other_line, self.other_wrong)):
            files = [path for path in sorted((tree / "sglpr_jax").rglob("*.py")) if line and line in path.read_text()]
            if files:
                return files, str(line), wrong
        return [], self.line, self.wrong


MUTATIONS = (
    Mutation(
        "jnp.where(last >= 0, found",
        "jnp.where(last > 0, found",
        ("test_bev*.py",),
        "jnp.where(last_row >= 0, last",
        "jnp.where(last_row > 0, last",
    ),
    Mutation(".astype(jnp.int32) - 1\n", ".astype(jnp.int32)\n", ("test_bev*.py",)),
    Mutation("hinge.max(-1)", "hinge.min(-1)", ("test_losses.py", "training/test_loss*.py")),
    Mutation(
        "1 - (2 * product",
        "1 - (product",
        ("test_losses.py", "training/test_loss*.py"),
        "dice = (2 * intersection",
        "dice = (intersection",
    ),
    Mutation('clock - excluded, side="right")', 'clock - excluded, side="left")', ("evaluation/*.py", "test_*.py")),
    Mutation("minlength=len(thresholds) + 1)[1:]", "minlength=len(thresholds) + 1)[:-1]", ("test_metrics.py",)),
    Mutation(
        "= crossed @ turned",
        "= turned @ crossed",
        ("test_se3.py", "loops/test_transforms.py"),
        "= cross @ rotation",
        "= rotation @ cross",
    ),
    Mutation(
        "fresh[None, 1:], fresh[None, :-1]",
        "fresh[None, :-1], fresh[None, 1:]",
        ("loops/test_sequence.py",),
        "to_previous, to_next = independent[None, :-1], independent[None, 1:]",
        "to_previous, to_next = independent[None, 1:], independent[None, :-1]",
    ),
    Mutation(
        "assignment.sum(1)[:, None, :] * centres",
        "assignment.mean(1)[:, None, :] * centres",
        ("models/*.py",),
        "assignment.sum(1)[:, None, :] * jnp",
        "assignment.mean(1)[:, None, :] * jnp",
    ),
    Mutation(
        "jnp.roll(x, (-down, -right), (1, 2))",
        "jnp.roll(x, (down, right), (1, 2))",
        ("models/*.py",),
        "jnp.roll(x, (-row_shift, -column_shift)",
        "jnp.roll(x, (row_shift, column_shift)",
    ),
    Mutation("-1, height, width, c)", "-1, width, height, c)", ("models/*.py",)),
    Mutation(
        "np.asarray(found.H)[order][:, order]",
        "np.asarray(found.H)",
        ("*/test_gicp.py", "loops/*regist*.py"),
        "np.asarray(result.H)[order][:, order]",
        "np.asarray(result.H)",
    ),
    Mutation(
        "fewer = min(len(ours)",
        "fewer = max(len(ours)",
        ("*/test_gicp.py", "loops/*regist*.py"),
        "smaller_count = min(map(len",
        "smaller_count = max(map(len",
    ),
    Mutation(
        "bend > drift.max_deviation]] = False",
        "bend < 0]] = False",
        ("*/test_optimi*.py",),
        "loop_deviations > drift.max_deviation]] = False",
        "loop_deviations < 0]] = False",
    ),
    Mutation(
        "BetweenFactorPose3(loop.match, loop.query",
        "BetweenFactorPose3(loop.query, loop.match",
        ("*/test_optimi*.py",),
        "BetweenFactorPose3(first, second",
        "BetweenFactorPose3(second, first",
    ),
    Mutation(
        "+ second * (cross @ cross)",
        "- second * (cross @ cross)",
        ("data/test_deskew.py", "data/test_pose*.py"),
        "fractions[:, None] * motions",
        "-fractions[:, None] * motions",
    ),
    Mutation(
        "np.searchsorted(pose_times, times) - 1",
        "np.searchsorted(pose_times, times)",
        ("data/test_deskew.py", "data/test_pose*.py"),
    ),
    Mutation(
        "step - step % every",
        "step",
        ("training/test_mining.py", "data/test_descriptor_cache.py"),
        "last_refresh = run / MINING, step - step % config.refresh_steps",
        "last_refresh = run / MINING, step",
    ),
    Mutation(
        "-np.clip(self.log_odds(evidence)",
        "np.clip(self.log_odds(evidence)",
        ("loops/test_probability.py",),
        "expit(self.log_odds(evidence))",
        "expit(-self.log_odds(evidence))",
    ),
    Mutation(
        "os.replace(new, path)",
        "os.replace(new, new)",
        ("test_files.py",),
        "os.replace(source, target)",
        "os.replace(source, source)",
    ),
)


def mutations(*, tree: Path = Path()) -> None:
    """Make twenty lines wrong, one at a time, and run the tests of their modules until the first failure.

    Args:
        tree: Checkout whose package and tests are used. An earlier version can be compared.
    """
    with tempfile.TemporaryDirectory() as folder:
        copy = Path(folder) / "tree"
        listed = subprocess.run(["git", "ls-files", "-z"], cwd=tree, check=True, capture_output=True, text=True).stdout
        for name in filter(None, listed.split("\0")):
            (copy / name).parent.mkdir(parents=True, exist_ok=True)
            shutil.copy2(tree / name, copy / name)
        noticed = sum(_is_noticed(mutation, copy) for mutation in MUTATIONS)
    print(f"noticed: {noticed} of {len(MUTATIONS)}")


def _is_noticed(mutation: Mutation, tree: Path) -> bool:
    """Whether a test of the tree fails with the mutation. Raises RuntimeError if the tests cannot run."""
    files, line, wrong = mutation.in_tree(tree)
    tests = [path for pattern in mutation.tests for path in sorted((tree / "tests").glob(pattern))]
    tests = [path for path in tests if path.name.startswith("test_")]
    if len(files) != 1 or not tests:
        counts = f"{len(files)}, {len(tests)}"
        raise SystemExit(f"error: expected {line!r} in one file and tests of it, found {counts}")
    text = files[0].read_text()
    files[0].write_text(text.replace(line, wrong))
    command = [sys.executable, "-m", "pytest", "-x", "-q", "-n", "0", "-p", "no:cacheprovider", *tests]
    environment = os.environ | {"PYTHONPATH": str(tree), "PYTHONDONTWRITEBYTECODE": "1"}
    ended = subprocess.run(command, cwd=tree, env=environment, capture_output=True, text=True)
    files[0].write_text(text)
    if ended.returncode not in (0, 1):
        raise RuntimeError(ended.stdout + ended.stderr)
    state = "noticed" if ended.returncode else "MISSED"
    print(f"{state}: {wrong.strip()} ({files[0].relative_to(tree)})", flush=True)
    return bool(ended.returncode)
