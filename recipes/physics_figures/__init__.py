"""Figures of docs/physics.md: what the library draws beside what the formula says."""
