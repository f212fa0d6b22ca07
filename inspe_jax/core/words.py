"""Numbers in messages."""


def counted(count: int, what: str) -> str:
    """A number of things in words, such as "1 job" or "2,000 jobs"."""
    return f"{count:,} {what}{'s' * (count != 1)}"
