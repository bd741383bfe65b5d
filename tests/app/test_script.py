"""Errors of scripts and benchmarks: one line, an exit code."""

import argparse

import pytest

from src.app.script import positive_number, run_script, whole_number


@pytest.mark.parametrize("error, code", [(ValueError("a\nb"), 2), (OSError("a\nb"), 1)])
def test_an_error_is_one_line(error, code, capsys):
    def main() -> None:
        raise error

    with pytest.raises(SystemExit) as stopped:
        run_script(main)
    assert stopped.value.code == code
    assert capsys.readouterr().err == "error: a b\n"


def test_another_error_is_not_hidden():
    with pytest.raises(ZeroDivisionError):
        run_script(lambda: 1 / 0)


@pytest.mark.parametrize("text", ["0", "-1", "1.5", "nan", "x", ""])
def test_a_number_that_is_not_whole_is_refused(text):
    with pytest.raises(argparse.ArgumentTypeError, match="whole number >= 1"):
        whole_number(text)
    assert whole_number("12") == 12


@pytest.mark.parametrize("text", ["0", "-1", "nan", "inf", "x"])
def test_a_number_that_is_not_positive_is_refused(text):
    with pytest.raises(argparse.ArgumentTypeError, match="> 0"):
        positive_number(text)
    assert positive_number("0.5") == 0.5
