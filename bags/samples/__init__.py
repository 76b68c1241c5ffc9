"""Small real recordings that ship with the package."""

from bags.samples.folders import dart, dart_tables, f1tenth, kuka, schunk

__all__ = ["dart", "dart_tables", "f1tenth", "kuka", "schunk"]
