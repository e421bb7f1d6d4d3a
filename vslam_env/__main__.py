"""Entry point of `python -m vslam_env`: the command `vslam` of the installed distribution."""

import sys
from importlib.metadata import entry_points


def main() -> None:
    """Run the command that the distribution declares; without an installation, say what to do."""
    found = list(entry_points(group="console_scripts", name="vslam"))
    if not found:
        sys.exit("vslam: expected an installed distribution, got source files alone. Run pip install . first.")
    found[0].load()()


if __name__ == "__main__":
    main()
