"""The command line `nlsid`."""
