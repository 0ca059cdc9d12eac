"""Convolutional networks as data, and what runs them. A layer below describe/ and verify/, which say which networks."""
