import pytest

from .programs import ROOT


@pytest.fixture(autouse=True)
def _benchmarks_on_the_path(monkeypatch):
    """Tests import parts of the benchmarks as the programs import each other."""
    monkeypatch.syspath_prepend(str(ROOT))
