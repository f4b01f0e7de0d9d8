"""The page: what stands in it, and that it stands alone."""

import base64
import io
from html.parser import HTMLParser

import numpy as np
import pytest
from PIL import Image

from sglpr_jax.evaluation.page import (
    HeatPicture,
    Pictures,
    SemanticPicture,
    draw_curves,
    draw_trajectory,
    page,
)
from sglpr_jax.evaluation.scoring import Evaluation, score

VOID = {"meta", "img", "br"}


class Parsed(HTMLParser):
    """A page as a browser would see it: its texts by headline, its pictures, and whether tags close in order."""

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


@pytest.fixture
def found(make_file, two_laps):
    descriptors = two_laps / 200
    descriptors[500] = descriptors[10]
    file = make_file(two_laps, descriptors)
    return Evaluation("<town> & co", "about it", {"mine": score(file, ["top1-f1max", "ssc-recall"])}, two_laps)


def render(found, pictures=None):
    curves, trajectory = draw_curves(found), draw_trajectory(found)
    html = page(found, curves=curves, trajectory=trajectory, pictures=pictures or Pictures())
    return html, Parsed(html)


def test_the_page_says_what_the_results_say_and_stands_alone(found):
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


def test_what_is_missing_is_said_with_its_option(found):
    _, seen = render(found)
    assert "500" in seen.texts["Worst false positives"] and "add --data" in seen.texts["Worst false positives"]
    for headline in ("Semantic maps", "Feature heat maps"):
        assert "--weights" in seen.texts[headline] and "--data" in seen.texts[headline]
    recall = Evaluation("", "", {"mine": found.results[1:]}, None)
    _, seen = render(recall)
    assert "no protocol" in seen.texts["Precision and recall"].lower()
    assert "--poses" in seen.texts["Trajectory"]
    assert "--protocol top1-f1max" in seen.texts["Worst false positives"]
    assert seen.images == []


@pytest.mark.slow
def test_pictures_stand_where_they_belong(found):
    (mistake,) = found.worst
    assert (mistake.query, mistake.answer) == (500, 10)
    counts = np.arange(24 * 20).reshape(24, 20)
    classes = counts % 20
    pictures = Pictures(
        images={500: counts, 10: counts},
        semantic={
            "a": SemanticPicture(counts, classes, classes, 0.5),
            "b": SemanticPicture(counts, None, classes, 0.5),
        },
        heat={"a": HeatPicture(counts, {"CBAM": counts / counts.max(), "decoder": np.full((24, 20), np.nan)})},
    )
    _, seen = render(found, pictures)
    sizes = {headline: [size for where, size in seen.images if where == headline] for headline, _ in seen.images}
    assert sizes["Worst false positives"] == [(20, 24)] * 2
    assert len(sizes["Semantic maps"]) == 2 and len(sizes["Feature heat maps"]) == 1
    assert sizes["Semantic maps"][1][0] < sizes["Semantic maps"][0][0]  # no truth, no panel
    said = seen.texts["Worst false positives"]
    assert f"frame 500 answered with 10: {mistake.metres:.1f} m apart" in said and "descriptor distance 0" in said


def test_methods_stand_side_by_side(found, make_file, two_laps):
    blind = score(make_file(two_laps, np.ones((800, 2))), ["top1-f1max", "ssc-recall"])
    both = Evaluation("town", "", found.methods | {"blind": blind}, two_laps)
    _, seen = render(both)
    for word in ("mine", "blind", f"{blind[0].score:.3f}"):
        assert word in seen.texts["Methods side by side"]
    assert list(draw_curves(both)) == ["precision-recall-top-1-f1max.png"]


def test_a_method_without_mistakes_has_none_to_show(make_file, two_laps):
    perfect = Evaluation("", "", {"mine": score(make_file(two_laps, two_laps), ["top1-f1max"])}, two_laps)
    assert "none at the threshold" in render(perfect)[1].texts["Worst false positives"]
