"""The site names every page of docs/ once, what it names is there; without MkDocs, which CI has."""

import pkgutil
import re
from itertools import chain

import yaml

import lightfield_events
from tests.conftest import ROOT

REFERENCE = sorted((ROOT / "docs" / "reference").glob("*.md"))


class Loader(yaml.SafeLoader):
    """Reads tags of MkDocs, such as !ENV, as None."""


Loader.add_multi_constructor("!", lambda *_: None)
SITE = yaml.load((ROOT / "mkdocs.yml").read_text(), Loader)
NAMES = [re.findall(r"^::: (\S+)$", page.read_text(), re.M) for page in REFERENCE]


def entries(nav) -> list[str]:
    """The pages of a navigation, in order."""
    if isinstance(nav, str):
        return [nav]
    parts = nav.values() if isinstance(nav, dict) else nav
    return list(chain.from_iterable(map(entries, parts)))


def test_every_page_is_in_the_navigation_once_and_every_entry_is_a_page():
    docs, extra = ROOT / "docs", SITE["extra"]
    pages = [page.relative_to(docs).as_posix() for page in docs.rglob("*.md")]
    lists = [f"{folder.removeprefix('docs/')}/index.md" for folder in extra["lists"]]
    assert sorted(entries(SITE["nav"])) == sorted([*pages, *extra["pages"].values(), *lists])
    sources = [*extra["pages"], *extra["lists"], *SITE["hooks"], "docs/" + SITE["extra_css"][0]]
    assert [source for source in sources if not (ROOT / source).exists()] == []


def test_the_reference_names_what_is_there():
    names = list(chain.from_iterable(NAMES))
    assert len(names) > 50 and len(set(names)) == len(names)
    for name in names:
        assert pkgutil.resolve_name(name).__doc__, name


def test_all_public_names_are_in_the_reference():
    page = (ROOT / "docs/reference/package.md").read_text()
    shown = re.findall(r"^::: lightfield_events\.(\w+)$", page, re.M)
    assert sorted(shown) == sorted(lightfield_events.__all__)


def test_commands_are_wrapped_and_outputs_of_notebooks_are_not():
    style, hook = (ROOT / "docs" / SITE["extra_css"][0]).read_text(), SITE["hooks"][0]
    assert {"pymdownx.highlight": {"pygments_lang_class": True}} in SITE["markdown_extensions"]
    assert ":is(.language-text, .language-sh) code { white-space: pre-wrap; }" in style
    assert 'return f"```output' in (ROOT / hook).read_text()
