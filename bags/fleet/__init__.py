"""Many bags, wherever they lie: read by workers, kept in a manifest, reduced at home."""
