"""bin/reproduce: leave-one-out runs on the small town, and the tables and figures made of them."""

import dataclasses
import json
import shutil

import pytest

from sglpr_jax.methods.learned.rinet import RINET
from sglpr_jax.methods.learned.trained import random_variables, save_variables
from sglpr_jax.reproduce.experiments import VARIANTS, variant_config
from sglpr_jax.reproduce.plan import check_inputs, make_plan
from sglpr_jax.reproduce.reproduction import Reproduction
from sglpr_jax.reproduce.tables import OURS, PUBLISHED, PaperTable, Row
from sglpr_jax.sim.dataset import simulate
from sglpr_jax.training.metrics_log import read_metrics
from sglpr_jax.training.presets import load_preset

from .conftest import SENSOR, assert_one_line_error

DAYS = ("2012-01-15", "2012-02-04")
WANTED = ("table3", "table5", "figure5", "figure6", "figure7", "figure8")
OPTIONS = ("--seq", "08", "--method", "polar-fft", "ssc")


@pytest.fixture(scope="module")
def sessions(tmp_path_factory):
    return simulate(tmp_path_factory.mktemp("data") / "days", sessions=DAYS, scans=12, sensor=SENSOR).root


@pytest.fixture(scope="module")
def reproduced(town, preset, sessions, tmp_path_factory):
    from .conftest import run_command

    folder = tmp_path_factory.mktemp("reproduced")
    options = ("--data", town, "--nclt", sessions, "--preset", preset, "--out", folder, *OPTIONS)
    ended = run_command("reproduce", *WANTED, *options)
    assert ended.status == 0, ended.error
    return folder, ended, options


@pytest.mark.slow
def test_missing_runs_are_trained_and_finished_runs_are_reused(reproduced, command):
    folder, ended, options = reproduced
    assert "2 leave-one-out runs of 4 steps, 0 of them already trained" in ended.error
    assert "s a step" in ended.error and "run 2 of 2" in ended.error
    assert json.loads((folder / "command.json").read_text())["steps"] == 4
    before = {path: path.stat().st_mtime_ns for path in folder.glob("*/*/weights/*")}
    assert {path.parts[-4] for path in before} == {"full", "no-segmentation"}
    again = command("reproduce", "table5", *options)
    assert again.status == 0 and "2 leave-one-out runs of 4 steps, 2 of them already trained" in again.error
    assert {path: path.stat().st_mtime_ns for path in folder.glob("*/*/weights/*")} == before


@pytest.mark.slow
def test_tables_have_rows_of_this_package_and_of_the_paper(reproduced):
    folder, ended, _ = reproduced
    table = json.loads((folder / "table5.json").read_text())
    assert [(row["method"], row["source"]) for row in table] == [
        ("without", OURS),
        ("with", OURS),
        ("without semantic segmentation", PUBLISHED),
        ("with semantic segmentation", PUBLISHED),
    ]
    assert [row["scores"]["08"] for row in table[2:]] == [0.785, 0.898]
    for row in table[:2]:
        assert 0 <= row["scores"]["08"] <= 1 and row["mean"] == row["scores"]["08"]
    wanted = {"figure5-08", "figure6-08", "figure7-08", "figure8-08", f"figure8-{DAYS[1]}"}
    assert {path.stem for path in folder.glob("figure*.png")} == wanted
    assert all(f"{name}.png" in ended.out for name in wanted)
    assert "without semantic segmentation" in ended.out and "| with | here |" in (folder / "table5.md").read_text()


@pytest.mark.slow
def test_table_3_queries_the_later_sessions_and_skips_methods_that_need_labels(reproduced):
    folder, _, _ = reproduced
    table = json.loads((folder / "table3.json").read_text())
    assert [row["method"] for row in table if row["source"] == OURS] == ["SG-LPR", "polar-fft"]
    assert all(set(row["scores"]) == {DAYS[1]} for row in table)
    assert next(row for row in table if row["method"] == "BEVPlace++")["scores"][DAYS[1]] == 0.953


