"""Bridges: loop closures into SLAM systems, each a thin node over pure code."""
