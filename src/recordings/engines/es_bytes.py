"""Bytes of Event Stream: one that begins an event has four more behind it, others stand alone."""

from numba import njit

LONE_DVS, LONE_ATIS = 0xFE, 0xFC


@njit(nogil=True, cache=True)
def count_events(block, missing, lone):
    """Return how many events without intensity end in `block` (n,) uint8, and how many bytes of the
    last one are missing after it; `missing`: those before it, below 0 of one with intensity.

    Bytes of `lone` or more begin no event: LONE_DVS or LONE_ATIS.
    """
    ended = 0
    for byte in block:
        if missing > 0:
            missing -= 1
            ended += missing == 0
        elif missing < 0:
            missing += 1
        elif byte < lone:
            missing = -4 if lone == LONE_ATIS and byte & 1 else 4
    return ended, missing
