"""Trainings in the minutes that a GPU can be had: python -m scripts.lease PLAN --minutes N

    python -m scripts.lease folder FOLDER conf/lease/default.yaml scenes=photos.pack  # gather
    python -m scripts.lease check FOLDER/plan.yaml --minutes 12     # does it fit?  Nothing is run
    python -m scripts.lease FOLDER/plan.yaml --minutes 12 [only=lf3x3,single256] [out=out/lease]
    python -m scripts.lease join out/lease [to=weights/mine]        # one file a network

One process checks the device, fills a pre-simulated turbulence cache in its memory and trains the
networks of PLAN, a file as conf/lease/default.yaml, in turn, each by wall time with the rate
brought to its end; it may be killed at any time, and what is in `out` is usable.  `join` makes of
that what `ckpt=` of src.train and `start` of a plan go on from.  `folder` gathers what a lease
needs, 60 MiB at most.  Minutes count from the start of the process; exit code 0: something was
trained, 1: nothing was, 2: the plan does not fit or is none.
"""

import signal
import sys
import time

BEGAN = time.monotonic()  # before the imports, which take seconds

from importlib.util import find_spec  # noqa: E402
from pathlib import Path  # noqa: E402

NEEDED = {  # by the names they are imported by
    "torch": "torch", "lightning": "lightning", "hydra": "hydra-core", "omegaconf": "omegaconf",
    "antlr4": "antlr4-python3-runtime", "torchmetrics": "torchmetrics", "numba": "numba",
    "cv2": "opencv-python-headless", "jaxtyping": "jaxtyping", "safetensors": "safetensors",
    "scipy": "scipy", "skimage": "scikit-image", "rich": "rich", "numpy": "numpy", "yaml": "pyyaml",
}  # fmt: skip
OUT, FOLDER_MIB = Path("out/lease"), 60


def main() -> None:
    """Read the command line."""
    words, options, minutes = _parsed(sys.argv[1:])
    if missing := [name for name in NEEDED if find_spec(name) is None]:
        install = " ".join(NEEDED[name] for name in missing)
        sys.exit(f"error: missing packages: {', '.join(missing)}; pip install {install}")
    try:
        sys.exit(_done(words, options, minutes))
    except ValueError as error:
        print("error: " + " ".join(str(error).split()), file=sys.stderr)
        sys.exit(2)
    except OSError as error:
        print(f"error: {error}", file=sys.stderr)
        sys.exit(1)
    except KeyboardInterrupt:  # before a training, which exports and ends
        sys.exit(128 + signal.SIGINT)


def _done(words: list[str], options: dict[str, str], minutes: float) -> int:
    """Do what the words ask for; return the exit code."""
    from scripts.lease import export, folder  # after the look for packages
    from scripts.lease import plan as plans
    from scripts.lease.fit import fit

    if words[0] == "join":
        made, lost = export.join(Path(words[1]), Path(options.get("to", words[1])))
        for line in [*map(folder.going_on, made), *(f"lost: {line}" for line in lost)]:
            print(line)
        return int(bool(lost))
    if words[0] == "folder":
        given = {key: Path(options[key]) for key in ("scenes", "lpips") if key in options}
        print(folder.gather(Path(words[1]), Path(words[2]), given, FOLDER_MIB))
        return 0
    plan = plans.load(Path(words[-1]))
    if "only" in options:
        plan = plan.only(options["only"].split(","))
    chosen = fit(plan, minutes)
    if words[0] == "check":
        print(folder.described(plan, chosen, minutes))
        return 0
    from scripts.lease.run import run

    return run(plan, chosen, minutes, BEGAN, Path(options.get("out", OUT)))


def _parsed(given: list[str]) -> tuple[list[str], dict[str, str], float]:
    """Return the words, the options key=value and the minutes."""
    given, minutes = list(given), 0.0
    if "--minutes" in given[:-1]:
        place = given.index("--minutes")
        minutes = _number(given[place + 1])
        del given[place : place + 2]
    words = [word for word in given if "=" not in word]
    options = dict(word.split("=", 1) for word in given if "=" in word)
    known = {"join": (2, {"to"}), "folder": (3, {"scenes", "lpips"}), "check": (2, {"only"})}
    count, keys = known.get(words[0] if words else "", (1, {"only", "out"}))
    timed = not words or words[0] not in ("join", "folder")
    if len(words) != count or set(options) - keys or timed != (minutes > 0):
        sys.exit(__doc__)
    return words, options, minutes


def _number(word: str) -> float:
    try:
        return float(word)
    except ValueError:
        return 0.0


if __name__ == "__main__":
    main()
