"""Where logs are: as named, else in the folder that the variable VSLAM_DATA names."""

import os
from pathlib import Path


def default_path(below: Path, what: str) -> str:
    """Return the place of a log below the folder of data sets.

    Args:
        below: Of the log, in that folder.
        what: The log, as an error would call it.

    Raises:
        ValueError: If the variable is not set.
    """
    from slam_backend.errors import bad_argument

    data = os.environ.get("VSLAM_DATA")
    if not data:
        raise bad_argument("path", f"a folder of {what}", "no --path", "Name it, or set VSLAM_DATA.")
    return str(Path(data).resolve() / below)
