"""Policies: what drives a robot in a funnel."""
