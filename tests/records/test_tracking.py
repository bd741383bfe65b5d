"""Logs of trainings that begin in a folder that has one."""

from src.records.tracking import keep_earlier_metrics


def test_the_log_of_an_earlier_training_gets_the_next_free_number(tmp_path):
    logs = tmp_path / "logs"
    keep_earlier_metrics(tmp_path)
    assert not logs.exists()
    logs.mkdir()
    (logs / "metrics.2.csv").write_text("second")
    for text in ("first", "third"):
        (logs / "metrics.csv").write_text(text)
        keep_earlier_metrics(tmp_path)
    found = {path.name: path.read_text() for path in logs.iterdir()}
    assert found == {"metrics.1.csv": "first", "metrics.2.csv": "second", "metrics.3.csv": "third"}
