"""A drive on disk becomes a Clip of frames."""
