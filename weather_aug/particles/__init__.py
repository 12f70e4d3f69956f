"""Weather, seed and time become particles in the air."""
