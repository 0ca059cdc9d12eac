"""Feature trunks: an image to a dense feature map."""
