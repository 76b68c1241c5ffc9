"""Signals: named numbers of a recording, on one time grid, in known units."""
