"""`python -m training` is the command `vslam`."""

from training.cli import main

main()
