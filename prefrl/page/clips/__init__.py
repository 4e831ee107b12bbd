"""Clips of segments: drawn by a supervised process, encoded, and kept."""
