"""Entry point of `python -m training`, which is the command `vslam`."""

from training.cli import main

main()
