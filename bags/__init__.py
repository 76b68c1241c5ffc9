"""Bags (MCAP) to and from data; the command line `nlsid`."""
