"""Title, icon and style of a page that viser serves, which has no options for them."""

import gzip
import re
from functools import lru_cache

_OWN = re.compile(
    r'<title>.*?</title>|<link\s+rel="icon".*?/>|<meta\s+name="description".*?/>', re.S
)


@lru_cache(maxsize=4)
def with_head(page: bytes, head: str, *, zipped: bool) -> bytes:
    """viser's page with ``head`` in its head, in place of its own title, icon and description.

    ``zipped``: the page is compressed, and so is what is returned.
    """
    text = (gzip.decompress(page) if zipped else page).decode()
    start, found, rest = text.partition("<head>")
    first, script, rest = rest.partition("<script")  # what is behind it is compressed
    new = (start + found + head + _OWN.sub("", first) + script + rest).encode()
    return gzip.compress(new) if zipped else new
