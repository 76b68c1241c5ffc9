"""Funnels of dynamics in continuous time."""
