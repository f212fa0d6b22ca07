"""Traffic from SUMO."""
