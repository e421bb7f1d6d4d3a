"""What every part of the backend builds on: validation, compilation of kernels, files, states."""
