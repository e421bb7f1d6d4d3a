"""Where logs are: as named, else in the folder that the variable VSLAM_DATA names."""

import os
from pathlib import Path


def find_log(path: str | None, below: Path, what: str) -> str:
    """Return the place of a log, and refuse one that is not there.

    Args:
        path: As the user named it; None: below the folder of data sets.
        below: Where it is in that folder.
        what: What must be there, as an error would say it.

    Raises:
        ValueError: If nothing is there, or `path` is None and the variable is not set.
    """
    from slam_backend.core.validation import bad_argument

    data = os.environ.get("VSLAM_DATA")
    if path is None and not data:
        raise bad_argument("path", what, "no --path", "Name it, or set VSLAM_DATA.")
    place = str(Path(data or "").resolve() / below) if path is None else path
    if not Path(place).exists():
        cure = f"Check {place!r}; if --path is left away, it is {str(below)!r} in the folder that VSLAM_DATA names."
        raise bad_argument("path", what, "no such path", cure)
    return place
