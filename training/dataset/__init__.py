"""Episodes as a data set: recorded by `vslam record`, read by plain numpy, this package or Minari."""
