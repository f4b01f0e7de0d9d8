"""HTML page of an evaluation across sessions: table of sessions, then rule and counts of each score."""

from html import escape

from sglpr_jax.evaluation.page.document import Section, document, html_table
from sglpr_jax.evaluation.page.sections import results_section
from sglpr_jax.evaluation.sessions import PUBLISHED_NOTE, AcrossSessions


def sessions_page(found: AcrossSessions) -> str:
    """Return the page as HTML, with the rows of table 3 if the evaluation has them."""
    note = f"\n<p class='about'>{escape(PUBLISHED_NOTE)}</p>" if found.published else ""
    table = html_table(found.columns, found.rows() + list(found.published), numbers=found.columns[1:])
    return document(found.title, found.about, [Section("Sessions", table + note), results_section(found.results)])
