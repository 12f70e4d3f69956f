"""Ratios against named peers, side by side in one process on one core."""
