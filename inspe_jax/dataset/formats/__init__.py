"""Formats of data sets: :mod:`.registry` lists them."""
