"""Sensors: devices, their grids of rays, layouts, and the effects of light and weather."""
