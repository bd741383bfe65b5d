"""Blocks of Prophesee's EVT2, EVT2.1 and EVT3 to events, block by block of one recording."""

import numpy as np

from src.recordings.engines import evt_words
from src.recordings.files.event_file import RawEvents

WORD_BYTES = {"evt2": 4, "evt21": 8, "evt3": 2}
MOST_EVENTS = {"evt2": 1, "evt21": 32, "evt3": 12}  # of a word
WORD_ORDERS = ("little", "legacy", "big")  # of EVT2.1; legacy: the halves exchanged
EVT21_KINDS = (0, 1, 8, 10, 14, 15)  # of words, of EVT2 too
EVT3_KINDS = (0, 2, 3, 4, 5, 6, 7, 8, 10, 14, 15)
FEW_KNOWN, MOST_KNOWN = 0.9, 0.99  # of the words: below and above they are of another format
# Of the last words of a block: more of no kind, and of so many kinds or so large a share, are no
# words, as after a byte that is lost.  Words of a kind that only a camera knows are few.
LAST_WORDS, MOST_STRANGE, STRANGE_SHARE = 2**12, 0.01, 0.3
STRANGE_KINDS = {"evt2": 3, "evt21": 2, "evt3": 3}


class EvtDecoder:
    """A decoder of `kind` evt2, evt21 or evt3 that goes on where the last block ended.

    `order` is that of EVT2.1's words, little, legacy or big; None: the one that shows in the first
    block.
    """

    def __init__(self, kind: str, order: str | None = None):
        self.kind, self._order = kind, order
        self._state = evt_words.new_decoder_state()

    @property
    def triggers(self) -> int:
        """Return how many words of triggers came so far."""
        return int(self._state[evt_words.TRIGGERS])

    @property
    def lost(self) -> int:
        """Return how many events came before the first time, which were left out."""
        return int(self._state[evt_words.LOST])

    def decode(self, whole_words: bytes) -> RawEvents:
        """Return the events of little-endian words, times in microseconds."""
        room = len(whole_words) // WORD_BYTES[self.kind] * MOST_EVENTS[self.kind]
        events = [np.empty(room, kind) for kind in ("i8", "u2", "u2", "i1")]
        if self.kind == "evt3":
            count = evt_words.decode_evt3(np.frombuffer(whole_words, "<u2"), self._state, *events)
        else:
            count = evt_words.decode_evt2_and_21(*self._halves(whole_words), self._state, *events)
        return RawEvents(*(part[:count] for part in events))

    def count_valid_words(self, whole_words: bytes) -> int:
        """Return how many words come before the first one of no kind, where the last ones are no
        words; else all."""
        is_evt3 = self.kind == "evt3"
        words = np.frombuffer(whole_words, "<u2") if is_evt3 else self._halves(whole_words)[0]
        known, kind_at = np.array(EVT3_KINDS if is_evt3 else EVT21_KINDS), 12 if is_evt3 else 28
        last = words[-LAST_WORDS:] >> kind_at
        strange = last[~np.isin(last, known)]
        share, kinds = len(strange) / max(len(last), 1), len(np.unique(strange))
        if share <= MOST_STRANGE or (kinds < STRANGE_KINDS[self.kind] and share < STRANGE_SHARE):
            return len(words)
        return int(np.isin(words >> kind_at, known).argmin())

    def _halves(self, block: bytes) -> tuple[np.ndarray, np.ndarray]:
        """Return the upper and lower 32 bits of each word, of EVT2 the word and a mask of one."""
        if self.kind == "evt2":
            words = np.frombuffer(block, "<u4")
            return words, np.broadcast_to(np.uint32(1), words.shape)
        pairs = np.frombuffer(block, "<u4").reshape(-1, 2)
        legacy, little, big = pairs[:, 0], pairs[:, 1], pairs[:, 0].byteswap()
        if self._order is None:
            known = {"little": little, "legacy": legacy, "big": big}
            self._order = max(known, key=lambda name: _count_known(known[name]))
        if self._order == "big":
            return big, pairs[:, 1].byteswap()
        return (little, legacy) if self._order == "little" else (legacy, little)


def find_shown_kind(block: bytes, kind: str) -> str:
    """Return evt2 or evt3 where the words of `block` are of it and not of `kind`, the other one;
    else `kind`."""
    block = block[: len(block) // 4 * 4]
    if kind == "evt21" or not block:
        return kind
    known = {
        "evt2": np.isin(np.frombuffer(block, "<u4") >> 28, EVT21_KINDS).mean(),
        "evt3": np.isin(np.frombuffer(block, "<u2") >> 12, EVT3_KINDS).mean(),
    }
    other = "evt3" if kind == "evt2" else "evt2"
    return other if known[kind] < FEW_KNOWN and known[other] > MOST_KNOWN else kind


def _count_known(heads: np.ndarray) -> tuple[int, int]:
    """Return how many words have a kind that there is, and how many are times."""
    kinds = heads >> 28
    return int(np.isin(kinds, EVT21_KINDS).sum()), int((kinds == evt_words.TIME).sum())
