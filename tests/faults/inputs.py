"""Broken files by the thousand, read in a process that is watched.

The reader's process has a bound on memory and on time, and an audit hook that sees what is opened
for writing, started or unpickled.  What it may do with a file is read it or refuse it by a
ValueError; anything else counts as a crash, and so does its death.
"""

import os
import resource
import shutil
import sys
import tempfile
import traceback
import warnings
from collections.abc import Callable
from pathlib import Path

from hypothesis import strategies as st

from tests.faults.harness import FORKS, SLOWEST

MEMORY_BYTES = 2 << 30  # beyond what the process holds before it reads
SECONDS = 20.0  # of computing, for one file
FORBIDDEN = (
    "os.system",
    "os.exec",
    "os.posix_spawn",
    "os.fork",
    "subprocess.Popen",
    "socket.connect",
)
TELLING = [b"\x00", b"\xff", b"\x00\x00\x00\x00", b"\xff\xff\xff\xff", b"\x7f\xff\xff\xff", b"-1"]
TELLING += [
    b"nan",
    b"1e999",
    b"9" * 30,
    b"[" * 40,
    b"{",
    b"\n",
    b"%",
    b"../",
    b"&a *a",
    b"!!",
    b".",
]


def mutations() -> st.SearchStrategy:
    """Return a strategy of lists of (kind, place in 0..1, length, bytes)."""
    piece = st.one_of(st.sampled_from(TELLING), st.binary(min_size=1, max_size=12))
    kind = st.sampled_from(["overwrite", "insert", "remove", "repeat", "cut", "flip"])
    one = st.tuples(kind, st.floats(0, 1), st.integers(1, 64), piece)
    return st.lists(one, min_size=1, max_size=6)


def mutate(data: bytes, changes: list[tuple]) -> bytes:
    """Return `data` with the changes of `mutations` made one after the other."""
    for kind, share, length, piece in changes:
        at = int(share * len(data))
        if kind == "overwrite":
            data = data[:at] + piece + data[at + len(piece) :]
        elif kind == "insert":
            data = data[:at] + piece + data[at:]
        elif kind == "remove":
            data = data[:at] + data[at + length :]
        elif kind == "repeat":
            data = data[:at] + data[at : at + length] * (1 + len(piece)) + data[at + length :]
        elif kind == "cut":
            data = data[: max(1, at)]
        elif at < len(data):
            data = data[:at] + bytes([data[at] ^ (1 << length % 8)]) + data[at + 1 :]
    return data or b"\n"


class Reader:
    """`read(path)` in a process of its own, that is started again when it dies."""

    def __init__(self, suffix: str, read: Callable[[Path], object]):
        self.suffix, self.read = suffix, read
        self.tried = self.refused = 0
        self.process = None

    def __enter__(self) -> "Reader":
        return self

    def __exit__(self, *error) -> None:
        self._end()

    def __call__(self, content: bytes) -> str:
        """Return what came of a file of that content: `read` or `refused`; else AssertionError."""
        if self.process is None:
            self.pipe, theirs = FORKS.Pipe()
            self.process = FORKS.Process(target=serve, args=(theirs, self.suffix, self.read))
            self.process.start()
            theirs.close()
            assert self.pipe.poll(SLOWEST) and self.pipe.recv() == "ready"
        self.tried += 1
        begun = self._computed()
        self.pipe.send_bytes(content)
        try:
            while not self.pipe.poll(1.0):
                busy = self._computed() - begun
                assert busy < SECONDS, f"the reader hangs on {content[:150]!r}"
            verdict = self.pipe.recv()
        except (EOFError, ConnectionError):
            self.process.join()
            code, self.process = self.process.exitcode, None
            raise AssertionError(f"the reader died with {code} of {content[:150]!r}") from None
        except AssertionError:
            self._end()
            raise
        assert verdict in ("read", "refused"), f"{verdict} of {content[:150]!r}"
        self.refused += verdict == "refused"
        return verdict

    def _computed(self) -> float:
        """Return the seconds that the reader has computed: a busy machine is no hang."""
        try:
            words = Path(f"/proc/{self.process.pid}/stat").read_text().rpartition(")")[2].split()
        except OSError:
            return 0.0
        return (int(words[11]) + int(words[12])) / os.sysconf("SC_CLK_TCK")

    def _end(self) -> None:
        if self.process is not None:
            self.process.kill()
            self.process.join()
            self.process = None

    def tell(self, name: str) -> None:
        """Print the counts in one line."""
        print(f"{name}: {self.tried} inputs tried, {self.refused} refused, 0 crashes")


def serve(pipe, suffix: str, read: Callable[[Path], object]) -> None:
    """Read what comes through `pipe` and answer with verdicts until it closes."""
    null = os.open(os.devnull, os.O_WRONLY)
    os.dup2(null, 1)
    os.dup2(null, 2)
    warnings.simplefilter("ignore")
    folder = Path(tempfile.mkdtemp())
    path = folder / f"a{suffix}"
    seen: list[str] = []
    _warm(read, path)
    sys.addaudithook(lambda event, args: _watch(event, args, folder, seen))
    held = int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()
    resource.setrlimit(resource.RLIMIT_AS, (held + MEMORY_BYTES, resource.RLIM_INFINITY))
    try:
        pipe.send("ready")
        while True:
            path.write_bytes(pipe.recv_bytes())
            seen.clear()
            pipe.send(_verdict(read, path, seen))
    except (EOFError, ConnectionError):
        shutil.rmtree(folder, ignore_errors=True)


def _warm(read: Callable[[Path], object], path: Path) -> None:
    """Let the reader import what it imports late, before anything is watched."""
    path.write_bytes(b"x")
    _verdict(read, path, [])


def _watch(event: str, args: tuple, folder: Path, seen: list[str]) -> None:
    if event == "open" and isinstance(args[0], str) and isinstance(args[2], int):
        writes = args[2] & (os.O_WRONLY | os.O_RDWR)
        compiled = "__pycache__" in args[0]  # numba's
        if writes and not compiled and not args[0].startswith(str(folder)):
            seen.append(f"wrote to {args[0]}")
    elif event.startswith(FORBIDDEN):
        seen.append(f"{event} {args[:1]}")


def _verdict(read: Callable[[Path], object], path: Path, seen: list[str]) -> str:
    try:
        read(path)
        verdict = "read"
    except ValueError as error:
        verdict = "refused" if str(error) else "a refusal without a word"
    except BaseException:
        verdict = "failed: " + traceback.format_exc()[-900:]
    return f"escaped: {seen}" if seen else verdict
