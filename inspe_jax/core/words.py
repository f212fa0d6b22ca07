"""Words in messages and on pages: numbers of things, and names that users give."""

import re

_HIDDEN = re.compile(
    "[\x00-\x08\x0b-\x1f\x7f-\x9f\u2028-\u202e\u2066-\u2069\ud800-\udfff\ufffe\uffff]"
)


def counted(count: int, what: str) -> str:
    """A number of things in words, such as "1 job" or "2,000 jobs"."""
    return f"{count:,} {what}{'s' * (count != 1)}"


def visible(text: str) -> str:
    """A text with its control characters as escapes, such as ``\\u202e``: those of terminals, those
    that turn the direction of what follows, and those that XML forbids. Tabs and line ends stay."""
    return _HIDDEN.sub(lambda found: ascii(found[0])[1:-1], text)
