"""Short, complete programs; each has run() -> (computed, published), which a test compares."""
