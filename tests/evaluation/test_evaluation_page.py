"""The folder of an evaluation: content of the page, and files that are written, removed or kept."""

import base64
import dataclasses
import io
from html.parser import HTMLParser

import numpy as np
import pytest
from PIL import Image

from sglpr_jax.evaluation import figures
from sglpr_jax.evaluation.evaluation_page import (
    Pictures,
    draw,
    evaluation_page,
    write_evaluation,
)
from sglpr_jax.evaluation.page import figure_picture
from sglpr_jax.evaluation.protocols import score
from sglpr_jax.evaluation.scoring import Evaluation, evaluate_methods
from sglpr_jax.evaluation.sessions import evaluate_sessions
from sglpr_jax.files import printable

VOID = {"meta", "img", "br"}


class Parsed(HTMLParser):
    """Parses a page: its texts by headline, its pictures, and whether tags are closed in order."""

    def __init__(self, html: str):
        super().__init__()
        self.open, self.images, self.texts, self.headline, self.addresses = [], [], {}, "", []
        self.feed(html)
        self.close()
        assert self.open == []

    def handle_starttag(self, tag, attrs):
        self.addresses += [value for name, value in attrs if name in ("src", "href", "action", "data", "srcset")]
        if tag == "img":
            data = dict(attrs)["src"].removeprefix("data:image/png;base64,")
            with Image.open(io.BytesIO(base64.b64decode(data, validate=True))) as image:
                self.images.append((self.headline, image.size))
        if tag not in VOID:
            self.open.append(tag)

    def handle_endtag(self, tag):
        assert self.open.pop() == tag

    def handle_data(self, data):
        if self.open[-1:] == ["h2"]:
            self.headline = data
        if self.open[-1:] != ["style"]:
            self.texts[self.headline] = self.texts.get(self.headline, "") + data


@pytest.fixture(scope="module")
def found(mistaken):
    return Evaluation(
        "<town> & co", "about it", {"mine": score(mistaken, ["top1-f1max", "ssc-recall"])}, mistaken.positions
    )


@pytest.fixture(scope="module")
def sessions(mistaken, tmp_path_factory):
    return across(mistaken, "tuesday", tmp_path_factory.mktemp("sessions"))


def across(file, other, folder):
    file.save(folder / "a.npz")
    dataclasses.replace(file, sequence=other).save(folder / "b.npz")
    return evaluate_sessions(folder / "a.npz", [folder / "b.npz"], ["bevplace-nclt-recall"])


def render(found, pictures=None):
    html = evaluation_page(found, draw(found), pictures or Pictures())
    return html, Parsed(html)


def test_the_page_shows_the_results_without_external_files(found):
    html, seen = render(found)
    assert "<title>&lt;town&gt; &amp; co</title>" in html and "<script" not in html and "url(" not in html
    assert all(address.startswith("data:") for address in seen.addresses)
    for word in ("top-1 F1max", "3 m / 20 m", "400 revisits", "510 queries", "3-D", "made up", "SemanticKITTI's poses"):
        assert word in seen.texts["Results"]
    result = found.results[0]
    assert f"{result.score:.3f}" in seen.texts["Results"]
    assert "{:.3f} to {:.3f}".format(*result.interval) in seen.texts["Results"]
    assert [headline for headline, _ in seen.images] == ["Precision and recall", "Trajectory"]
    assert "Methods side by side" not in seen.texts
    assert "500" in seen.texts["Worst false positives"] and "add --data" in seen.texts["Worst false positives"]
    for headline in ("Semantic maps", "Feature heat maps"):
        assert "--weights" in seen.texts[headline] and "--data" in seen.texts[headline]


def test_an_empty_section_names_the_option_that_fills_it(found):
    _, seen = render(Evaluation("", "", {"mine": found.results[1:]}, None))
    assert "no protocol" in seen.texts["Precision and recall"].lower() and seen.images == []
    assert "--poses" in seen.texts["Trajectory"] and "--protocol" in seen.texts["Worst false positives"]


def test_pictures_are_in_their_sections(found):
    mistake, other = found.worst_false_positives
    assert (mistake.query, mistake.answer, other.answer) == (500, 10, 20)
    counts = np.arange(24 * 20).reshape(24, 20)
    maps = figure_picture(figures.segmentation_panel(counts, None, counts % 20, resolution_m=0.5), "a map")
    pictures = Pictures(dict.fromkeys((500, 10, 600, 20), counts), semantic=[maps, maps], heat=[maps])
    _, seen = render(found, pictures)
    sizes = {headline: [size for where, size in seen.images if where == headline] for headline, _ in seen.images}
    assert sizes["Worst false positives"] == [(20, 24)] * 4
    assert len(sizes["Semantic maps"]) == 2 and len(sizes["Feature heat maps"]) == 1
    said = seen.texts["Worst false positives"]
    assert f"frame 500 answered with 10: {mistake.metres:.1f} m apart" in said and "descriptor distance 0" in said


def names_in(folder) -> set[str]:
    return {path.name for path in folder.iterdir()}


def test_plots_of_an_earlier_evaluation_are_removed_and_other_files_stay(found, sessions, tmp_path):
    two = dataclasses.replace(found, methods={"mine": found.results, "same": found.results})
    mine = tmp_path / "precision-recall-raw.png"
    mine.write_bytes(b"not of this command")
    for results in (two, found, sessions):
        written = write_evaluation(results, tmp_path)
        assert names_in(tmp_path) == {mine.name, *(path.name for path in written)}
    assert len(written) == 2


def test_nothing_is_removed_from_a_folder_without_an_evaluation(sessions, tmp_path):
    (tmp_path / "trajectory.png").write_bytes(b"not of this command")
    (tmp_path / "results.json").write_text('{"sequence": "08", "raw": {}}')
    write_evaluation(sessions, tmp_path)
    assert names_in(tmp_path) == {"trajectory.png", "results.json", "report.html"}


def test_a_name_with_markup_is_printed_drawn_and_written_unchanged(mistaken, tmp_path):
    name = "[/red]<b>$x_{$\udcff\nb\x1b[2J"
    file = dataclasses.replace(mistaken, sequence=name)
    other = dataclasses.replace(file, descriptors=file.descriptors[:, ::-1].copy())
    found = evaluate_methods({name: file, "other": other}, ["top1-f1max"], file=tmp_path / "a.npz")
    for result, folder in ((found, "one"), (across(file, f"{name}2", tmp_path), "sessions")):
        write_evaluation(result, tmp_path / folder)
        assert printable(name) in str(result)
        page = (tmp_path / folder / "report.html").read_text(encoding="utf-8")
        assert "<b>" not in page and "</red>" not in page and page.count("<h1>") == 1
