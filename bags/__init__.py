"""Bags (MCAP) to and from data; the command line `nlsid`."""

from bags.signals.grid import read_dataset as read

__all__ = ["read"]
