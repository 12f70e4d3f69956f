"""All of it, precomputed for one clip."""
