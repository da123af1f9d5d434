"""warploom."""
