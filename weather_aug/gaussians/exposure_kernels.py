"""Compiled loops of `exposure`: an affine map of colours and its gradients, one pass each."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from weather_aug._compiled import compiled

Float32 = NDArray[np.float32]
Float64 = NDArray[np.float64]


@compiled
def expose(colours: Float32, matrix: Float32, out: Float32) -> None:
    """Write matrix (3, 4) @ (r, g, b, 1) of colours (H, W, 3)."""
    a, b, c, d = matrix[0, 0], matrix[0, 1], matrix[0, 2], matrix[0, 3]
    e, f, g, h = matrix[1, 0], matrix[1, 1], matrix[1, 2], matrix[1, 3]
    i, j, k, m = matrix[2, 0], matrix[2, 1], matrix[2, 2], matrix[2, 3]
    for row in range(colours.shape[0]):
        for column in range(colours.shape[1]):
            red, green = colours[row, column, 0], colours[row, column, 1]
            blue = colours[row, column, 2]
            out[row, column, 0] = a * red + b * green + c * blue + d
            out[row, column, 1] = e * red + f * green + g * blue + h
            out[row, column, 2] = i * red + j * green + k * blue + m


@compiled
def expose_back(
    colours: Float32, matrix: Float32, slopes: Float32, d_colours: Float32, d_matrix: Float64
) -> None:
    """Write the gradient of the colours, add that of the matrix; slopes (H, W, 3) are the given."""
    a, b, c = matrix[0, 0], matrix[0, 1], matrix[0, 2]
    e, f, g = matrix[1, 0], matrix[1, 1], matrix[1, 2]
    i, j, k = matrix[2, 0], matrix[2, 1], matrix[2, 2]
    for row in range(colours.shape[0]):
        # A picture's sum in float32 would lose what a row's does not.
        s00 = s01 = s02 = s03 = s10 = s11 = s12 = s13 = s20 = s21 = s22 = s23 = np.float32(0.0)
        for column in range(colours.shape[1]):
            red, green = colours[row, column, 0], colours[row, column, 1]
            blue = colours[row, column, 2]
            u, v, w = slopes[row, column, 0], slopes[row, column, 1], slopes[row, column, 2]
            d_colours[row, column, 0] = a * u + e * v + i * w
            d_colours[row, column, 1] = b * u + f * v + j * w
            d_colours[row, column, 2] = c * u + g * v + k * w
            s00 += u * red
            s01 += u * green
            s02 += u * blue
            s03 += u
            s10 += v * red
            s11 += v * green
            s12 += v * blue
            s13 += v
            s20 += w * red
            s21 += w * green
            s22 += w * blue
            s23 += w
        d_matrix[0, 0] += np.float64(s00)
        d_matrix[0, 1] += np.float64(s01)
        d_matrix[0, 2] += np.float64(s02)
        d_matrix[0, 3] += np.float64(s03)
        d_matrix[1, 0] += np.float64(s10)
        d_matrix[1, 1] += np.float64(s11)
        d_matrix[1, 2] += np.float64(s12)
        d_matrix[1, 3] += np.float64(s13)
        d_matrix[2, 0] += np.float64(s20)
        d_matrix[2, 1] += np.float64(s21)
        d_matrix[2, 2] += np.float64(s22)
        d_matrix[2, 3] += np.float64(s23)
