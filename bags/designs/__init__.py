"""Designs: the files of a design folder, and what a robot runs and is held against."""
