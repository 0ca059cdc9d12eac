"""Training of place recognition networks."""
