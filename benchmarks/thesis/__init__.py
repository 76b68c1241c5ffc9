"""The literal algorithms of the thesis, and simulated attempts to break a proved funnel."""
