"""Commands of `vslam`: options, progress and run folders; the work is done elsewhere."""
