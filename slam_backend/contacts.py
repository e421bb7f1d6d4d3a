"""Who can exchange data: contacts between robots, and whom they reach through others."""

import numpy as np
from numpy.typing import ArrayLike
from scipy.sparse.csgraph import connected_components

from slam_backend.errors import BoolArray, IntArray, bad_argument, check_array


def check_contacts(contacts: ArrayLike, num_robots: int) -> BoolArray:
    """Return contacts as a checked array.

    Args:
        contacts: (K, K) bool, symmetric; the diagonal means nothing.
        num_robots: K.

    Raises:
        ValueError: If they are no symmetric array of bools.
    """
    cure = "Say for each pair of robots whether it can exchange data."
    touch = check_array("contacts", contacts, (num_robots, num_robots), cure, dtype=None, finite=False)
    if touch.dtype != np.bool_ or not np.array_equal(touch, touch.T):
        got = f"an array of {touch.dtype}" if touch.dtype != np.bool_ else "a matrix that is not symmetric"
        raise bad_argument("contacts", "a symmetric array of bools", got, cure)
    return np.asarray(touch)


def reach(contacts: BoolArray | None, num_robots: int) -> IntArray:
    """Number the networks: robots pass on what they hear, so that those who reach each other by steps are in contact.

    Args:
        contacts: (K, K) bool, symmetric; the diagonal means nothing. None = all.
        num_robots: K.

    Returns:
        (K,) int64. Robots with the same number can exchange data.

    >>> chain = np.array([[0, 1, 0, 0], [1, 0, 1, 0], [0, 1, 0, 0], [0, 0, 0, 0]], dtype=bool)
    >>> reach(chain, 4).tolist()
    [0, 0, 0, 1]
    """
    if contacts is None or contacts.all():
        return np.zeros(num_robots, dtype=np.int64)
    return np.asarray(connected_components(contacts, directed=False)[1], dtype=np.int64)
