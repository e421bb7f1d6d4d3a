"""Commands of `vslam`: options, progress displays and run folders, with `helpers`; other packages do the work."""
