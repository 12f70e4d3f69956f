"""Rows of the editor's buffer, (ROWS, W) float32: what is known of one row of pixels."""

R, G, B = range(3)
"""Linear light."""
LUMA, SKYNESS = 3, 4
"""Of the recorded picture: sRGB luma and the feature of the sky."""
BELOW_TOP, DEPTH_ABOVE = 5, 6
"""How far below its own upper edge a pixel lies, metres; depth of the pixel above it."""
NOISE, LIE = 7, 8
"""Noise of the places in [0, 1]: where snow lies first, and where water stands longest."""
SINE, SIZE, HEIGHT = 9, 10, 11
"""Of the ground: sine of the grazing angle, metres a pixel, metres over the road's plane."""
LIT, MEAN, LEVEL = 12, 13, 14
"""Light on the surface, mean luminance around it, how level it lies; spread together."""
SIDE, POOL, COVERED = 15, 16, 17
"""Wheel tracks, standing water, snow or shine, all in [0, 1]."""
MIRRORED = 18
"""Six rows: what calm water and what a film mirrors."""
GROUNDED = 17
"""1 where a pixel is ground."""
FREE = 18
"""Six rows for a moment."""
ROWS = 24
