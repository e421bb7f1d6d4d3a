"""Symmetric 3 x 3 matrices as their upper triangles, row by row: xx, xy, xz, yy, yz, zz."""

import numpy as np

UPPER = np.triu_indices(3)  # where the six stand in the full matrix: full[..., *UPPER]
OF_NINE = np.ravel_multi_index(UPPER, (3, 3))  # where in that written out row by row: full.reshape(-1, 9)[:, OF_NINE]
UNPACK_INDEX = np.array([[0, 1, 2], [1, 3, 4], [2, 4, 5]])  # which of the six stands where: packed[..., UNPACK]
