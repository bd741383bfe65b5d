"""One table of metrics: what is computed is named in it, and it needs no PyTorch."""

import subprocess
import sys

from src.metrics.table import METRICS, NAMES
from src.metrics.video_metrics import VideoMetrics
from tests.conftest import ROOT


def test_every_metric_that_is_computed_has_a_line():
    assert {*VideoMetrics(), "lpips"} == set(NAMES) and len(NAMES) == len(set(NAMES))


def test_the_line_says_how_a_value_is_written():
    temporal_jitter_px = METRICS[-1]
    assert (
        temporal_jitter_px.format_value(1.236) == "1.24"
        and temporal_jitter_px.title == "temporal jitter px ↓"
        and temporal_jitter_px.format_value(None) == "-"
    )


def test_a_report_loads_no_training_stack():
    code = "import sys, src.reports.tables; print(*sys.modules)"
    run = [sys.executable, "-c", code]
    loaded = subprocess.run(run, cwd=ROOT, capture_output=True, text=True, check=True).stdout
    assert not {"torch", "lightning"} & set(loaded.split())
