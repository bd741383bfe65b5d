"""Scripts and benchmarks on the command line: errors in one line, numbers within their range."""

import argparse
import math
import signal
import sys
from collections.abc import Callable

from src.app import console


def run_script(main: Callable[[], None]) -> None:
    """Call `main`; a wrong value ends in one line on stderr and exit code 2.

    An error of a file that is not a matter of values (a full disk) ends in exit code 1.
    """
    try:
        main()
    except (ValueError, OSError) as error:
        console.exit_with_error(str(error), 1 if isinstance(error, OSError) else 2)
    except KeyboardInterrupt:
        sys.exit(128 + signal.SIGINT)


def whole_number(text: str) -> int:
    """Return a whole number >= 1, for argparse."""
    if not text.isdecimal() or int(text) < 1:
        raise argparse.ArgumentTypeError(f"must be a whole number >= 1, got {text}")
    return int(text)


def positive_number(text: str) -> float:
    """Return a finite number above 0, for argparse."""
    try:
        value = float(text)
    except ValueError:
        value = 0.0
    if not 0 < value < math.inf:
        raise argparse.ArgumentTypeError(f"must be a number > 0, got {text}")
    return value
