"""Arrays of a page as one compressed text: quantised, deflated and base64-encoded."""

import base64
import zlib
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

MISSING = -32768  # 16-bit code of NaN
LARGEST = 32767


class Packer:
    """Collector of arrays; each `add` returns the description by which the page finds its array."""

    def __init__(self) -> None:
        self._parts: list[bytes] = []
        self._length = 0

    def add(self, values: ArrayLike) -> dict[str, Any]:
        """Add numbers, quantised to 16 bits over their range; NaN is kept."""
        array = np.asarray(values, dtype=np.float64)
        finite = np.isfinite(array)
        low, high = (float(array[finite].min()), float(array[finite].max())) if finite.any() else (0.0, 0.0)
        offset, scale = 0.5 * (low + high), (high - low) / (2 * LARGEST)
        codes = np.rint(np.where(finite, array - offset, 0.0) / (scale or 1.0)).astype(np.int64)
        stored = np.where(finite, codes, MISSING).astype("<i2")
        return self._append(stored, "i16") | {"scale": scale, "offset": offset}

    def add_integers(self, values: ArrayLike) -> dict[str, Any]:
        """Add integers, exactly."""
        array = np.asarray(values).astype(np.int64)
        small = not array.size or (array.min() >= 0 and array.max() < 256)
        return self._append(array.astype("u1" if small else "<i4"), "u8" if small else "i32")

    def text(self) -> str:
        """Return all arrays, deflated, as base64."""
        return base64.b64encode(zlib.compress(b"".join(self._parts), 9)).decode("ascii")

    def _append(self, array: Any, kind: str) -> dict[str, Any]:
        data = np.ascontiguousarray(array).tobytes()
        data += bytes(-len(data) % 4)  # the next array is aligned
        begin, self._length = self._length, self._length + len(data)
        self._parts.append(data)
        return {"kind": kind, "begin": begin, "size": array.size}
