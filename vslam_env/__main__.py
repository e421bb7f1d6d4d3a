"""Entry point of the command `vslam` and of `python -m vslam_env`."""

import sys
from importlib import import_module
from importlib.util import find_spec
from pathlib import Path

from slam_backend.core.validation import argument_error

FOLDER = Path(__file__).resolve().parents[1]  # of this project's packages
PLAIN_NAMES = ("agents", "training")  # packages that another file or package may hide
BAD_INPUT = 2


def main() -> None:
    """Run the command line, unless Python would load something else under the name of one of its packages."""
    try:
        for name in PLAIN_NAMES:
            check_package(name)
    except ValueError as error:
        print(f"error {error}", file=sys.stderr)
        sys.exit(BAD_INPUT)
    # Loaded by name: layers do not import those above, and the package of a command is the only exception.
    import_module("training.cli").main()


def check_package(name: str) -> None:
    """Refuse a module that hides a package of this project; nothing of it is run.

    Raises:
        ValueError: If Python would load another module, or none.
    """
    expected, hint = f"this project's package {str(FOLDER / name)!r}", "Install vslam-env again."
    found = find_spec(name)
    if found is None:
        raise argument_error(name, expected, "no module", hint)
    file = Path(found.origin or next(iter(found.submodule_search_locations or ()), ""))  # of a folder without origin
    if file.resolve() != FOLDER / name / "__init__.py":
        hint = "Rename the latter, or call vslam from another folder, or install it into an environment of its own."
        raise argument_error(name, expected, file.parent if file.name == "__init__.py" else file, hint)


if __name__ == "__main__":
    main()
