"""A file is whole or not there."""

import os

import pytest

from src.records.atomic import atomic_path, write_text


def test_what_fails_leaves_what_was_there(tmp_path):
    write_text(tmp_path / "new" / "a.txt", "before")
    with pytest.raises(OSError, match="full"), atomic_path(tmp_path / "new" / "a.txt") as partial:
        partial.write_text("half")
        raise OSError("disk full")
    assert [(file.name, file.read_text()) for file in (tmp_path / "new").iterdir()] == [
        ("a.txt", "before")
    ]


def test_until_the_end_the_file_has_another_name(tmp_path):
    with atomic_path(tmp_path / "a.txt") as partial:
        partial.write_text("all")
        assert not (tmp_path / "a.txt").exists() and partial.suffix == ".partial"
    assert (tmp_path / "a.txt").read_text() == "all" and not partial.exists()


def test_of_two_processes_that_write_a_file_neither_takes_the_others(tmp_path, monkeypatch):
    with atomic_path(tmp_path / "a.txt") as first:
        first.write_text("first")
        with monkeypatch.context() as other:
            other.setattr(os, "getpid", lambda: -1)
            write_text(tmp_path / "a.txt", "second")
    assert [(file.name, file.read_text()) for file in tmp_path.iterdir()] == [("a.txt", "first")]
