"""The counter of time of a file, which goes round."""

import numpy as np

NEARLY_A_TURN = 0.98  # of a counter's turn, by which a late event from before its end rises
LATE_EVENTS = 1000  # at most, of which one follows the other before the counter falls again


class TimestampUnwrapper:
    """A counter of `bits`, read in pieces: it went round where it falls by more than half.

    A rise of NEARLY_A_TURN or more after that is a late event, of the round before, where the
    counter falls again within LATE_EVENTS; else it is a silence.  `is_live`: it went round where it
    falls by more than NEARLY_A_TURN, as single wild times and a counter that starts again fall by
    less; late events of before the first round have times below 0."""

    def __init__(self, bits: int = 32, *, is_live: bool = False):
        self._bits, self._rounds = bits, 0
        self._last: int | None = None
        self._fall, self._first_round = (NEARLY_A_TURN, -1) if is_live else (0.5, 0)

    def unwrap(self, t: np.ndarray) -> np.ndarray:
        """Return the times (n,) as int64 with the rounds since the first piece."""
        times = t.astype(np.int64)
        if len(times):
            before = times[0] if self._last is None else self._last
            steps, turn = np.diff(times, prepend=before), 1 << self._bits
            self._last = int(times[-1])
            falls, rises = steps < -self._fall * turn, steps >= NEARLY_A_TURN * turn
            times += self._count_rounds(falls, _find_late(rises, falls)) * turn
        return times

    def _count_rounds(self, is_next: np.ndarray, is_before: np.ndarray) -> np.ndarray | int:
        """Return the rounds, from the first on, at events that begin the next or go back by one."""
        if not (is_next.any() or (self._rounds > self._first_round and is_before.any())):
            return self._rounds
        rounds = self._rounds + np.cumsum(is_next.astype(np.int64) - is_before)
        rounds -= np.minimum.accumulate(np.minimum(rounds - self._first_round, 0))
        self._rounds = int(rounds[-1])
        return rounds


def _find_late(rises: np.ndarray, falls: np.ndarray) -> np.ndarray:
    """Return the rises after which a counter falls, or the piece ends, within LATE_EVENTS."""
    if not rises.any():
        return rises
    at, ends = np.flatnonzero(rises), np.append(np.flatnonzero(falls), len(falls))
    late = np.zeros_like(rises)
    late[at] = ends[np.searchsorted(ends, at)] - at <= LATE_EVENTS
    return late
