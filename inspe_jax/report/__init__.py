"""What people look at: figures, tables, and what is handed over. Matplotlib is imported with them.

A figure is Matplotlib's, a table Rich's; a notebook shows either as the last value of a cell.
"""

from typing import Any

from inspe_jax.core.lazily import lazily

_MODULES = {
    "report.figures": ("plan_view", "scene_view"),
    "report.handover": ("bill_of_materials", "calibration_json", "plan_geojson", "plan_kml"),
    "report.scene_tables": ("devices_table", "layout_table", "scene_table"),
    "report.searches": ("before_after", "history_view", "pareto_view"),
    "report.tables": (
        "blind_spots_table", "comparison_table", "metrics_table", "moves_table", "pareto_table",
        "scores_table", "tolerance_table",
    ),
    "report.targets": ("targets_change", "targets_view"),
}  # fmt: skip
__all__ = sorted(name for names in _MODULES.values() for name in names)
_get = lazily(__name__, _MODULES)


def __getattr__(name: str) -> Any:
    return _get(name)


def __dir__() -> list[str]:
    return __all__
