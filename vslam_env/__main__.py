"""Entry point of the command `vslam` and of `python -m vslam_env`."""

import sys
from importlib import import_module
from importlib.util import find_spec
from pathlib import Path

FOLDER = Path(__file__).resolve().parents[1]  # of this project's packages
PLAIN_NAMES = ("agents", "training")  # packages that another file or package may hide
BAD_INPUT, INTERRUPTED = 2, 130


def main() -> None:
    """Run the command line, unless Python would load something else under the name of one of its packages."""
    try:
        for name in PLAIN_NAMES:
            check_package(name)
    except ValueError as error:
        print(f"error {error}", file=sys.stderr)
        sys.exit(BAD_INPUT)
    # Loaded by name: layers do not import those above, and the package of a command is the only exception.
    try:
        import_module("training.cli").main()
    except KeyboardInterrupt:  # while it is loaded; commands handle their own
        sys.exit(INTERRUPTED)


def check_package(name: str) -> None:
    """Refuse a module that hides a package of this project; nothing of it is run.

    Raises:
        ValueError: If Python would load another module, or none.
    """
    spec = find_spec(name)
    file = None if spec is None else Path(spec.origin or next(iter(spec.submodule_search_locations or ()), ""))
    if file is None or file.resolve() != FOLDER / name / "__init__.py":
        place = "no module" if file is None else repr(str(file.parent if file.name == "__init__.py" else file))
        hint = "Rename the latter, or call vslam from another folder, or install it into an environment of its own."
        hint = "Install vslam-env again." if file is None else hint
        # The form of `argument_error`, whose module imports numpy.
        raise ValueError(f"{name}: expected this project's package {str(FOLDER / name)!r}, got {place}. {hint}")


if __name__ == "__main__":
    main()
