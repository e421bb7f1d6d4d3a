"""Messages of a command about its own progress, on stderr: option `--log-level`."""

import logging
from typing import Literal

from rich.logging import RichHandler

from training.experiments.output.console import make_console

LogLevel = Literal["debug", "info", "warning", "error"]
PACKAGES = ("slam_backend", "vslam_env", "agents", "training")
LOGGER = logging.getLogger("training")


def begin_logging(level: LogLevel) -> None:
    """Show messages of this project's packages from a level on; those of other packages are not affected."""
    handler = RichHandler(
        console=make_console(stderr=True), show_path=False, markup=False, highlighter=None, log_time_format="%H:%M:%S"
    )
    for package in PACKAGES:
        logger = logging.getLogger(package)
        logger.setLevel(level.upper())
        logger.handlers = [handler]
        logger.propagate = False
