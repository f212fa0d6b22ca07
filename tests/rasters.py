"""Rasterio for tests that write elevation models."""

import os
from typing import Any

import pytest


def rasterio() -> Any:
    """Rasterio with its own projections: SUMO, once imported, names those of SUMO instead."""
    for name in ("PROJ_DATA", "PROJ_LIB"):
        if "sumo" in os.environ.get(name, ""):
            del os.environ[name]
    return pytest.importorskip("rasterio", reason="elevation models need rasterio: extra [geo]")
