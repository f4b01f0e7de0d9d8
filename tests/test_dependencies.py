"""What is installed beside the package: lowest versions, the versions of CI, and licences."""

import importlib
import re
from pathlib import Path

import pytest
from packaging.utils import canonicalize_name

ROOT = Path(__file__).resolve().parents[1]
LOCK = (ROOT / ".ci" / "constraints.txt").read_text()
LOCKED = dict(line.split("==") for line in LOCK.splitlines())
COPYLEFT = re.compile(
    r"GPL|General Public|Affero|MPL|Mozilla|EUPL|CDDL|EPL|Eclipse|OSL|CeCILL|SSPL|CC-BY", re.IGNORECASE
)


@pytest.fixture
def dependencies(monkeypatch):
    """The program that CI asks."""
    monkeypatch.syspath_prepend(str(ROOT / ".ci"))
    return importlib.import_module("dependencies")


@pytest.fixture
def licences(dependencies, monkeypatch):
    """The program that makes the page."""
    monkeypatch.syspath_prepend(str(ROOT / "docs" / "generate"))
    return importlib.import_module("licences")


def test_everything_named_has_a_lowest_version_that_it_allows(dependencies):
    for need in dependencies.all_named():
        assert dependencies.lowest(need) in need.specifier, need


def test_ci_installs_versions_that_are_allowed_and_says_from_nowhere(dependencies):
    """PyTorch is in none of the extras that CI installs."""
    needs = [need for extra in (None, *dependencies.EXTRAS) if extra != "torch" for need in dependencies.named(extra)]
    for need in needs:
        assert LOCKED[canonicalize_name(need.name)] in need.specifier, need
    assert all(re.fullmatch(r"[a-z0-9-]+==[\w.+!]+", line) for line in LOCK.splitlines())


def test_the_page_of_licences_names_all_that_is_installed(dependencies, licences):
    rows = re.findall(r"^\| ([a-z0-9-]+) \| (\S+) \| (.+) \|$", licences.licences_page(), re.MULTILINE)
    found = {name: version for name, version, _ in rows}
    expected = dependencies.installed(dependencies.all_named())
    assert {name: found.get(name) for name in expected} == {name: one.version for name, one in expected.items()}


def test_nothing_that_is_required_is_copyleft(dependencies, licences):
    said = {name: licences.licence_of(one) for name, one in dependencies.installed(dependencies.named()).items()}
    assert len(said) > 12
    assert not {name: licence for name, licence in said.items() if COPYLEFT.search(licence) or licence == "none named"}
