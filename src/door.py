"""What every door (train, eval, simulate ...) shares: one line for a wrong value, exit code 2."""

import os
import sys
from collections.abc import Callable

from hydra.errors import HydraException
from omegaconf.errors import OmegaConfBaseException


def run(main: Callable[[], None]) -> None:
    """Call the Hydra entry point `main`; a wrong value ends in one line on stderr and exit code 2.

    `HYDRA_FULL_ERROR=1` makes Hydra hand the errors of the job to us instead of printing them.
    """
    os.environ["HYDRA_FULL_ERROR"] = "1"
    try:
        main()
    except (ValueError, HydraException, OmegaConfBaseException) as error:
        sys.exit(_refuse(error))
    except KeyboardInterrupt:
        sys.exit(130)


def _refuse(error: Exception) -> int:
    cause = error.__cause__ if isinstance(error, HydraException) and error.__cause__ else error
    print("error: " + " ".join(str(cause).split()), file=sys.stderr)
    return 2
