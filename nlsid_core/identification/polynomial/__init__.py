"""Polynomial equations: rows of data, searches and their stable sets."""
