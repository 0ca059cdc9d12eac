"""The keyframe database: what is remembered of the places seen, bounded in memory, searched by global vector."""

from pnv_core.database.keyframes import DatabaseStats, KeyframeDatabase, Snapshot

__all__ = ["DatabaseStats", "KeyframeDatabase", "Snapshot"]
