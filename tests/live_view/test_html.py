"""The page without a browser: its ids, width on a phone, fingers, nothing from elsewhere."""

import re

import pytest

from src.live_view.page_server import HTML

PAGE = HTML.read_text()
STYLE, SCRIPT = (re.search(f"<{tag}>(.*?)</{tag}>", PAGE, re.S)[1] for tag in ("style", "script"))
IDS = re.findall(r'\bid="([\w-]+)"', PAGE)


def rules(condition: str) -> str:
    """The rules of the style under a media query."""
    return re.search(rf"@media \({re.escape(condition)}\) \{{(.*?)\n}}", STYLE, re.S)[1]


def test_ids_are_unique_and_those_of_script_and_style_are_there():
    assert len(set(IDS)) == len(IDS)
    named = re.findall(r'(?:\$|\btext)\("([\w-]+)"', SCRIPT) + re.findall(
        r"#([\w-]+)[^;}]*\{", STYLE
    )
    assert len(named) > 40 and set(named) <= set(IDS)
    pictures = {"frame", "one-view", "events", "views", "slice"}
    assert pictures == set(re.findall(r'<canvas id="([\w-]+)"', PAGE))


def test_nothing_is_wider_than_a_phone():
    assert 'name="viewport" content="width=device-width, initial-scale=1"' in PAGE
    assert "canvas { display: block; width: 100%; height: auto }" in STYLE
    assert "main { grid-template-columns: minmax(0, 1fr) }" in rules("max-width: 900px")
    assert ".pictures { grid-template-columns: minmax(0, 1fr) }" in rules("max-width: 560px")


def test_fingers_reach_controls_and_scroll_over_the_picture():
    assert "label.tick { min-height: 2.75rem }" in rules("pointer: coarse")
    assert re.search(r"#line \{[^}]*touch-action: pan-y", STYLE)
    assert re.search(r'"touchstart".*grabbed < 3.*preventDefault.*passive: false', SCRIPT)


@pytest.mark.parametrize("address", ["http://", "https://", "src=", "@import"])
def test_nothing_is_loaded_from_elsewhere(address):
    assert address not in PAGE
