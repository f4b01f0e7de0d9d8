"""Pages and docstrings are written in short sentences with plain words."""

import pytest

from .language import faults, sentences_of_code, sentences_of_page
from .pages import PAGES, ROOT, name_of

CODE = sorted((ROOT / "sglpr_jax").rglob("*.py"))


@pytest.mark.parametrize("page", PAGES, ids=name_of)
def test_sentences_of_pages_are_short_and_plain(page):
    assert not faults(sentences_of_page(page))


@pytest.mark.slow
def test_sentences_of_docstrings_are_short_and_plain():
    assert not faults(sentence for path in CODE for sentence in sentences_of_code(path))


def test_faults_are_found():
    long = "word " * 36
    assert len(faults([f"{long}.", "It is told."])) == 3
