"""Measuring place recognition: data sets with their ground truth, methods, metrics, tables and the report."""
