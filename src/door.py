"""What every door (train, eval, simulate ...) shares: one line for a wrong value, exit code 2."""

import sys
from collections.abc import Callable

from hydra.errors import HydraException
from omegaconf.errors import OmegaConfBaseException


def run(main: Callable[[], None]) -> None:
    """Call the Hydra entry point `main`; a wrong value ends in one line on stderr and exit code 2.

    `main` must be called with `HYDRA_FULL_ERROR=1` in effect (set below) so that the errors of the
    job reach us instead of being printed by Hydra with a traceback.
    """
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
