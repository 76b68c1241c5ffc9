"""Recordings as messages: finding, reading, writing and mending bags and MCAP files."""
