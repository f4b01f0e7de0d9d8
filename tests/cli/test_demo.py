from pathlib import Path

import pytest

from sglpr_jax.cli import datasets, demo


@pytest.fixture
def tiny_demo(monkeypatch, town, preset):
    """bin/demo on the tests' dataset, with the cheaper weights and the tests' preset."""
    asked = {}

    def simulate(root, **options):
        asked.update(options)
        root.parent.mkdir(parents=True, exist_ok=True)
        if not root.exists():
            root.symlink_to(town)

    monkeypatch.setattr(datasets, "simulate", simulate)
    monkeypatch.setattr(demo, "WEIGHTS", "sglpr-small")
    monkeypatch.setattr(demo, "PRESET", str(preset))
    monkeypatch.setattr(demo, "STEPS", 2)
    return asked


@pytest.mark.slow
def test_the_demo_finds_loops_scores_descriptors_and_trains(command, tiny_demo, tmp_path):
    out = tmp_path / "demo"
    ended = command("demo", "--out", out, "--scans", 40)
    assert ended.status == 0, ended.error
    assert tiny_demo["scans"] == 40
    for words in ("frames of 00", "top-1 F1max", "untrained", "shipped", "rotated", "sequence 00, 40 scans"):
        assert words in ended.out
    assert "2 steps of training, to show the command" in ended.error
    pages = [Path(page) for page in ended.out.split("pages: ")[1].strip().split(", ")]
    assert pages == [out / "loops" / "index.html", out / "00" / "report.html"]
    assert all(page.stat().st_size > 50_000 for page in pages)
    assert (out / "run" / "checkpoints" / "2").is_dir()
