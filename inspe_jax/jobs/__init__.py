"""Scenes and layouts by name, and many jobs on them, on one machine or many."""
