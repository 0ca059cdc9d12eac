"""What speaks for a candidate: patches and local features that agree with one geometry."""
