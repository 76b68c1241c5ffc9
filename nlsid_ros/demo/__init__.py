"""The live part of `nlsid demo`: the nodes as processes, and what they say held against offline."""