@pytest.mark.slow
def test_other_settings_are_refused_and_more_steps_continue_a_run(reproduced, command, tmp_path):
    folder, _, options = reproduced
    other = command("reproduce", "table5", *options, "--optimizer.learning-rate", "0.5")
    assert_one_line_error(other, "no-segmentation", "config.optimizer.learning_rate")
    assert_one_line_error(command("reproduce", "table5", *options, "--steps", 2), "up to 2 steps, found 4")
    more = command("reproduce", "table5", *options, "--steps", 6, "--plan")
    assert more.status == 0 and "0 of them already trained" in more.error
    assert read_metrics(folder / "full" / "08" / "metrics.jsonl")[-1]["step"] == 4  # only said, not done
    longer = shutil.copytree(folder, tmp_path / "longer")
    assert command("reproduce", "figure6", *options, "--out", longer, "--steps", 6).status == 0
    assert read_metrics(longer / "full" / "08" / "metrics.jsonl")[-1]["step"] == 6


def test_every_variant_differs_from_the_preset_and_from_every_other():
    config = load_preset("paper")
    configs = {name: variant_config(config, name) for name in VARIANTS}
    assert configs["full"] == config and len(set(configs.values())) == len(VARIANTS)


def test_a_mean_needs_every_column():
    rows = [Row("whole", OURS, {"00": 0.5, "08": 0.75}), Row("part", OURS, {"00": 0.5, "08": None})]
    table = PaperTable("title", rows, ("00", "08"), caption="")
    assert [row["mean"] for row in table.to_json()] == [0.625, None]
    assert "| part | here | 0.500 | no revisits | - |" in table.markdown()


def test_the_plan_lists_the_recordings_without_revisits(town, images, preset, tmp_path):
    def plan(data, names, *seqs):
        return make_plan(Reproduction(tmp_path, data, str(preset), load_preset(str(preset)), seqs), names)

    straight = plan(images, ["table1"], "00", "06")
    assert straight.without_revisits == ("00", "06")
    assert straight.text(1.0).splitlines()[-2] == "no revisits in 00, 06: no scores for them, and no means"
    assert plan(town, ["table1", "table3"], "08").without_revisits == ()
    assert plan(images, ["table3"], "00").without_revisits == ()


def test_a_plan_writes_no_simulated_recordings(command, tmp_path, monkeypatch):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    ended = command("reproduce", "table5", "--plan", "--out", tmp_path / "out")
    assert_one_line_error(ended, "expected the simulated recordings, found none", "--data")
    assert not list(tmp_path.glob("cache/**/*.bin"))


@pytest.mark.slow
def test_weights_are_compared_without_training_by_both_protocols(town, trained, tmp_path, command):
    out, peer = tmp_path / "out", tmp_path / "rinet"
    save_variables(peer, RINET, random_variables(RINET, seed=0), {})
    options = ("--data", town, "--seq", "08", "--out", out, "--method", "polar-fft", "--no-train")
    ended = command("reproduce", "table1", "table2", *options, "--weights", trained.folder, peer)
    assert ended.status == 0, ended.error
    for file, absent, present in (
        ("", "SSC (RINet's paper)", "DiSCO (its own paper)"),
        ("-pairs-f1max", "DiSCO (its own paper)", "SSC (RINet's paper)"),
    ):
        raw, turned = (
            {row["method"]: row for row in json.loads((out / f"table{n}{file}.json").read_text())} for n in (1, 2)
        )
        ours = [name for name, row in raw.items() if row["source"] == OURS]
        assert ours == [str(trained.folder), str(peer), "polar-fft"]
        assert absent not in raw and present in raw
        for name in ours:  # no pair of the pairs protocol is positive: no mean and no change
            means = [table[name]["mean"] for table in (turned, raw)]
            expected = None if file else pytest.approx(means[0] - means[1])
            assert turned[name]["change"] == expected
    assert "poses: " in ended.out and not list(out.glob("full"))


def test_table_6_needs_labels_of_every_scan(town, preset, tmp_path, monkeypatch):
    recording_of = Reproduction.recording

    def without_first_label(reproduction, seq):
        recording = recording_of(reproduction, seq)
        return dataclasses.replace(recording, label_paths=(None, *recording.label_paths[1:]))

    monkeypatch.setattr(Reproduction, "recording", without_first_label)
    reproduction = Reproduction(tmp_path, town, str(preset), load_preset(str(preset)), ("08",))
    check_inputs(reproduction, ["table5"])
    with pytest.raises(ValueError, match=r"table6 .* labels of every scan, found none for 1 scans of sequence 00"):
        check_inputs(reproduction, ["table6"])
