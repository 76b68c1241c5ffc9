"""Funnels of identified models, sample by sample."""
