"""Stage 3: the frames of a drive → one scene of 3D Gaussians, seen from any pose."""
