"""Every block of code in the README and the manual: Python is run, command lines are parsed by their own parsers."""

import dataclasses
import functools
import importlib
import shlex

import pytest
import tyro

import sglpr_jax
from sglpr_jax.cli.__main__ import load_command
from sglpr_jax.cli.runtime import parse_command
from sglpr_jax.models.config import model_preset

from .pages import PAGES, ROOT, blocks, command_lines, name_of

COMMANDS = [(page, line) for page in PAGES for b in blocks(page) if b.language == "bash" for line in command_lines(b)]
LONG = ("README.md", *(f"docs/guides/{name}.md" for name in ("loops", "maps", "sessions")))
"""Pages whose programs are optimised (tests/conftest.py), one after the other."""
WITH_PYTHON = sorted(
    (page for page in PAGES if any(block.language == "python" for block in blocks(page))),
    key=lambda page: name_of(page) not in LONG,
)


def lines_of(*, start: str) -> list[str]:
    """Every different command of the pages that begins so, in order."""
    return list(dict.fromkeys(line for _, line in COMMANDS if line.startswith(start)))


@pytest.mark.slow
@pytest.mark.parametrize("name", sorted(script.name for script in (ROOT / "bin").iterdir() if script.name[0] != "_"))
def test_command_lines_are_parsed(name, capsys):
    lines = lines_of(start=f"bin/{name}")
    assert lines, f"no page shows bin/{name}"
    wrong = []
    for line in lines if name not in ("docs", "test") else []:
        try:
            parse_command(load_command(name)[0], name, shlex.split(line)[1:])
        except SystemExit:
            wrong.append(f"{line}\n{capsys.readouterr().err}")
    assert not wrong, "\n".join(wrong)


@pytest.mark.parametrize("line", lines_of(start="python -m benchmarks"))
def test_command_lines_of_benchmarks_are_parsed(line, monkeypatch):
    monkeypatch.syspath_prepend(str(ROOT))
    _, _, module, *words = shlex.split(line.replace("{1..40}", "1"))
    if module == "benchmarks.gpu":
        importlib.import_module("benchmarks.gpu.__main__").parser().parse_args(words)
        return
    benchmarks = importlib.import_module("benchmarks.__main__")
    name = benchmarks.program_name(words)
    program = benchmarks.PROGRAMS[name].load()
    tyro.cli(functools.wraps(program)(lambda *values, **flags: flags), args=words[len(name.split()) :])


def test_nothing_else_is_unknown():
    known = ("bin/", "git ", "python ", "pip install", "for ", "done", "docker ")  # the last: tests/test_docker.py
    assert not [(name_of(page), line) for page, line in COMMANDS if not line.startswith(known) and "s." not in line]
    assert {block.language for page in PAGES for block in blocks(page)} <= {"bash", "python", "text"}


@pytest.mark.slow
@pytest.mark.parametrize("page", WITH_PYTHON, ids=name_of)
def test_python_runs(page, in_examples, monkeypatch):
    """All blocks of a page, one after another, in a folder with a small dataset, with the cheaper weights.

    Loops of `find_loops` are not registered, drives are short, and what is trained is a tiny model.
    """
    short_drive = functools.partial(sglpr_jax.simulate_recording, scans=80)
    monkeypatch.setattr(sglpr_jax, "simulate_recording", short_drive)
    model, load, preset, find = model_preset("tiny"), sglpr_jax.load, sglpr_jax.preset, sglpr_jax.find_loops
    monkeypatch.setattr(sglpr_jax, "load", lambda name: load("sglpr-small"))
    monkeypatch.setattr(sglpr_jax, "find_loops", functools.partial(find, registered=False))
    cheaper_slam = functools.partial(sglpr_jax.slam, params="sglpr-small")
    monkeypatch.setattr(sglpr_jax, "slam", cheaper_slam)
    monkeypatch.setattr(sglpr_jax, "preset", lambda name: dataclasses.replace(preset(name), model=model))
    found = {"__name__": "page"}
    for block in blocks(page):
        if block.language == "python":
            exec(compile("\n" * block.line + block.text, page, "exec", dont_inherit=True), found)
