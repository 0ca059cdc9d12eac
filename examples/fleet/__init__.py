"""make fleet-demo: robots that recognise each other's places."""
