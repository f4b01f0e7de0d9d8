"""The page of an evaluation across sessions: the table of sessions, then what each number rests on."""

from html import escape

from sglpr_jax.evaluation.page.document import Section, document, html_table
from sglpr_jax.evaluation.page.sections import results_section
from sglpr_jax.evaluation.sessions import PUBLISHED_NOTE, AcrossSessions


def sessions_page(found: AcrossSessions, *, title: str, about: str, published: bool) -> str:
    """Return the page as HTML, with the rows of table 3 where `published`; see `published_rows` for its errors."""
    rows = found.rows() + (found.published_rows() if published else [])
    note = f"\n<p class='about'>{escape(PUBLISHED_NOTE)}</p>" if published else ""
    table = html_table(found.columns, rows, numbers=found.columns[1:])
    results = [result for of_one in found.protocols.values() for result in of_one]
    return document(title, about, [Section("Sessions", table + note), results_section(results)])
