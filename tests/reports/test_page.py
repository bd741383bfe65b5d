"""The HTML page: what it holds, what it links to, how large its pictures are."""

import io
from html.parser import HTMLParser

import numpy as np
from PIL import Image

from src.records import runs
from src.report import report
from src.reports import page
from tests.conftest import ROOT
from tests.reports.runs import clips_of, write_run, write_samples
from tests.reports.test_report import built
from tests.test_train import config

MEDIA = {"folder": ROOT, "media_bytes": 1 << 20}


class Seen(HTMLParser):
    """The tags and the addresses of a page; fails where a tag is left open."""

    def __init__(self, text: str):
        super().__init__()
        self.open, self.tags, self.addresses = [], [], []
        self.feed(text)

    def handle_starttag(self, tag, attrs):
        self.tags.append(tag)
        self.addresses += [value for key, value in attrs if key in ("src", "href")]
        if tag not in ("meta", "img"):
            self.open.append(tag)

    def handle_endtag(self, tag):
        assert self.open.pop() == tag


def test_the_page_needs_nothing_from_elsewhere_and_keeps_names_harmless(tmp_path):
    run = write_run(tmp_path / "a", "<script>alert(1)</script>{{body}}")
    write_samples(run)
    (tmp_path / "chart.svg").write_text("<svg xmlns='http://www.w3.org/2000/svg'/>")
    table, _, made = built(tmp_path)
    text = page.format_html(
        "t", [table], made, runs.find_charts_and_stress_maps([tmp_path]), commands=[], **MEDIA
    )
    seen = Seen(text)
    assert seen.open == [] and seen.tags.count("script") == 1 and seen.tags.count("img") == 3
    assert all(address.startswith("data:image/") for address in seen.addresses)


def test_what_is_no_number_is_sorted_as_missing(tmp_path):
    write_run(tmp_path / "a", scores={"ssim": float("nan")})
    table, _, made = built(tmp_path)
    text = page.format_html("t", [table], made, [], commands=[], **MEDIA)
    assert '<td class="" data-value="">nan</td>' in text


def test_a_chart_alone_makes_a_page(tmp_path):
    (tmp_path / "runs").mkdir()
    for suffix in ("png", "svg"):
        (tmp_path / "runs" / f"stress.{suffix}").write_text("<svg/>")
    assert report(config("report", tmp_path / "out", f"run={tmp_path / 'runs'}")) == []
    text = (tmp_path / "out" / "report.html").read_text()
    assert text.count("<img") == 1 and "data:image/svg+xml;base64" in text and "Stress" in text


def test_pictures_beyond_the_bound_are_links_to_their_files(tmp_path):
    run = write_run(tmp_path / "a & b")
    write_samples(run, size=64)
    table, _, made = built(tmp_path)
    folder = tmp_path / "out" / "report"
    options = {"folder": folder, "media_bytes": 100}
    seen = Seen(page.format_html("t", [table], made, [], commands=[], **options))
    assert "img" not in seen.tags and len(seen.addresses) == 2 and seen.open == []
    found = {(folder / address).resolve() for address in seen.addresses}
    assert found == {run / "samples" / name for name in ("clip0.gif", "clip0_slice.png")}


def test_a_film_in_the_page_is_small_and_has_all_its_frames(tmp_path):
    rng = np.random.default_rng(0)
    grey = np.kron(rng.integers(0, 255, (9, 20, 90), np.uint8), np.ones((1, 8, 16), np.uint8))
    films = [Image.fromarray(frame + rng.integers(0, 9, frame.shape, np.uint8)) for frame in grey]
    film = tmp_path / "clip0.gif"
    films[0].save(film, save_all=True, append_images=films[1:], duration=60, loop=0)
    content, kind = page.shrink_picture(film)
    assert kind == "image/webp" and len(content) < film.stat().st_size / 3
    with Image.open(io.BytesIO(content)) as shown:
        assert shown.n_frames == 9 and shown.size == (720, 80)
        shown.seek(4)
        wanted = films[4].resize((720, 80), Image.Resampling.BOX)
        error = np.subtract(shown.convert("L"), wanted, dtype=float)
        assert np.abs(error).mean() < 8
    drawing = tmp_path / "chart.svg"
    drawing.write_text("<svg/>" + " " * 2**17)
    assert page.shrink_picture(drawing) == (drawing.read_bytes(), "image/svg+xml")


def test_on_a_phone_only_tables_scroll_sideways(tmp_path):
    write_run(tmp_path / "a", clips=clips_of())
    report(config("report", tmp_path / "out", f"run={tmp_path / 'a'}"))
    text = (tmp_path / "out" / "report.html").read_text()
    assert 'name="viewport" content="width=device-width, initial-scale=1"' in text
    assert text.count("<table>") == text.count('<div class="wide"><table>') >= 2
    assert ".wide { overflow-x: auto }" in text
    assert "h1, h2, p, code, figcaption { overflow-wrap: anywhere }" in text
    assert "@media (pointer: coarse) { th button { padding: .7rem 0 } }" in text
