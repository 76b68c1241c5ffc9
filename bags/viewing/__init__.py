"""What a person looks at while a robot runs, or a recording is replayed: a page."""
