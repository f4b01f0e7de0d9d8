"""Sources and sinks are found by name, and each error names the source or sink that is wrong."""

import pytest

from sglpr_jax.live.options import LiveOptions
from sglpr_jax.live.sources_and_sinks import SINKS, open_sink, open_source


def test_unknown_names_missing_folders_and_extras_are_named(tmp_path, said, monkeypatch):
    with pytest.raises(ValueError, match=f"expected one of the sinks {', '.join(SINKS)}, found nothing"):
        open_sink("", LiveOptions(), said)
    with pytest.raises(FileNotFoundError, match=r"folder:.*: expected a folder"):
        open_source(f"folder:{tmp_path}/none", LiveOptions(), said)
    monkeypatch.setattr("sglpr_jax.live.sources_and_sinks.importlib.import_module", missing)
    with pytest.raises(ImportError, match=r"dds: expected the package cyclonedds, found none; .* install .*cyclonedds"):
        open_source("dds", LiveOptions(), said)


def missing(name: str):
    raise ModuleNotFoundError("No module named 'cyclonedds'", name="cyclonedds")
