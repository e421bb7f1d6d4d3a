"""Packed symmetric 3 x 3 matrices: upper triangle, row by row: xx, xy, xz, yy, yz, zz."""

import numpy as np

UPPER = np.triu_indices(3)  # entries of the full matrix: full[..., *UPPER]
OF_NINE = np.ravel_multi_index(UPPER, (3, 3))  # entries of the flattened matrix: full.reshape(-1, 9)[:, OF_NINE]
UNPACK_INDEX = np.array([[0, 1, 2], [1, 3, 4], [2, 4, 5]])  # full matrix: packed[..., UNPACK_INDEX]
