"""Weather to the eye: sheets and sweeps."""
