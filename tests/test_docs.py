"""Pages are short, their links lead somewhere, and their words are those of the glossary."""

import re
from pathlib import Path

import pytest

from tests.conftest import ROOT

LIMITS = {  # words, as `wc -w` counts them
    "README.md": 1000,
    "CONTRIBUTING.md": 600,
    "docs/results.md": 1500,
    "docs/training.md": 1200,
    "docs/simulation.md": 3500,
    "docs/reliability.md": 500,
    "docs/benchmarks.md": 1100,
}
DECISIONS = sorted((ROOT / "docs" / "decisions").iterdir())
DECISION_WORDS = 350
LINE = 160  # characters, outside tables and code
PAGES = [*ROOT.glob("*.md"), *(ROOT / "docs").rglob("*.md")]
BANNED = (  # private words of former versions
    r"nine views less one", r"answers? alike", r"not kept", r"\bof ours\b", r"what lies around",
    r"bank of air", r"\brooms?\b", r"\bdoors?\b", r"\bwobbl\w*", r"\bcalm\b", r"\bawake\b",
    r"\bbrackets\b", r"strong air\b", r"\bwanders?\b", r"falls? asleep", r"\bwe\b",
)  # fmt: skip
LINK = re.compile(r"!?\[[^\]]*\]\(([^)\s]+)\)")


def prose(page: Path) -> str:
    """The text of a page without code."""
    text = re.sub(r"^```.*?^```$", "", page.read_text(), flags=re.M | re.S)
    return re.sub(r"^    .*$", "", text, flags=re.M)


def anchors(page: Path) -> set[str]:
    """The anchors of a page's headings, as GitHub makes them."""
    heads = re.findall(r"^#+ (.+)$", prose(page), re.M)
    return {re.sub(r"[^\w\- ]", "", head.lower()).replace(" ", "-") for head in heads}


@pytest.mark.parametrize("page", LIMITS)
def test_a_page_is_short(page):
    assert len((ROOT / page).read_text().split()) <= LIMITS[page]


def test_decisions_are_few_and_of_one_screen():
    assert len(DECISIONS) <= 12
    lengths = {page.name: len(page.read_text().split()) for page in DECISIONS}
    assert {name: words for name, words in lengths.items() if words > DECISION_WORDS} == {}


@pytest.mark.parametrize("page", PAGES, ids=lambda page: str(page.relative_to(ROOT)))
def test_a_page_reads_well(page):
    lines = [line for line in prose(page).splitlines() if not line.startswith("|")]
    assert [line for line in lines if len(line) > LINE] == []
    assert [word for word in BANNED if re.search(word, prose(page), re.I)] == []


@pytest.mark.parametrize("page", PAGES, ids=lambda page: str(page.relative_to(ROOT)))
def test_links_of_a_page_lead_somewhere(page):
    lost = []
    for link in LINK.findall(prose(page)):
        if "://" in link:
            continue
        path, _, anchor = link.partition("#")
        target = (page.parent / path).resolve() if path else page
        if not target.exists() or (anchor and anchor not in anchors(target)):
            lost.append(link)
    assert lost == []


def test_pages_name_modules_that_are_there():
    module = re.compile(r"python -m (src\.\w+)|\b((?:scripts|benchmarks)\.(?!md\b)[a-z]\w*)")
    for page in set(PAGES) - {ROOT / "CHANGELOG.md"}:  # which also names what is gone
        for names in module.findall(page.read_text()):
            path = ROOT / "".join(names).replace(".", "/")
            assert path.with_suffix(".py").is_file() or path.is_dir(), f"{page.name}: {path}"


@pytest.mark.parametrize("page", PAGES, ids=lambda page: str(page.relative_to(ROOT)))
def test_commands_of_a_page_can_be_pasted(page):
    text = page.read_text()
    used, known = re.findall(r"\$([A-Z])\b", text), re.findall(r"^    ([A-Z])=", text, re.M)
    assert set(used) <= set(known)
    assert re.findall(r"python -m [^`\n]* P(?=[ `]|$)", text, re.M) == []


def test_sources_name_pages_that_are_there():
    """Paths of docs in code and configs, whole or as docs/decisions/NN."""
    for folder in ("src", "baselines", "scripts", "benchmarks", "conf", "sweeps"):
        for file in (ROOT / folder).rglob("*"):
            if file.suffix not in (".py", ".yaml"):
                continue
            for name in re.findall(r"docs/[\w./-]*\w", file.read_text()):
                assert list(ROOT.glob(f"{name}*")), f"{file}: {name}"


def test_every_term_of_the_glossary_stands_once():
    rows = re.findall(r"^\| ([^|]+?) \|", (ROOT / "docs" / "glossary.md").read_text(), re.M)
    terms = [row for row in rows if row not in ("term", "---")]
    assert 80 <= len(terms) <= 130 and len(set(terms)) == len(terms)
