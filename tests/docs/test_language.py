"""Every page is written in short sentences with plain words."""

import pytest

from .language import faults
from .pages import PAGES, name_of


@pytest.mark.parametrize("page", PAGES, ids=name_of)
def test_sentences_are_short_and_plain(page):
    assert not faults(page)
