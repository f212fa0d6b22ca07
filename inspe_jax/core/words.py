"""Words in messages and on pages: numbers of things, and names that users give."""

import re
import unicodedata

_HIDDEN = re.compile(
    "[\x00-\x08\x0b-\x1f\x7f-\x9f\u2028-\u202e\u2066-\u2069\ud800-\udfff\ufffe\uffff]"
)
_RIGHT_TO_LEFT = ("R", "AL", "AN")
_MARKS = "\u200e\u200f\u061c"


def counted(count: int, what: str) -> str:
    """A number of things in words, such as "1 job" or "2,000 jobs"."""
    return f"{count:,} {what}{'s' * (count != 1)}"


def visible(text: str) -> str:
    """A text with its control characters as escapes, such as ``\\u202e``: those of terminals, those
    that turn the direction of what follows, and those that XML forbids. Tabs and line ends stay."""
    return _HIDDEN.sub(lambda found: ascii(found[0])[1:-1], text)


def isolated(text: str) -> str:
    """A :func:`visible` text that leaves the order of its neighbours alone: one with letters that
    are written from right to left is set in a Unicode isolate."""
    text = visible(text)
    if text.isascii():
        return text
    turns = any(c in _MARKS or unicodedata.bidirectional(c) in _RIGHT_TO_LEFT for c in text)
    return f"\u2068{text}\u2069" if turns else text
