"""Where sensors stand: the strategies and, later, the search."""
