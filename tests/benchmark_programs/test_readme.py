"""The program that follows the README on a bare machine finds its steps."""

import importlib
from pathlib import Path

import pytest

pytestmark = pytest.mark.slow


def test_the_readme_is_followed_line_by_line(monkeypatch):
    readme = importlib.import_module("benchmarks.robustness.readme_on_bare_machine")
    text = "```bash\nbin/demo    # all of it\nbin/test\n```\n```python\na = 1\n```\ntext\n```python\nprint(a)\n```\n"
    found = readme.steps(text, Path("python"), of_wheel=False)
    assert [(step.line, step.command[-1]) for step in found] == [
        (1, "bin/demo"),
        (1, "bin/test"),
        (5, "a = 1\n"),
        (9, "a = 1\nprint(a)\n"),
    ]
    assert [step.shown for step in readme.steps(text, Path("python"), of_wheel=True)] == [
        "sglpr-demo",
        "Python, 1 lines",
        "Python, 1 lines",
    ]
