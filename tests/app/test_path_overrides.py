"""Paths reach the entry point as they were typed; two jobs of a sweep never share a folder."""

import math
import os
import subprocess
import sys
from pathlib import Path

import pytest
from hydra.core.override_parser.overrides_parser import OverridesParser

from src.app.path_overrides import (
    MAX_FOLDER_BYTES,
    name_job_folder,
    quote_paths,
    refuse_empty_paths,
    unquote_override,
)
from tests.conftest import ROOT
from tests.test_entry_points import run_here

NAMES = [
    "größe.txt", "cap (1).txt", "run=3.txt", "cap#1.txt", "a,b.txt", "it's.txt", 'a"b.txt',
    "日本 語.raw", "2026_11_26", "20261126", "1", "true", "1e3", "[x].raw", "{a: b}", "a\\b", "a\\",
    "it\\'s", " x ",
]  # fmt: skip


def parsed(override: str):
    return OverridesParser.create().parse_override(override)


@pytest.mark.parametrize("name", NAMES)
def test_a_path_is_what_was_typed(name):
    (override,) = quote_paths([f"scene.root={name}"], "simulate")
    assert parsed(override).value() == name
    assert unquote_override(override) == f"scene.root={name}"


@pytest.mark.parametrize(
    ("typed", "value"),
    [
        (
            "videos=[a b.mp4,it's.h5,20261126,'x,y.h5']",
            ["a b.mp4", "it's.h5", "20261126", "x,y.h5"],
        ),
        ("recording='a b'", "a b"),
        ("views=null", None),
        ("ckpt=", ""),
        ("recording=~/cap.raw", str(Path.home() / "cap.raw")),
        ("still=1", "1"),
        ("optics.views=9", 9),
        ("fps=120", 120),
        ("end_s=.inf", math.inf),
        ("end_s=inf", math.inf),
    ],
)
def test_lists_null_home_and_other_keys(typed, value):
    (override,) = quote_paths([typed], "calibrate")
    assert parsed(override).value() == value


@pytest.mark.parametrize(
    ("typed", "values"),
    [
        ("recording=x/a b.txt,x-a.txt,'a,b.txt'", ["x/a b.txt", "x-a.txt", "a,b.txt"]),
        ("ckpt=[a,b],[c,1]", [["a", "b"], ["c", "1"]]),
    ],
)
def test_in_a_sweep_a_comma_separates(typed, values):
    _, override = quote_paths(["-m", typed], "chart")
    key = typed.split("=")[0]
    lines = parsed(override).sweep_string_iterator()
    assert [parsed(f"{key}={line}").value() for line in lines] == values


def test_a_sweep_that_its_config_asks_for_is_one():
    sweep = ["--config-dir", str(ROOT / "sweeps"), "--config-name", "views", "ckpt=a,b"]
    assert quote_paths(sweep, "eval")[-1] == "ckpt='a','b'"
    assert quote_paths(["ckpt=a,b"], "eval") == ["ckpt='a,b'"]


def test_names_of_jobs_differ_as_their_overrides_do():
    jobs = [
        ["recording='x/a.txt'"],
        ["recording='x-a.txt'"],
        ["a=b_c=d", "c=e"],
        ["a=b", "c=d_c=e"],
    ]
    jobs += [["ckpt=['a','b']"], ["ckpt=['a,b']"], ["ckpt=['a b','c']"], ["ckpt=['a b,c']"]]
    jobs += [[f"a={'ü' * 300}x"], [f"a={'ü' * 300}y"]]
    names = [name_job_folder(job) for job in jobs]
    assert len(set(names)) == len(jobs) and not set("".join(names)) & set("/='")
    assert all(len(name.encode()) <= MAX_FOLDER_BYTES for name in names)
    plain = ["seed=0", "experiment=lf3x3", "paths.out='o'"]
    assert name_job_folder(plain) == "experiment-lf3x3_seed-0"


@pytest.mark.parametrize(
    ("job", "name"),
    [
        (["turbulence.atmosphere.tilt_and_blur_px.strong=[2.0,2.0]", "method=lf3x3"],
         "method-lf3x3_strong-[2.0,2.0]_"),
        (["turbulence.atmosphere.tilt_correlation_half_length_px=[7,7]", "method=lf3x3",
          "turbulence.atmosphere.tilt_and_blur_px.strong=[2.0,2.0]"], "lf3x3_[2.0,2.0]_[7,7]_"),
        (["ckpt='/data/runs/one'", "turbulence.atmosphere.tilt_and_blur_px.strong=[2.0,2.0]"],
         "ckpt--data-runs-one_strong-[2.0,2.0]_"),
        ([f"ckpt='/data/{'r' * 99}'"], f"{'r' * 40}_"),
        (["ckpt='lf3x3'", "turbulence=none",
          "scene.root=['/data/photographs/a','/data/photographs/b']"],
         "lf3x3_-data-photographs-a,-data-photographs-b_none_"),
        (["method=lf3x3", "scene.root=['../shared/data/photos/bsds500_val']"],
         "lf3x3_[..-shared-data-photos-bsds500_val]_"),
    ],
)  # fmt: skip
def test_a_long_job_has_a_short_name_that_says_what_is_varied(job, name):
    made = name_job_folder(job)
    assert made.startswith(name) and len(made) == len(name) + 8 <= 60


@pytest.mark.parametrize("locale", [{"PYTHONIOENCODING": "latin-1"}, {"PYTHONIOENCODING": "ascii"}])
def test_a_console_of_few_signs_ends_no_job(locale, tmp_path):
    text = "from src.app import console; console.prepare_streams(); print('größe • ━ ↑ 日')"
    done = subprocess.run(
        [sys.executable, "-c", text], cwd=ROOT, env=os.environ | locale, capture_output=True
    )
    assert done.returncode == 0 and done.stdout.endswith(b" * - ^ ?\n")


@pytest.mark.parametrize(
    "typed", ["photo=", "views=''", '+scene.root=""', "paths.out= ", "hydra.run.dir=", "ckpt="]
)
def test_an_empty_path_is_refused(typed):
    key = typed.partition("=")[0].lstrip("+")
    with pytest.raises(ValueError, match=f"^{key} must be a path, got ''$"):
        refuse_empty_paths(quote_paths(["seed=1", typed], "simulate"), "simulate")


@pytest.mark.parametrize("typed", ["title=", "logger.csv.name=''", "photo=null", "fps=", "still="])
def test_what_is_no_path_may_be_empty(typed):
    refuse_empty_paths(quote_paths([typed], "report"), "report")


def test_an_empty_folder_of_runs_is_refused_before_it_is_made(capsys, monkeypatch):
    monkeypatch.setattr("pathlib.Path.mkdir", None)
    assert run_here("simulate", "paths.out=") == 2
    assert capsys.readouterr().err == "error: paths.out must be a path, got ''\n"
