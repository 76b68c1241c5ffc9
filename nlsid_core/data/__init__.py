"""Recorded data and excitation signals."""
