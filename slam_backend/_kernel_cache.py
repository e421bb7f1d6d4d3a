"""Disk cache of compiled kernels that several processes can read and write at the same time."""

from hashlib import sha256
from pathlib import Path
from typing import Any

from numba.core import caching

_IndexDataCacheFile: Any = caching.IndexDataCacheFile  # numba declares no types


class KernelCacheFile(_IndexDataCacheFile):  # type: ignore[misc]
    """Index and data files of one kernel.

    numba numbers the data files and writes the index first: of two processes that compile two specialisations at the
    same time, one can find the other's machine code under its own entry. Here a data file is named after what it was
    compiled from and is complete before the index refers to it, so that a race costs an entry at worst.
    """

    def save(self, key: Any, data: Any) -> None:
        """Save the machine code of one specialisation."""
        stamp = self._source_stamp
        name = self._data_name_pattern.format(number=int(sha256(repr((stamp, key)).encode()).hexdigest()[:15], 16))
        self._save_data(name, data)
        entries = self._load_index()
        if not entries:  # the first entry of this source: what was compiled from an older one is never read again
            self._delete_others(name)
        entries[key] = name
        self._save_index(entries)

    def _delete_others(self, kept: str) -> None:
        base = self._index_name.removesuffix(".nbi")
        for file in Path(self._cache_path).glob(f"{base}.*.nbc"):
            if file.name != kept:
                file.unlink(missing_ok=True)
