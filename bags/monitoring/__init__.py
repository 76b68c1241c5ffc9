"""Recordings and live messages held against a funnel, by one path."""
