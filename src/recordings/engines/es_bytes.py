"""Bytes of Event Stream: one that begins an event has four more behind it, others stand alone."""

from numba import njit


@njit(nogil=True, cache=True)
def count_missing_bytes(block, missing, lone):
    """Return how many bytes of its last event are missing after `block` (n,) uint8, before which
    `missing` were; bytes of `lone` or more begin no event."""
    for byte in block:
        if missing:
            missing -= 1
        elif byte < lone:
            missing = 4
    return missing
