"""Commands of `vslam`: options, progress displays and run folders; other packages do the work."""
